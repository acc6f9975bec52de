"""Local refinement: what it improves, what it must leave alone, and its oracle in NumPy."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from dbdnet_jax.classical import refine as module
from dbdnet_jax.classical.refine import (
    CAP,
    refine,
    refine_from_rotations,
    refine_multistart,
    truncated_rmse,
)
from dbdnet_jax.data.procedural.shapes import procedural_shapes
from dbdnet_jax.types import Cloud, Rigid
from tests.conftest import EXACT, FLOAT32, Tolerance, assert_close, assert_finite

SIZE = 300
SMALL = 1e-4  # float32 after thirty steps
PADDING = Tolerance(rtol=1e-4, atol=1e-4)  # sums of another length, thirty steps after each other


def motion(degrees: float, shift: float = 0.0) -> Rigid:
    """About a fixed slanted axis, and along one."""
    rotation = Rotation.from_rotvec(degrees * np.array([0.6, 0.0, 0.8]), degrees=True).as_matrix()
    return Rigid(jnp.asarray(rotation, jnp.float32), jnp.full(3, shift, jnp.float32))


IDENTITY = motion(0.0)


def cloud(points: np.ndarray, size: int = SIZE) -> Cloud:
    padded = np.full((size, 3), np.nan, np.float32)
    padded[: len(points)] = points
    return Cloud(jnp.asarray(padded), jnp.asarray(len(points)))


@pytest.fixture(scope="module")
def points() -> np.ndarray:
    """(300, 3), evenly spaced on a shape without symmetry (a bed with a side table)."""
    return procedural_shapes(9, seed=0).points[8][:SIZE].astype(np.float64)


@pytest.fixture(scope="module")
def crops(points: np.ndarray) -> tuple[Cloud, Cloud]:
    """Two parts of the shape that share about half of their points; the true motion is none."""
    along = points @ [0.5, 0.6, 0.62]
    order = np.argsort(along)
    noise = np.random.default_rng(0).normal(0, 0.005, (2, 220, 3))
    return cloud(points[order[:220]] + noise[0]), cloud(points[order[80:]] + noise[1])


def angle_deg(found: Rigid) -> float:
    return float(np.degrees(Rotation.from_matrix(np.asarray(found.rotation)).magnitude()))


def test_a_perfect_pose_stays(points):
    found = refine(cloud(points), cloud(points), IDENTITY)
    assert_close(found.target_from_source.rotation, np.eye(3), Tolerance(0.0, SMALL))
    assert_close(found.target_from_source.translation, np.zeros(3), Tolerance(0.0, SMALL))
    assert found.truncated_rmse < 1e-3  # the square root of float32's error of a squared distance


@pytest.mark.parametrize("degrees", [3.0, 8.0, 15.0])
def test_a_pose_near_the_truth_comes_closer(crops, degrees):
    start = motion(degrees, 0.03)
    found = refine(*crops, start)
    assert found.accepted
    assert found.truncated_rmse < truncated_rmse(*crops, start)
    assert angle_deg(found.target_from_source) < 1.5
    assert np.linalg.norm(found.target_from_source.translation) < 0.03


def test_the_answer_moves_with_the_clouds(crops):
    """The source turned and the target shifted far away: the same motion between them."""
    source, target = crops
    turn, start = motion(40.0), motion(6.0, 0.02)
    offset = jnp.array([3.0, -2.0, 5.0])
    turned = Cloud(source.points @ turn.rotation.T, source.count)
    shifted = Cloud(target.points + offset[None, :], target.count)
    given = Rigid(start.rotation @ turn.rotation.T, start.translation + offset)
    found = refine(turned, shifted, given).target_from_source
    plain = refine(source, target, start).target_from_source
    assert_close(found.rotation @ turn.rotation, plain.rotation, Tolerance(0.0, 2e-3))
    assert_close(found.translation - offset, plain.translation, Tolerance(0.0, 2e-3))


def test_a_result_that_fits_worse_is_rejected(crops, monkeypatch):
    monkeypatch.setattr(
        module, "_step", lambda _, at, __: at._replace(translation=at.translation + 0.01)
    )
    start = motion(1.0)
    found = refine(*crops, start, iterations=9)  # a program of its own
    assert not found.accepted
    assert_close(found.target_from_source.rotation, start.rotation, EXACT)
    assert_close(found.target_from_source.translation, start.translation, FLOAT32)
    assert_close(found.truncated_rmse, truncated_rmse(*crops, start), FLOAT32)


@pytest.mark.parametrize(("worse", "accepted"), [(1.01, True), (1.04, False)])
def test_a_pose_may_fit_worse_by_two_percent(crops, monkeypatch, worse, accepted):
    """The right pose of disjoint draws often fits a little worse than the one before."""
    values = iter((0.03, 0.03 * worse))
    monkeypatch.setattr(module, "_truncated_rmse", lambda *_: jnp.float32(next(values)))
    found = refine(*crops, motion(1.0), iterations=3 if accepted else 4)  # programs of their own
    assert bool(found.accepted) is accepted


def test_padding_changes_nothing(crops):
    start = motion(5.0, 0.02)
    longer = [cloud(np.asarray(c.points)[: int(c.count)], 2 * SIZE) for c in crops]
    assert_close(truncated_rmse(*longer, start), truncated_rmse(*crops, start), FLOAT32)
    short, long = (refine(*pair, start).target_from_source for pair in (crops, longer))
    assert_close(long.rotation, short.rotation, PADDING)
    assert_close(long.translation, short.translation, PADDING)


def test_the_residual_equals_its_definition(crops):
    start = motion(7.0, 0.02)
    source, target = (np.float64(c.points)[: int(c.count)] for c in crops)
    moved = source @ np.float64(start.rotation).T + np.float64(start.translation)
    ways = cKDTree(target).query(moved)[0], cKDTree(moved).query(target)[0]
    expected = np.sqrt((np.minimum(np.concatenate(ways), CAP) ** 2).mean())
    assert_close(truncated_rmse(*crops, start), expected, Tolerance(rtol=1e-4, atol=0.0))


def test_turns_are_refined_each_for_itself(crops):
    """About the principal axes through the middle of the moved source, the pose itself first."""
    source, target = crops
    pose = motion(6.0, 0.02)
    found = refine_from_rotations(source, target, pose, (-120.0, 120.0))
    moved = np.float64(source.points[: int(source.count)]) @ np.float64(pose.rotation).T + 0.02
    middle = moved.mean(axis=0)
    for k, axis in enumerate(np.linalg.svd(moved - middle)[2][::-1]):
        ends = []
        for degrees in (-120, 120):
            turn = Rotation.from_rotvec(degrees * axis, degrees=True).as_matrix()
            start = Rigid(turn @ pose.rotation, middle + turn @ (pose.translation - middle))
            ends.append(refine(source, target, jax.tree.map(jnp.float32, start)))
        # An axis may point either way, so the two turns about it may change places.
        rows = [1 + 2 * k, 2 + 2 * k]
        if abs(float(found.truncated_rmse[rows[0]] - ends[0].truncated_rmse)) > 1e-5:
            rows.reverse()
        for row, end in zip(rows, ends, strict=True):
            here = jax.tree.map(lambda leaf, row=row: leaf[row], found.target_from_source)
            assert_close(here.rotation, end.target_from_source.rotation, Tolerance(0.0, 0.02))
            assert_close(here.translation, end.target_from_source.translation, Tolerance(0.0, 0.02))
    own = refine(source, target, pose)
    assert_close(found.target_from_source.rotation[0], own.target_from_source.rotation, PADDING)


def test_restarts_leave_a_local_minimum_and_trusts_the_first(crops, monkeypatch):
    source, target = crops
    lost = motion(78.0)
    assert angle_deg(refine(source, target, lost).target_from_source) > 5
    assert angle_deg(refine_multistart(source, target, lost).target_from_source) < 2
    monkeypatch.setattr(module, "MARGIN", 0.95)  # no other pose fits so much better
    refine_multistart.clear_cache()
    trusting = refine_multistart(source, target, lost).target_from_source
    refine_multistart.clear_cache()
    assert_close(
        trusting.rotation, refine(source, target, lost).target_from_source.rotation, PADDING
    )


def test_large_clouds_are_thinned_evenly(points):
    limit = module.MOST_POINTS
    dense = np.tile(points, (10, 1))
    fewer = module._downsample(cloud(dense, 4096))
    assert fewer.points.shape == (limit, 3) and fewer.count == limit
    rows = np.arange(limit) * len(dense) // limit
    assert_close(fewer.points, np.float32(dense[rows]), EXACT)
    few = module._downsample(cloud(points, 4096))
    assert few.count == SIZE
    assert_close(few.points[:SIZE], np.float32(points), EXACT)


def test_clouds_of_little_use_keep_the_pose_finite(degenerate):
    start = motion(10.0, 0.1)
    for other in (degenerate, degenerate + 9.0, degenerate[:1]):
        found = refine(cloud(degenerate), cloud(other), start)
        assert_finite((found, refine_multistart(cloud(degenerate), cloud(other), start)))
        rotation = np.asarray(found.target_from_source.rotation)
        assert_close(rotation @ rotation.T, np.eye(3), Tolerance(0.0, SMALL))
    nothing = cloud(np.zeros((0, 3)))
    assert_finite(refine(nothing, nothing, start))
