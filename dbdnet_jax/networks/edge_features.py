"""The point encoder of DCP and RIENet: a DGCNN whose graph is searched once, in coordinates.

Every edge passes all layers without being pooled in between; after each layer the maximum over a
point's edges is kept, and all of these together give its feature.
"""

import flax.linen as nn
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from dbdnet_jax.networks.batch_norm import DenseBatchNorm, dense_batch_norm_shapes
from dbdnet_jax.networks.params import Shapes
from dbdnet_jax.networks.stacking import pool_edges, rows


class EdgeFeatures(nn.Module):
    """Features of the points from their edges: ``neighbour - centre``, or ``[neighbour, centre]``.

    ``widths`` are those of the layers on edges, ``features`` that of the result.
    """

    widths: tuple[int, ...]
    features: int
    difference: bool

    @nn.compact
    def __call__(
        self,
        points: Float[Array, "*pairs n 3"],
        index: Int[Array, "*pairs n k"],
        training: bool = False,
    ) -> Float[Array, "*pairs n d"]:
        """Of one cloud with folded parameters; in training, of a batch of clouds."""
        near = rows(points, index)
        centre = jnp.broadcast_to(points[..., None, :], near.shape)
        if self.difference:
            edges = near - centre
        else:
            edges = jnp.concatenate([near, centre], axis=-1)
        kept = []
        for i, width in enumerate(self.widths):
            edges = DenseBatchNorm(width, bias=False, name=f"edge_{i}")(edges, training)
            kept.append(pool_edges(edges))
        layer = DenseBatchNorm(self.features, bias=False, name="point")
        return layer(jnp.concatenate(kept, axis=-1), training)


def edge_features_shapes(
    name: str, widths: tuple[int, ...], features: int, *, difference: bool
) -> Shapes:
    """The parameters of `EdgeFeatures`."""
    found: Shapes = {}
    fan_in = 3 if difference else 6
    for i, width in enumerate(widths):
        found |= dense_batch_norm_shapes(f"{name}/edge_{i}", fan_in, width, bias=False)
        fan_in = width
    return found | dense_batch_norm_shapes(f"{name}/point", sum(widths), features, bias=False)
