"""How a moved surface lies on another one."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from dbdnet_jax.alignment.quality import shared_point_score
from dbdnet_jax.alignment.surfaces import inlier_distance, mapped, surface
from tests.aligning import solid


def grid(step: float) -> np.ndarray:
    """A plane patch of points a ``step`` apart."""
    axis = np.arange(0, 1 + step / 2, step)
    x, y = np.meshgrid(axis, axis)
    return np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1)


@pytest.mark.parametrize("swapped", [False, True])
def test_the_wider_spacing_of_two_clouds_says_how_far_apart_inliers_may_be(swapped):
    clouds = surface(grid(0.02)), surface(grid(0.1))
    assert inlier_distance(*clouds[:: -1 if swapped else 1]) == pytest.approx(0.2)


def test_points_in_common_are_told_by_the_targets_own_spacing():
    rng = np.random.default_rng(0)
    points = rng.uniform(0, 1, (400, 3)) * [1.0, 1.0, 0.0]
    # Six copies of every point, a tenth of the target's spacing off: by their own spacing, which is
    # a sixth of the target's, half of them would be no nearer than chance has it.
    moved = np.concatenate([points + rng.normal(0, 0.002, points.shape) for _ in range(6)])
    assert shared_point_score(moved, surface(points), 0.1) > 0.7


def test_no_evidence_for_points_in_common_is_none_against_them():
    rng = np.random.default_rng(0)
    points, others = (rng.uniform(0, 1, (400, 3)) * [1.0, 1.0, 0.0] for _ in range(2))
    target = surface(points)
    distance = inlier_distance(target, target)
    assert shared_point_score(others, target, distance) == 0.0
    # Just within the reach of inliers: what is beside them is capped at that reach too.
    lifted = points + [0.0, 0.0, 0.94 * distance]
    assert shared_point_score(lifted, target, distance) < 0.01


@pytest.mark.parametrize("last", [1.0, -1.0])
def test_a_moved_or_reflected_surface_is_that_of_the_moved_points(last):
    points = solid(500, 1)
    turn = Rotation.from_euler("xyz", [20, -50, 70], degrees=True).as_matrix() * [1.0, 1.0, last]
    moved = points @ turn.T + [0.3, 0.0, -2.0]
    found, expected = mapped(surface(points, np.arange(9)), moved, turn), surface(moved)
    cosines = np.abs((found.normals * expected.normals).sum(axis=1))
    np.testing.assert_allclose(cosines, 1.0, atol=1e-9)
    assert found.spacing == pytest.approx(expected.spacing)
    np.testing.assert_array_equal(found.even, np.arange(9))
    np.testing.assert_array_equal(found.tree.query(moved[:5])[1], np.arange(5))
