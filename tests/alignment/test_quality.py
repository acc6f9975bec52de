"""What holds a pose, what leaves it free, and whether clouds share points."""

import numpy as np
import pytest
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from dbdnet_jax.alignment.quality import (
    CHANCE_RATIO,
    Motion,
    PoseQuality,
    assess_pose,
    in_words,
    shared_point_score,
)
from dbdnet_jax.alignment.surfaces import inlier_distance, surface
from dbdnet_jax.ops.sampling import farthest_rows
from tests.aligning import solid
from tests.conftest import random_cloud


def plane(count: int, seed: int) -> np.ndarray:
    points = random_cloud(seed, count) * [0.7, 0.7, 0]
    return points + 0.003 * np.random.default_rng(seed).normal(size=points.shape)


def cylinder(count: int, seed: int) -> np.ndarray:
    x, y, _ = random_cloud(seed, count).T
    return np.stack([0.3 * np.cos(np.pi * x), 0.3 * np.sin(np.pi * x), y], axis=1)


def sphere(count: int, seed: int) -> np.ndarray:
    points = np.random.default_rng(seed).normal(size=(count, 3))
    return points / np.linalg.norm(points, axis=1, keepdims=True)


def on_a_floor(count: int, seed: int) -> np.ndarray:
    floor = random_cloud(seed, 20 * count // 21) * [1.0, 1.0, 0.0]
    return np.vstack([0.2 * solid(count // 21, seed) + [0, 0, 0.06], floor])


def on_a_wide_floor(thing: np.ndarray, count: int, seed: int) -> np.ndarray:
    """A thing of few points, and a floor some four times as wide."""
    floor = random_cloud(seed, count - len(thing)) * [1.0, 1.0, 0.0]
    return np.vstack([thing, floor]) + 0.001 * random_cloud(seed + 9, count)


def radiator(count: int, seed: int) -> np.ndarray:
    """A board: its ends, hardly any of the points, hold it along itself."""
    board = random_cloud(seed, count // 15) * [0.25, 0.06, 0.12] + [0, 0, 0.15]
    side = random_cloud(seed + 1, count // 15)[:, 0]
    board[:, 1] = np.where(side > 0, 0.06, -0.06)
    end = np.abs(side) < 0.1
    board[end, 0], board[end, 1] = 0.25, 0.6 * side[end]
    return on_a_wide_floor(board, count, seed)


def bottle(count: int, seed: int) -> np.ndarray:
    return on_a_wide_floor(cylinder(count // 10, seed) * 0.3 + [0, 0, 0.3], count, seed)


def assessed(source: np.ndarray, target: np.ndarray) -> PoseQuality:
    """The quality of no motion between two clouds."""
    sides = surface(source), surface(target)
    return assess_pose(source, sides[1], inlier_distance(*sides))


@pytest.mark.parametrize(
    ("shape", "words"),
    [
        (plane, "translation along every axis normal to [0 0 1] and rotation about [0 0 1]"),
        (cylinder, "translation along [0 0 1] and rotation about [0 0 1]"),
        (sphere, "rotation about every axis"),
        (solid, ""),
        (on_a_floor, ""),
        (radiator, ""),
        (bottle, "rotation about [0 0 1]"),
    ],
)
def test_degenerate_motions_are_named(shape, words):
    quality = assessed(shape(9000, 1), shape(9000, 2))
    assert in_words(tuple(_snap(motion) for motion in quality.degenerate_motions)) == words


def _snap(motion: Motion) -> Motion:
    """The axis without its last degrees of noise, if it is an axis of the frame."""
    near = np.abs(motion.direction) < 0.08
    return motion if near.sum() < 2 else motion._replace(direction=np.where(near, 0, 1.0))


def test_information_is_the_curvature_of_the_plane_residuals():
    quality = assessed(solid(2000, 1), solid(2000, 2))
    assert np.all(np.linalg.eigvalsh(quality.information) > 0)
    # 2000 points that are off by plane_rmse fix a translation to about this, in each direction.
    sigma = np.sqrt(np.diag(np.linalg.inv(quality.information))[3:])
    assert np.all(sigma < 10 * quality.plane_rmse / np.sqrt(2000))


@pytest.mark.parametrize("even", [False, True])
def test_points_coincide_where_clouds_share_them_in_the_right_pose_only(even):
    points, others = cylinder(2000, 1), cylinder(2000, 2)
    if even:
        points, others = (cloud[farthest_rows(cloud, 1200)] for cloud in (points, others))
    turn = Rotation.from_rotvec([0, 0, 20], degrees=True).as_matrix()
    spacing = np.median(cKDTree(points).query(points, k=2)[0][:, 1])
    noisy = points + random_cloud(3, len(points)) * 0.2 * spacing

    def between(source, target):
        sides = surface(source), surface(target)
        return shared_point_score(source, sides[1], inlier_distance(*sides))

    assert between(points, points) == CHANCE_RATIO
    assert between(noisy, points) > 0.3
    assert between(points @ turn.T, points) < 0.02 and between(others, points) < 0.02
    assert between(points + 9.0, points) == 0.0
