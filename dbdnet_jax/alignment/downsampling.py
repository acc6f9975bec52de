"""From a cloud of any size, place and unit to the few even points that the network sees."""

from bisect import bisect_left
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from dbdnet_jax.alignment.outliers import inlying
from dbdnet_jax.alignment.voxels import MAX_CELLS, first_of_cells, voxel_keys
from dbdnet_jax.ops.sampling import farthest_rows
from dbdnet_jax.types import Points

Rows = Int[np.ndarray, " k"]
Fewer = Int[np.ndarray, " j"]
Fewest = Int[np.ndarray, " i"]

DENSE = 10_000  # points that a pose is judged on; nothing is downsampled below
EVEN = 1024  # farthest points that poses are searched and ranked on, the network's among them
BLOCK = 1_000_000  # rows that a grid thins at once: bounds the memory
SAMPLE = 200_000  # rows that decide a grid's step


class Downsampled(NamedTuple):
    """Rows of a cloud: ``dense`` for the last step and for judging a pose.

    ``even`` are places in these, farthest points first, to search poses on; ``sparse`` are the rows
    of the first of them, for the network. ``centre`` (3,) and ``size`` describe the
    cloud without outliers, in its own unit. ``copies`` are points that stand where another does.
    """

    dense: Rows
    even: Fewer
    sparse: Fewest
    centre: Float[np.ndarray, "3"]
    size: float
    outliers: int
    copies: int = 0  # left out, of a cloud that no grid thins


def downsample(points: Points, sparse: int, dense: int = DENSE) -> Downsampled:
    """Choose rows: without outliers, a voxel grid down to ``dense``, farthest points down to few.

    A point stands once: vertices that each face repeats tell nothing of the cloud's spacing.

    The choice does not depend on the order of the rows, but for the grid's step above `SAMPLE`
    points. Memory: about 100 bytes a point beside the points.
    """
    rows = np.flatnonzero(inlying(points))
    outliers = len(points) - len(rows)
    copies = 0
    if len(rows) > dense:
        rows = _grid(points, rows, np.median(points[rows], axis=0), dense)
    else:
        inlying_rows = len(rows)
        rows = _different(points, rows)
        copies = inlying_rows - len(rows)
    middle = points[rows].mean(axis=0)
    offsets = points[rows] - middle
    outermost = int((offsets**2).sum(axis=1).argmax())
    even = farthest_rows(offsets, max(EVEN, sparse), outermost)
    chosen = rows[even[:sparse]]
    centre = points[chosen].mean(axis=0)
    size = np.quantile(np.linalg.norm(points[chosen] - centre, axis=1), 0.98)
    return Downsampled(rows, even, chosen, centre, float(size), outliers, copies)


def _different(points: Points, rows: Rows) -> Fewer:
    """Rows of different points, in an order of their own."""
    rows = rows[np.lexsort(points[rows].T)]
    again = (np.diff(points[rows], axis=0) == 0).all(axis=1)
    return rows[np.concatenate([[True], ~again])]


def _grid(points: Points, rows: Rows, middle: np.ndarray, dense: int) -> Fewer:
    """The finest grid, by steps of sqrt(2), that leaves at most ``dense`` rows."""
    reach = float(np.abs(points[rows] - middle).max())
    cells = 2.001 * reach / MAX_CELLS * 2.0 ** np.arange(0, 13, 0.5)
    sample = rows[:: -(-len(rows) // SAMPLE)]
    step = bisect_left(
        cells, True, key=lambda c: len(voxel_rows(points, sample, middle, c)) <= dense
    )
    cell = cells[min(step, len(cells) - 1)]
    blocks = (rows[i : i + BLOCK] for i in range(0, len(rows), BLOCK))
    rows = np.concatenate([voxel_rows(points, block, middle, cell) for block in blocks])
    while len(rows := voxel_rows(points, rows, middle, cell)) > dense:
        cell *= 2**0.5
    return rows


def voxel_rows(points: Points, rows: Rows, middle: Float[np.ndarray, "3"], cell: float) -> Fewer:
    """Of every occupied cell of a cubic grid the row nearest to the cell's middle."""
    offsets = points[rows] - middle
    return rows[first_of_cells(voxel_keys(offsets, cell), offsets, cell)]
