"""Local refinement: what it improves, what it must leave alone, and its oracle in NumPy."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from dbdnet_jax import polish as module
from dbdnet_jax.data.procedural import procedural_shapes
from dbdnet_jax.polish import CAP, choose, polish, residual
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
    found = polish(cloud(points), cloud(points), IDENTITY)
    assert_close(found.target_from_source.rotation, np.eye(3), Tolerance(0.0, SMALL))
    assert_close(found.target_from_source.translation, np.zeros(3), Tolerance(0.0, SMALL))
    assert found.residual < 1e-3  # the square root of float32's error of a squared distance


@pytest.mark.parametrize("degrees", [3.0, 8.0, 15.0])
def test_a_pose_near_the_truth_comes_closer(crops, degrees):
    start = motion(degrees, 0.03)
    found = polish(*crops, start)
    assert found.accepted
    assert found.residual < residual(*crops, start)
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
    found = polish(turned, shifted, given).target_from_source
    plain = polish(source, target, start).target_from_source
    assert_close(found.rotation @ turn.rotation, plain.rotation, Tolerance(0.0, 2e-3))
    assert_close(found.translation - offset, plain.translation, Tolerance(0.0, 2e-3))


def test_a_result_that_fits_worse_is_rejected(crops, monkeypatch):
    monkeypatch.setattr(
        module, "_step", lambda motion, *_: motion._replace(translation=motion.translation + 0.01)
    )
    start = motion(1.0)
    found = polish(*crops, start, iterations=9)  # a program of its own
    assert not found.accepted
    assert_close(found.target_from_source.rotation, start.rotation, EXACT)
    assert_close(found.target_from_source.translation, start.translation, FLOAT32)
    assert_close(found.residual, residual(*crops, start), FLOAT32)


def test_padding_changes_nothing(crops):
    start = motion(5.0, 0.02)
    longer = [cloud(np.asarray(c.points)[: int(c.count)], 2 * SIZE) for c in crops]
    assert_close(residual(*longer, start), residual(*crops, start), FLOAT32)
    short, long = (polish(*pair, start).target_from_source for pair in (crops, longer))
    assert_close(long.rotation, short.rotation, PADDING)
    assert_close(long.translation, short.translation, PADDING)


def test_a_point_of_no_weight_is_no_point(crops):
    """Rows of overlap 0 may stand anywhere in the source."""
    source, target = crops
    weights = jnp.where(jnp.arange(SIZE) < 200, 1.0, 0.0)
    ones = jnp.ones(SIZE)
    far = source._replace(points=source.points.at[200:].add(50.0))
    moved, given = (residual(c, target, IDENTITY, weights, 0 * ones) for c in (far, source))
    assert_close(moved, given, FLOAT32)
    assert residual(far, target, IDENTITY, ones, ones) > given


def test_the_residual_equals_its_definition(crops):
    start = motion(7.0, 0.02)
    source, target = (np.float64(c.points)[: int(c.count)] for c in crops)
    moved = source @ np.float64(start.rotation).T + np.float64(start.translation)
    ways = cKDTree(target).query(moved)[0], cKDTree(moved).query(target)[0]
    expected = np.sqrt((np.minimum(np.concatenate(ways), CAP) ** 2).mean())
    assert_close(residual(*crops, start), expected, Tolerance(rtol=1e-4, atol=0.0))


def test_choose_takes_the_best_and_trusts_the_first(crops):
    angles = (2.0, 0.0, 20.0)
    stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *map(motion, angles))
    assert_close(choose(*crops, stacked).rotation, np.eye(3), FLOAT32)
    trusting = choose(*crops, stacked, margin=0.9)
    assert_close(trusting.rotation, motion(2.0).rotation, FLOAT32)


def test_large_clouds_are_thinned_evenly(points):
    limit = module.MOST_POINTS
    dense = np.tile(points, (10, 1))
    view = module._thin(cloud(dense, 4096), None)
    assert view.cloud.points.shape == (limit, 3) and view.cloud.count == limit
    rows = np.arange(limit) * len(dense) // limit
    assert_close(view.cloud.points, np.float32(dense[rows]), EXACT)
    few = module._thin(cloud(points, 4096), None)
    assert few.cloud.count == SIZE and float(few.weight.sum()) == SIZE


def test_clouds_of_little_use_keep_the_pose_finite(degenerate):
    start = motion(10.0, 0.1)
    for other in (degenerate, degenerate + 9.0, degenerate[:1]):
        found = polish(cloud(degenerate), cloud(other), start)
        assert_finite(found)
        rotation = np.asarray(found.target_from_source.rotation)
        assert_close(rotation @ rotation.T, np.eye(3), Tolerance(0.0, SMALL))
    nothing = cloud(np.zeros((0, 3)))
    assert_finite(polish(nothing, nothing, start))
