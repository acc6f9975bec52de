"""Neighbours in one cloud or between two: distances, k-NN, interpolation."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from dbdnet_jax.ops.rigid import HIGHEST
from dbdnet_jax.ops.sampling import prefix_mask


def squared_distances(a: Float[Array, "n d"], b: Float[Array, "m d"]) -> Float[Array, "n m"]:
    """Squared Euclidean distances between all rows of a and all rows of b, never negative."""
    cross = jnp.matmul(a, b.T, precision=HIGHEST)
    squares = jnp.sum(a * a, axis=-1)[:, None] + jnp.sum(b * b, axis=-1)[None, :]
    return jnp.maximum(squares - 2.0 * cross, 0.0)


def knn(
    query: Float[Array, "n d"],
    points: Float[Array, "m d"],
    k: int,
    count: Int[Array, ""],
) -> Int[Array, "n k"]:
    """The k nearest of the first ``count`` points for each query, nearest first.

    Where fewer than k points are valid, the nearest one fills the empty places (a maximum over
    the neighbours does not notice). No gradient passes through the choice. ``k`` may exceed m.
    """
    found = min(k, points.shape[0])
    distance = squared_distances(jax.lax.stop_gradient(query), jax.lax.stop_gradient(points))
    distance = jnp.where(prefix_mask(points.shape[0], count), distance, jnp.inf)
    # The barrier keeps XLA's simplifier from merging the slices below into the selection, which
    # turns it into a full sort on CPU (27 times slower at 717 points). On the indices alone:
    # around both results XLA's compiler aborts the process under shard_map on several devices.
    index = jax.lax.optimization_barrier(jax.lax.top_k(-distance, found)[1])
    index = jnp.pad(index, ((0, 0), (0, k - found)))
    return jnp.where(prefix_mask(k, jnp.minimum(count, found)), index, index[:, :1])


def interpolation_weights(
    dense: Float[Array, "n 3"], sparse: Float[Array, "m 3"], count: Int[Array, ""]
) -> tuple[Int[Array, "n 3"], Float[Array, "n 3"]]:
    """The three nearest sparse points of each dense point and their inverse-distance weights.

    Weights are ``1 / (distance + 1e-8)``, normalised to sum to one (PointNet++, Qi et al. 2017):
    a dense point that coincides with a sparse one takes its value. With fewer than three valid
    sparse points the nearest one is repeated. Coordinates get no gradient.
    """
    index = knn(dense, sparse, 3, count)
    offset = jax.lax.stop_gradient(dense)[:, None, :] - jax.lax.stop_gradient(sparse)[index]
    weight = 1.0 / (jnp.sqrt(jnp.sum(offset * offset, axis=-1)) + 1e-8)
    return index, weight / jnp.sum(weight, axis=-1, keepdims=True)


def interpolate(
    features: Float[Array, "m c"], index: Int[Array, "n 3"], weight: Float[Array, "n 3"]
) -> Float[Array, "n c"]:
    """Weighted sum of the three sparse features of each dense point."""
    return jnp.sum(features[index] * weight[:, :, None], axis=1)


def max_over_neighbours(
    features: Float[Array, "m c"], index: Int[Array, "n k"]
) -> Float[Array, "n c"]:
    """Channel-wise maximum of the neighbours' features, one neighbour slot after the other."""

    def slot(best: Array, rows: Array) -> tuple[Array, None]:
        return jnp.maximum(best, features[rows]), None

    return jax.lax.scan(jax.checkpoint(slot), features[index[:, 0]], index[:, 1:].T)[0]


@jax.custom_vjp
def max_over_slots(values: Float[Array, "k n c"]) -> Float[Array, "n c"]:
    """Maximum over the first axis; its derivative goes to the first of equal entries.

    The derivative of `jnp.max` takes several times as long on a CPU.
    """
    return _max_and_slot(values)[0]


def _max_and_slot(
    values: Float[Array, "k n c"],
) -> tuple[Float[Array, "n c"], Int[Array, "n c"]]:
    best, slot = values[0], jnp.zeros(values.shape[1:], jnp.int32)
    for k in range(1, values.shape[0]):
        better = values[k] > best
        best, slot = jnp.where(better, values[k], best), jnp.where(better, k, slot)
    return best, slot


def _max_fwd(values: Float[Array, "k n c"]) -> tuple[Array, tuple[Array, Array]]:
    best, slot = _max_and_slot(values)
    return best, (slot, jnp.arange(values.shape[0], dtype=slot.dtype))


def _max_bwd(
    residual: tuple[Array, Array], cotangent: Float[Array, "n c"]
) -> tuple[Float[Array, "k n c"]]:
    slot, slots = residual
    chosen = slots[:, None, None] == slot[None, :, :]
    return (jnp.where(chosen, cotangent[None, :, :], 0.0),)


max_over_slots.defvjp(_max_fwd, _max_bwd)


@jax.custom_vjp
def masked_max(features: Float[Array, "n c"], valid: Bool[Array, " n"]) -> Float[Array, " c"]:
    """Channel-wise maximum over the valid rows; zeros where no row is valid.

    Its derivative goes to the first of equal rows, chosen by index. That of `jnp.max` looks for
    entries equal to the maximum, and loses its way where the compiler computes the features twice
    and rounds them differently.
    """
    lowest = jnp.finfo(features.dtype).min
    best = jnp.max(jnp.where(valid[:, None], features, lowest), axis=0)
    return jnp.where(jnp.any(valid), best, 0.0)


def _masked_fwd(
    features: Float[Array, "n c"], valid: Bool[Array, " n"]
) -> tuple[Array, tuple[Array, Array]]:
    lowest = jnp.finfo(features.dtype).min
    # Only where a derivative is asked for: a CPU takes 4 to 12 times as long as for `jnp.max`.
    row = jnp.argmax(jnp.where(valid[:, None], features, lowest), axis=0)
    best = jnp.take_along_axis(features, row[None, :], axis=0)[0]
    return jnp.where(jnp.any(valid), best, 0.0), (row, valid)


def _masked_bwd(
    residual: tuple[Array, Array], cotangent: Float[Array, " c"]
) -> tuple[Float[Array, "n c"], None]:
    row, valid = residual
    rows = jnp.arange(valid.shape[0])
    chosen = (rows[:, None] == row[None, :]) & jnp.any(valid)
    return jnp.where(chosen, cotangent[None, :], 0.0), None


masked_max.defvjp(_masked_fwd, _masked_bwd)
