"""The encoder that the paper's ablation begins with: a DGCNN, one resolution throughout."""

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from dbdnet_jax.networks.blocks import DenseNorm, dense_norm_shapes
from dbdnet_jax.networks.edgeconv import EdgeConv, edgeconv_shapes
from dbdnet_jax.networks.params import Shapes
from dbdnet_jax.ops.grouping import knn
from dbdnet_jax.ops.pyramid import Pyramid

WIDTHS = (1, 1, 2, 4)  # of the layers, in channels (Wang et al. 2019: 64, 64, 128, 256)
GROUPS = (4, 4, 4, 8)  # of their group norms
_FEATURE = 4  # width of the result in channels, as that of the multi-resolution encoder


class DGCNN(nn.Module):
    """A point-wise feature of four times ``channels`` from four EdgeConv layers on all points.

    The layers are the multi-resolution encoder's, which at its finest level has them too (hence
    their names), without what the coarser levels would add; all four together, through a dense
    layer, are the feature. Norms are of a cloud, not of a batch: pairs are trained one by one.
    """

    channels: int
    neighbour_space: str

    @nn.compact
    def __call__(
        self,
        points: Float[Array, "n 3"],
        pyramid: Pyramid,
        geometry: Float[Array, "n g"] | None = None,
    ) -> Float[Array, "n d"]:
        """Encode one cloud, of whose pyramid only the finest level is of use."""
        x = points if geometry is None else jnp.concatenate([points, geometry], axis=-1)
        level, place = pyramid.levels[0], points
        layers: list[jax.Array] = []
        for stage, (width, groups) in enumerate(zip(WIDTHS, GROUPS, strict=True), start=1):
            index = level.neighbours
            if self.neighbour_space == "feature":
                index = knn(place, place, index.shape[1], level.count)
            name = f"stage{stage}_conv1"
            layer = EdgeConv(width * self.channels, groups, of_points=stage == 1, name=name)
            x = place = layer(x, index, level.valid)
            layers.append(x)
        ((features, groups),) = _fusion(self.channels)
        fuse = DenseNorm(features, groups, name="fusion_0")
        return fuse(jnp.concatenate(layers, axis=-1), level.valid)


def _fusion(channels: int) -> tuple[tuple[int, int]]:
    return ((_FEATURE * channels, GROUPS[-1]),)


def dgcnn_shapes(name: str, channels: int, inputs: int) -> Shapes:
    """The parameters of a `DGCNN` that is given so many numbers of each point."""
    shapes: Shapes = {}
    fan_in = inputs
    for stage, width in enumerate(WIDTHS, start=1):
        shapes |= edgeconv_shapes(f"{name}/stage{stage}_conv1", fan_in, width * channels)
        fan_in = width * channels
    return shapes | dense_norm_shapes(f"{name}/fusion", sum(WIDTHS) * channels, _fusion(channels))
