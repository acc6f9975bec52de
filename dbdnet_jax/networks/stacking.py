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
from dbdnet_jax.ops.grouping import knn
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
