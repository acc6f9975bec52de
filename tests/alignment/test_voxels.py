"""Cells of a grid, and which point of each is kept."""

import numpy as np

from dbdnet_jax.alignment.voxels import first_of_cells, voxel_keys

CELL = 0.5


def test_a_cell_keeps_the_point_nearest_to_its_middle():
    middles = np.array([[0.25, 0.25, 0.25], [0.75, 0.25, -0.25]])
    near_the_corner = middles - 0.2  # the corners are 0.25 away along each axis
    near_the_middle = middles + 0.05
    points = np.concatenate([near_the_corner, near_the_middle])
    kept = first_of_cells(voxel_keys(points, CELL), points, CELL)
    assert sorted(kept) == [2, 3]


def test_each_occupied_cell_has_one_point_whatever_their_order():
    rng = np.random.default_rng(0)
    points = rng.uniform(-1, 1, (500, 3))
    cells = {tuple(cell) for cell in np.floor(points / CELL)}
    kept = first_of_cells(voxel_keys(points, CELL), points, CELL)
    assert len(kept) == len(cells)
    order = rng.permutation(len(points))
    again = first_of_cells(voxel_keys(points[order], CELL), points[order], CELL)
    assert set(order[again]) == set(kept)
