"""What the surface around a point looks like, whatever the motion and the sides of the normals."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from dbdnet_jax.alignment.features import BINS, SCALES, angle_histograms
from dbdnet_jax.alignment.surfaces import Surface, surface
from tests.aligning import motion, solid


@pytest.fixture(scope="module")
def side() -> Surface:
    return surface(solid(600, 0))


def by_hand(side: Surface, row: int, radius: float, most: int) -> np.ndarray:
    """(3, bins) parts of a point's neighbours, one neighbour after another."""
    offsets = side.points - side.points[row]
    distance = np.linalg.norm(offsets, axis=1)
    near = [i for i in np.argsort(distance)[:most] if 0 < distance[i] <= radius]
    lines = [offsets[i] / distance[i] for i in near]
    normal = side.normals[row] * (-1 if side.normals[row] @ np.sum(lines, axis=0) > 0 else 1)
    counts = np.zeros((3, BINS))
    for i, line in zip(near, lines, strict=True):
        other = side.normals[i] * (-1 if side.normals[i] @ normal < 0 else 1)
        for kind, cosine in enumerate((line @ normal, line @ other, 2 * (normal @ other) - 1)):
            counts[kind, min(int((cosine + 1) * BINS / 2), BINS - 1)] += 1
    return counts / len(near)


def test_they_are_the_parts_of_the_neighbours_in_each_bin(side):
    found = angle_histograms(side).reshape(-1, len(SCALES), 3, BINS) ** 2
    for row in (0, 17, 400):
        for scale, (radius, most) in enumerate(SCALES):
            np.testing.assert_allclose(found[row, scale], by_hand(side, row, radius, most))


def test_neither_a_motion_nor_the_sides_of_normals_change_them(side):
    turn = Rotation.random(random_state=1).as_matrix()
    flips = np.where(np.random.default_rng(0).random(len(side.points)) < 0.5, -1.0, 1.0)
    points = side.points @ turn.T + motion(2)[:3, 3]
    moved = surface(points)._replace(normals=(side.normals @ turn.T) * flips[:, None])
    apart = np.abs(angle_histograms(moved) - angle_histograms(side)).max(axis=1)
    # A cosine on the edge of a bin may fall to either side, and across a right angle a normal may
    # be turned either way.
    assert np.median(apart) < 0.1 and np.mean(apart > 0.4) < 0.1


def test_a_point_far_from_all_others_has_none():
    points = np.vstack([solid(100, 0), [[9.0, 9.0, 9.0]]])
    found = angle_histograms(surface(points))
    assert np.isfinite(found).all() and not found[-1].any()
