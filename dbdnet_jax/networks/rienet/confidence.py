"""RIENet's inlier confidence: is a point's neighbourhood like that of its counterpart?"""

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from dbdnet_jax.networks.batch_norm import DenseBatchNorm, dense_batch_norm_shapes
from dbdnet_jax.networks.blocks import LEAKY_SLOPE, affine_shapes
from dbdnet_jax.networks.params import Shapes
from dbdnet_jax.networks.stacking import Rows, rows

TAPS = 3  # of a convolution along the neighbours, which stand in the order of their distance
BRANCH = 16  # width of the branches and of their weighted sum
HEAD = 8


class Confidence(nn.Module):
    """A confidence in (0, 1] for every source point and its pseudo target."""

    width: int

    @nn.compact
    def __call__(
        self,
        source: Float[Array, "*pairs n 3"],
        correspondence: Float[Array, "*pairs n 3"],
        index: Int[Array, "*pairs n k"],
        training: bool = False,
    ) -> Float[Array, "*pairs n"]:
        """From the edges to the same neighbours in both."""
        edges = [
            DenseBatchNorm(width, slope=LEAKY_SLOPE, name=f"edge_{i}")
            for i, width in enumerate((self.width, 2 * self.width))
        ]

        def encode(points: Array) -> Array:
            x = points[..., None, :] - rows(points, index)
            for layer in edges:
                x = layer(beside_neighbours(x), training)
            return x

        of_correspondence = encode(correspondence)  # first, which the running averages tell
        difference = of_correspondence - encode(source)
        branches = []
        for branch in ("weight", "value"):
            x = difference
            for i in (0, 1):
                layer = DenseBatchNorm(BRANCH, slope=LEAKY_SLOPE, name=f"{branch}_{i}")
                x = layer(x, training)
            branches.append(x)
        weights, values = branches
        x = jnp.sum(jax.nn.softmax(weights, axis=-2) * values, axis=-2)
        x = DenseBatchNorm(HEAD, slope=LEAKY_SLOPE, name="head_0")(x, training)
        x = Rows(1, name="head_1")(x)[..., 0]
        return 1.0 - jnp.tanh(jnp.abs(x))


def beside_neighbours(x: Float[Array, "*rows k c"]) -> Float[Array, "*rows k d"]:
    """Every neighbour's row between those before and after it, zeros at the ends."""
    pad = [(0, 0)] * (x.ndim - 2) + [(1, 1), (0, 0)]
    x, k = jnp.pad(x, pad), x.shape[-2]
    return jnp.concatenate([x[..., tap : tap + k, :] for tap in range(TAPS)], axis=-1)


def confidence_shapes(name: str, width: int) -> Shapes:
    """The parameters of `Confidence`."""
    found: Shapes = {}
    fan_in = 3
    for i, features in enumerate((width, 2 * width)):
        found |= dense_batch_norm_shapes(f"{name}/edge_{i}", TAPS * fan_in, features)
        fan_in = features
    for branch in ("weight", "value"):
        found |= dense_batch_norm_shapes(f"{name}/{branch}_0", fan_in, BRANCH)
        found |= dense_batch_norm_shapes(f"{name}/{branch}_1", BRANCH, BRANCH)
    found |= dense_batch_norm_shapes(f"{name}/head_0", BRANCH, HEAD)
    return found | affine_shapes(f"{name}/head_1", HEAD, 1)
