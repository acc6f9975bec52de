"""A cubic grid over a cloud: cells as integers, and one point of each."""

import numpy as np
from jaxtyping import Float, Int

MAX_CELLS = 4096  # along an axis: twelve bits; beyond, cells are taken for one another


def voxel_keys(offsets: Float[np.ndarray, "n 3"], cell: float) -> Int[np.ndarray, " n"]:
    """The cell of every point, by its offset from the grid's middle."""
    index = np.floor(offsets / cell).astype(np.int64) & (MAX_CELLS - 1)
    return index[:, 0] << 24 | index[:, 1] << 12 | index[:, 2]


def first_of_cells(
    keys: Int[np.ndarray, " n"], offsets: Float[np.ndarray, "n 3"], cell: float
) -> Int[np.ndarray, " k"]:
    """Of every occupied cell the row nearest to the cell's middle, by cell."""
    place = offsets / cell
    offset = ((place - np.floor(place) - 0.5) ** 2).sum(axis=1) / 0.75
    # One integer sorts by cell and, within it, by distance: 36 and 27 bits.
    joint = keys << 27 | (offset * (2**27 - 1)).astype(np.int64)
    order = np.argsort(joint)
    return order[np.diff(joint[order] >> 27, prepend=-1) != 0]
