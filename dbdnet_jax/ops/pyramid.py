"""The four levels of one cloud in farthest-point order, and how they see each other.

In that order (`sampling.farthest_order`) level l is the first ``n >> l`` rows, of which the first
``count >> l`` are valid: going down is a slice, and only going up needs an index.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from dbdnet_jax.ops.grouping import interpolation_weights, knn
from dbdnet_jax.ops.sampling import prefix_mask
from dbdnet_jax.types import Cloud

LEVELS = 4


class Level(NamedTuple):
    """One resolution: which rows are points, and their neighbours among each other."""

    count: Int[Array, ""]  # type: ignore[assignment]  # not tuple.count
    valid: Bool[Array, " n"]
    neighbours: Int[Array, "n k"]


class Pyramid(NamedTuple):
    """The levels, finest first, and the interpolation onto ``fine`` from ``coarse`` levels.

    ``up[fine][coarse - fine - 1]`` is (index, weight) of `grouping.interpolation_weights`.
    ``skip_rows`` holds, per level, the rows of level 0 that a query-down over two or more levels
    reads; None means the prefix.
    """

    levels: tuple[Level, ...]
    up: tuple[tuple[tuple[Array, Array], ...], ...]
    skip_rows: Int[Array, " n"] | None


def build_pyramid(cloud: Cloud, k: int, skip_rows: Int[Array, " n"] | None = None) -> Pyramid:
    """The pyramid of a cloud given in farthest-point order, with k neighbours per point.

    The kept points of a level are its first rows, so the neighbours of a transition-down are the
    first rows of the level's own neighbours. Every index is found once and shared by all layers.
    """
    n = cloud.points.shape[0]
    clouds = [Cloud(cloud.points[: n >> level], cloud.count >> level) for level in range(LEVELS)]
    levels = tuple(
        Level(count, prefix_mask(len(points), count), knn(points, points, k, count))
        for points, count in clouds
    )
    up = tuple(
        tuple(
            interpolation_weights(clouds[fine].points, *clouds[coarse])
            for coarse in range(fine + 1, LEVELS)
        )
        for fine in range(LEVELS - 1)
    )
    return Pyramid(levels, up, skip_rows)


def build_pyramids(clouds: Cloud, k: int, skip_rows: Int[Array, "2 n"] | None = None) -> Pyramid:
    """The pyramids of two stacked clouds, stacked."""
    return jax.lax.map(lambda one: build_pyramid(one[0], k, one[1]), (clouds, skip_rows))


def query_down(
    features: Float[Array, "n c"], pyramid: Pyramid, fine: int, coarse: int
) -> Float[Array, "m c"]:
    """The rows of a finer level's feature that belong to the points of a coarser level."""
    size = len(pyramid.levels[coarse].valid)
    if pyramid.skip_rows is not None and fine == 0 and coarse > 1:
        # Departure of the released code: its loop over index lists overwrites its own result, so
        # only the last list is applied, to the finest level's rows in input order.
        return jnp.take(features, pyramid.skip_rows[:size], axis=0)
    return features[:size]
