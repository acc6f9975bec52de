"""Choosing rows of one cloud: farthest-point order, prefixes, resampling, half-space crops."""

from bisect import bisect_left, bisect_right

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from dbdnet_jax.types import Points


def prefix_mask(n: int, count: Int[Array, ""] | Float[Array, ""]) -> Bool[Array, " n"]:
    """True for the first ``count`` of n rows: the valid points of a cloud of static size."""
    return jnp.arange(n, dtype=jnp.result_type(count)) < count


def divisor(count: Int[Array, "*stack"], dtype: jnp.dtype) -> Float[Array, "*stack"]:
    """What a sum over ``count`` rows is divided by for their mean: of no rows it is then 0."""
    return jnp.maximum(count, 1).astype(dtype)


def prefix_order(keep: Bool[Array, " n"]) -> Int[Array, " n"]:
    """The row order that brings the kept rows to the front and changes nothing else."""
    return jnp.argsort(~keep, stable=True)


def inverse_order(order: Int[Array, " n"]) -> Int[Array, " n"]:
    """The order that undoes ``order``: ``x[order][inverse_order(order)] == x``."""
    rows = jnp.arange(order.shape[0], dtype=order.dtype)
    return jnp.zeros_like(order).at[order].set(rows)


def farthest_order(
    points: Float[Array, "n 3"], count: Int[Array, ""], size: int = 0
) -> Int[Array, " n"]:
    """A row order whose first rows are farthest-point samples from row 0.

    As many as ``size``, or ``count // 2`` where it is 0. Each next row is the valid point farthest
    from all rows before it (Gonzalez 1985; the lower row on ties). The other valid rows follow in
    their given order, then the padding. The sampling is greedy, so the first rows of the reordered
    cloud are farthest-point samples of any longer prefix too: in this order every level of a
    pyramid is a prefix. Where ``size`` is 0, clouds of fewer than four points keep
    their order.
    """
    n = points.shape[0]
    rows = jnp.arange(n, dtype=jnp.result_type(count))
    sampled = jnp.minimum(count, size) if size else count // 2
    # Padding starts below every distance, so that it is never the farthest.
    start = jnp.where(rows < count, jnp.inf, -1.0).astype(points.dtype)
    # One array for each coordinate, and two plain reductions where `jnp.argmax` would do: a CPU
    # takes several elements at a time through these, and a loop of so many steps is all of it.
    x, y, z = points.T

    def step(distance: Array, _: None) -> tuple[Array, Array]:
        last = jnp.min(jnp.where(distance == jnp.max(distance), rows, n - 1))
        dx, dy, dz = x - x[last], y - y[last], z - z[last]
        nearer = jnp.minimum(distance, dx * dx + dy * dy + dz * dz)
        # A row once taken must not be taken again, even among duplicates at distance zero.
        return jnp.where(rows == last, -1.0, nearer), last

    _, taken = jax.lax.scan(step, start, length=min(n, size) or n // 2)
    place = jnp.arange(taken.shape[0], dtype=rows.dtype)
    rank = jnp.where(rows < count, n + rows, 2 * n + rows)
    rank = rank.at[jnp.where(place < sampled, taken, n)].set(place, mode="drop")
    return jnp.argsort(rank)


def farthest_rows(points: Points, count: int, first: int = 0) -> Int[np.ndarray, " k"]:
    """Rows of ``count`` farthest-point samples from row ``first``, as they were chosen; in NumPy.

    Fewer where only copies of the chosen points are left. A choice changes the distances of points
    nearer than the largest distance left, so only a window of the points, sorted along their
    longest axis, is looked at: half the time.
    """
    axis = int(np.ptp(points, axis=0).argmax())
    order = np.argsort(points[:, axis], kind="stable")
    coordinates = np.ascontiguousarray(points[order].T)
    along = coordinates[axis].tolist()
    nearest = np.full(len(points), np.inf)
    last, reach = int(np.flatnonzero(order == first)[0]), np.inf
    chosen: list[int] = []
    while len(chosen) < count and nearest[last] > 0:
        chosen.append(last)
        low = bisect_left(along, along[last] - reach)
        window = slice(low, bisect_right(along, along[last] + reach, lo=low))
        offset = coordinates[:, window] - coordinates[:, last, None]
        offset *= offset
        np.minimum(nearest[window], offset[0] + offset[1] + offset[2], out=nearest[window])
        last = int(nearest.argmax())
        reach = float(nearest[last]) ** 0.5
    return order[chosen]


def resample(key: PRNGKeyArray, n: int, size: int) -> Int[Array, " size"]:
    """Indices of ``size`` of n rows: a random subset, or, if size > n, all rows and repeats.

    Every row is drawn at least once when ``size >= n``; the order is random.
    """
    subset_key, repeat_key = jax.random.split(key)
    order = jax.random.permutation(subset_key, n)
    if size <= n:
        return order[:size]
    return jnp.concatenate([order, jax.random.randint(repeat_key, (size - n,), 0, n)])


def random_direction(key: PRNGKeyArray) -> Float[Array, "3"]:
    """A unit vector, uniform on the sphere."""
    vector = jax.random.normal(key, (3,))
    return vector / jnp.linalg.norm(vector)


def half_space_crop(
    points: Float[Array, "n 3"],
    direction: Float[Array, "3"],
    size: int,
    count: Float[Array, ""] | Int[Array, ""] | None = None,
) -> Int[Array, " size"]:
    """Indices of the ``size`` points farthest along ``direction``, in their given order.

    That is a cut by a plane normal to ``direction``, placed so that exactly ``size`` points
    remain (RPM-Net, Yew & Lee 2020). Of the first ``count`` points, which must be as many; of all,
    if None.
    """
    return _largest(jnp.sum(points * direction[None, :], axis=-1), size, count)


def ball_crop(
    points: Float[Array, "n 3"],
    centre: Float[Array, "3"],
    size: int,
    count: Float[Array, ""] | Int[Array, ""] | None = None,
) -> Int[Array, " size"]:
    """Indices of the ``size`` points nearest to ``centre`` (PRNet, Wang & Solomon 2019).

    Otherwise as `half_space_crop`.
    """
    return _largest(-jnp.sum((points - centre[None, :]) ** 2, axis=-1), size, count)


def _largest(
    score: Float[Array, " n"], size: int, count: Float[Array, ""] | Int[Array, ""] | None
) -> Int[Array, " size"]:
    if count is not None:
        score = jnp.where(prefix_mask(score.shape[0], count), score, -jnp.inf)
    return jnp.sort(jax.lax.top_k(score, size)[1])
