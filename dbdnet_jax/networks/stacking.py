"""One pair or a stack of pairs: what the peers need because batch norms see the whole batch.

Their layers take arrays with any leading axes; an operation on one pair is mapped over them.
"""

from collections.abc import Callable
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from dbdnet_jax.ops import rigid
from dbdnet_jax.ops.grouping import knn, masked_max, max_over_slots
from dbdnet_jax.types import Cloud, Rigid


def over_pairs(function: Callable[..., Any], x: Float[Array, "*pairs n c"]) -> Callable[..., Any]:
    """A function of one pair's arrays, mapped over the axes before the last two of ``x``."""
    for _ in range(x.ndim - 2):
        function = jax.vmap(function)
    return function


def neighbours(cloud: Cloud, k: int) -> Int[Array, "*pairs n k"]:
    """Rows of the k points nearest to each point, itself first."""
    return over_pairs(lambda x, count: knn(x, x, k, count), cloud.points)(
        cloud.points, jnp.asarray(cloud.count)
    )


def rows(x: Float[Array, "*pairs n c"], index: Int[Array, "*pairs n k"]) -> Array:
    """The rows of every point's neighbours: an axis more than ``x``."""
    return over_pairs(lambda x, index: x[index], x)(x, index)


def move(target_from_source: Rigid, points: Float[Array, "*pairs n 3"]) -> Array:
    """`ops.rigid.apply`, of each pair."""
    return over_pairs(rigid.apply, points)(target_from_source, points)


def zero_padding(x: Float[Array, "*pairs n c"], valid: Bool[Array, "*pairs n"]) -> Array:
    """Features with zeros in the padding: the floor of a ReLU, which no maximum notices."""
    return jnp.where(valid[..., None], x, 0.0)


def pool(x: Float[Array, "*pairs n c"], valid: Bool[Array, "*pairs n"]) -> Array:
    """`ops.grouping.masked_max`, of each pair: where there is no row, zeros, a ReLU's floor."""
    return over_pairs(masked_max, x)(x, valid)


def pool_edges(edges: Float[Array, "*rows k c"]) -> Float[Array, "*rows c"]:
    """`ops.grouping.max_over_slots`, of every row's k edges."""
    k, c = edges.shape[-2:]
    slots = jnp.moveaxis(edges.reshape(-1, k, c), 1, 0)
    return max_over_slots(slots).reshape(*edges.shape[:-2], c)


def without_padding(cloud: Cloud) -> Cloud:
    """Zeros in the padding: a weight of zero does not make NaN vanish."""
    return cloud._replace(points=zero_padding(cloud.points, cloud.valid))


def to_every_row(x: Float[Array, "*pairs c"], n: int) -> Float[Array, "*pairs n c"]:
    """A feature of the cloud, repeated for each of its n points."""
    return jnp.broadcast_to(x[..., None, :], (*x.shape[:-1], n, x.shape[-1]))


class Rows(nn.Module):
    """An affine map of every row."""

    features: int

    @nn.compact
    def __call__(self, x: Float[Array, "*rows c"]) -> Float[Array, "*rows d"]:
        """Map them."""
        kernel = self.param("kernel", nn.initializers.zeros, (x.shape[-1], self.features))
        bias = self.param("bias", nn.initializers.zeros, (self.features,))
        x = x @ kernel.astype(x.dtype)
        return x + jnp.broadcast_to(bias.astype(x.dtype), x.shape)
