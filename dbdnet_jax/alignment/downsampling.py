"""From a cloud of any size, place and unit to the few even points that the network sees."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

Points = Float[np.ndarray, "n 3"]
Rows = Int[np.ndarray, " k"]
Fewer = Int[np.ndarray, " j"]

DENSE = 10_000  # points that a pose is refined and judged on; nothing is downsampled below
BLOCK = 1_000_000  # rows that a grid thins at once: bounds the memory
SAMPLE = 200_000  # rows that decide a grid's step
MAX_CELLS = 4096  # along an axis: twelve bits
OUTLIER_DISTANCE = 3.0  # points farther from the middle than this times the size are left out
# The size of a partial scan of a shape in the unit sphere: the median of the larger one of a pair
# under the paper's protocol, on the training shapes. Its logarithm varies by 0.12.
UNIT_SIZE = 0.95


class Downsampled(NamedTuple):
    """Rows of a cloud: ``dense`` for judging a pose, ``sparse`` of them for the network.

    ``centre`` (3,) and ``size`` describe the cloud without outliers, in its own unit.
    """

    dense: Rows
    sparse: Fewer
    centre: Float[np.ndarray, "3"]
    size: float
    outliers: int


def downsample(points: Points, sparse: int, dense: int = DENSE) -> Downsampled:
    """Choose rows: a voxel grid down to ``dense``, farthest points down to ``sparse``.

    The choice does not depend on the order of the rows, but for the grid's step above `SAMPLE`
    points. Memory: about 100 bytes a point beside the points.
    """
    middle = np.median(points, axis=0)
    distance = np.linalg.norm(points - middle, axis=1)
    reach = OUTLIER_DISTANCE * float(np.quantile(distance, 0.98))
    rows = np.flatnonzero(distance <= reach)
    outliers = len(points) - len(rows)
    if len(rows) > dense:
        rows = _grid(points, rows, middle, reach, dense)
    middle = points[rows].mean(axis=0)
    chosen = rows[farthest_rows(points[rows] - middle, sparse)]
    centre = points[chosen].mean(axis=0)
    size = np.quantile(np.linalg.norm(points[chosen] - centre, axis=1), 0.98)
    return Downsampled(rows, chosen, centre, float(size), outliers)


def _grid(points: Points, rows: Rows, middle: np.ndarray, reach: float, dense: int) -> Fewer:
    """The finest grid, by steps of sqrt(2), that leaves at most ``dense`` rows."""
    cell = 2.001 * reach / MAX_CELLS
    while len(voxel_rows(points, rows[:: -(-len(rows) // SAMPLE)], middle, cell)) > dense:
        cell *= 2**0.5
    blocks = (rows[i : i + BLOCK] for i in range(0, len(rows), BLOCK))
    rows = np.concatenate([voxel_rows(points, block, middle, cell) for block in blocks])
    while len(rows := voxel_rows(points, rows, middle, cell)) > dense:
        cell *= 2**0.5
    return rows


def voxel_rows(points: Points, rows: Rows, middle: Float[np.ndarray, "3"], cell: float) -> Fewer:
    """Of every occupied cell of a cubic grid the row nearest to the cell's middle.

    The grid may be at most `MAX_CELLS` wide; beyond, cells are taken for one another.
    """
    place = (points[rows] - middle) / cell
    index = np.floor(place)
    offset = ((place - index - 0.5) ** 2).sum(axis=1) / 0.75
    index = index.astype(np.int64) & (MAX_CELLS - 1)
    # One integer sorts by cell and, within it, by distance: 3 x 12 and 27 bits.
    key = (index[:, 0] << 24 | index[:, 1] << 12 | index[:, 2]) << 27
    key |= (offset * (2**27 - 1)).astype(np.int64)
    order = np.argsort(key)
    return rows[order[np.diff(key[order] >> 27, prepend=-1) != 0]]


def farthest_rows(points: Points, count: int) -> Rows:
    """Rows of ``count`` farthest-point samples, first the one farthest from the origin.

    Fewer where only copies of the chosen points are left.
    """
    columns = np.ascontiguousarray(points.T)
    distance = np.full(len(points), np.inf)
    row = int((columns**2).sum(axis=0).argmax())
    chosen: list[int] = []
    while len(chosen) < count and distance[row] > 0:
        chosen.append(row)
        step = columns - columns[:, row, None]
        np.minimum(distance, np.einsum("ij,ij->j", step, step), out=distance)
        row = int(distance.argmax())
    return np.array(chosen)
