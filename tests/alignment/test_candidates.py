"""Which poses are candidates, how they are ranked, and which one is the answer."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from dbdnet_jax.alignment import candidates
from dbdnet_jax.alignment.candidates import Candidate, choose, far_starts, merged, near_starts, rank
from dbdnet_jax.alignment.point_to_plane import refine_point_to_plane
from dbdnet_jax.alignment.success import fit_features, load_coefficients
from dbdnet_jax.alignment.surfaces import PoseFit, inlier_distance, measure_fit, surface
from dbdnet_jax.ops.transforms import (
    angle_between,
    cube_rotations,
    finer_cube_rotations,
    transform_of,
    turn_deg,
)
from dbdnet_jax.types import Transform
from tests.aligning import motion, solid

NO_FIT = PoseFit(0.0, 0.0, 0.0, 0.0, 0.5, 1.0)
MIDDLE = np.zeros(3)


def turned(degrees: float) -> Transform:
    turn = Rotation.from_rotvec([0, 0, degrees], degrees=True)
    return transform_of(turn.as_matrix(), np.zeros(3))


@pytest.fixture(scope="module")
def sides():
    """Two samples of one shape, where they are."""
    return surface(solid(1500, 0)), surface(solid(1500, 1))


@pytest.mark.parametrize(
    ("turns", "count", "gap"), [(cube_rotations(), 24, 63), (finer_cube_rotations(), 48, 57)]
)
def test_every_rotation_is_near_one_of_the_cubes(turns, count, gap):
    assert turns.shape == (count, 3, 3)
    np.testing.assert_allclose(turns[0], np.eye(3))
    drawn = Rotation.random(500, random_state=0).as_matrix()
    apart = [turn_deg(turns.transpose(0, 2, 1) @ one).min() for one in drawn]
    assert max(apart) < gap


def test_starts_keep_the_middle_where_it_is(sides):
    pose = motion(0)
    middle = sides[0].points.mean(axis=0)
    near = near_starts(pose, sides[0])
    assert len(near) == 7
    for start in near:
        np.testing.assert_allclose(
            start[:3, :3] @ middle + start[:3, 3], pose[:3, :3] @ middle + pose[:3, 3], atol=1e-9
        )
    assert [round(angle_between(x, pose)[0]) for x in near] == [0] + [30] * 6
    assert len(far_starts(*sides)) == 24


def test_of_poses_that_fit_alike_the_nearest_is_the_answer():
    some = [Candidate(turned(a), NO_FIT, s) for a, s in ((120, 2.0), (40, 1.8), (5, -3.0))]
    assert choose(some, None, MIDDLE) == 1
    some[0] = some[0]._replace(score=2.0 + candidates.ALIKE)
    assert choose(some, None, MIDDLE) == 0


def test_a_guess_is_left_only_for_what_fits_clearly_better():
    some = [Candidate(turned(a), NO_FIT, s) for a, s in ((120, 2.0), (10, 0.0))]
    assert choose(some, turned(0), MIDDLE) == 1
    some[1] = some[1]._replace(score=1.9 - candidates.CLEARLY)
    assert choose(some, turned(0), MIDDLE) == 0
    assert choose(some, turned(100), MIDDLE) == 0


def test_a_pose_that_fits_nowhere_is_bad_by_so_much_and_no_more():
    features = fit_features(NO_FIT)
    parts = features.tight, features.tight_per_inlier, features.inliers
    np.testing.assert_allclose(parts, np.log(0.01))  # the logarithm of a part of 0 is cut off


def test_each_pose_is_listed_once():
    first = [Candidate(turned(a), NO_FIT, s) for a, s in ((0, 1.0), (90, 0.5))]
    second = [Candidate(turned(a), NO_FIT, s) for a, s in ((3, 2.0), (180, 0.7))]
    found = merged(first, second, middle=MIDDLE)
    assert [x.score for x in found] == [2.0, 0.7, 0.5]


def test_the_best_ranked_poses_are_refined_again(sides, monkeypatch):
    wanted = []

    def keep(pose, *_):
        wanted.append(pose)
        return pose

    monkeypatch.setattr(candidates, "refined_on_even_points", keep)
    found = candidates.examine(far_starts(*sides), *sides, load_coefficients())
    assert len(found) > len(wanted) == candidates.REFINED_AGAIN
    for one, pose in zip(found, wanted, strict=False):
        np.testing.assert_array_equal(one.pose, pose)


def test_poses_refined_again_are_among_the_candidates(sides, monkeypatch):
    exact = np.eye(4)
    monkeypatch.setattr(candidates, "refined_on_even_points", lambda *_: exact)
    found = candidates.examine(far_starts(*sides)[1:], *sides, load_coefficients())
    assert any((one.pose == exact).all() for one in found)


def test_the_right_pose_ranks_first(sides):
    wrong = [motion(seed, 40.0, 0.1) for seed in range(5)]
    best = rank([*wrong, np.eye(4)], *sides, load_coefficients())[0]
    np.testing.assert_array_equal(best.pose, np.eye(4))
    assert best.fit.source_tight > 0.5


def test_a_small_overlap_that_lies_well_beats_a_large_one_that_does_not():
    whole = solid(4000, 0)
    left = whole[whole[:, 0] < np.quantile(whole[:, 0], 0.6)]
    other = solid(4000, 1)
    right = other[other[:, 0] > np.quantile(other[:, 0], 0.4)]
    sides = surface(left), surface(right)
    over = transform_of(np.eye(3), right.mean(axis=0) - left.mean(axis=0))
    best = rank([over, np.eye(4)], *sides, load_coefficients())[0]
    np.testing.assert_array_equal(best.pose, np.eye(4))


def test_the_last_step_is_precise(sides):
    radii = (inlier_distance(*sides),) * 12
    found = refine_point_to_plane(motion(0, 3.0, 0.02), *sides, radii)
    assert angle_between(found, np.eye(4))[0] < 0.3
    nothing = motion(0, 3.0) + np.array([[0, 0, 0, 50.0]] * 3 + [[0, 0, 0, 0]])
    np.testing.assert_array_equal(refine_point_to_plane(nothing, *sides, radii), nothing)
    assert measure_fit(nothing, *sides, radii[0]) == NO_FIT
