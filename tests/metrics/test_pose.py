"""Metrics against SciPy's rotations, counts by hand, and the rules for broken answers."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from dbdnet_jax.metrics import pose as metrics
from dbdnet_jax.ops import rigid
from dbdnet_jax.types import Branch, Cloud, Pair, Registration, Rigid
from tests.conftest import FLOAT32, Tolerance, assert_close

# Degrees from float32 rotations: an entry is off by about 1e-7 rad, that is 6e-6 degrees, and
# a handful of them are summed.
DEGREES = Tolerance(rtol=1e-5, atol=1e-4)
# The float64 oracle reads a float32 matrix: the same, where y is near 90 degrees and the other two
# angles come from entries of size cos(y).
EULER_DEGREES = Tolerance(rtol=1e-5, atol=2e-3)


def motion(rotation: Rotation, translation=(0.0, 0.0, 0.0)) -> Rigid:
    return Rigid(
        jnp.asarray(rotation.as_matrix(), jnp.float32), jnp.asarray(translation, jnp.float32)
    )


def random_motions(seed: int, count: int) -> list[Rigid]:
    rng = np.random.default_rng(seed)
    return [motion(Rotation.random(rng=rng), rng.uniform(-1, 1, 3)) for _ in range(count)]


def stack(records):
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *records)


@settings(max_examples=60, deadline=None)
@given(
    angle=st.one_of(
        st.sampled_from([0.0, 1e-4, 1e-3, 179.9, 179.999, 180.0]), st.floats(0.0, 180.0)
    ),
    seed=st.integers(0, 1000),
)
def test_rotation_error_is_the_angle_put_in_even_at_0_and_180(angle, seed):
    rng = np.random.default_rng(seed)
    truth = Rotation.random(rng=rng)
    axis = rng.normal(size=3)
    turned = truth * Rotation.from_rotvec(np.deg2rad(angle) * axis / np.linalg.norm(axis))
    found = metrics.rotation_error_deg(motion(turned).rotation, motion(truth).rotation)
    assert_close(found, np.asarray(angle), DEGREES)


def test_errors_of_a_motion_with_itself_are_zero():
    for truth in random_motions(0, 5):
        errors = metrics.motion_errors(truth, truth)
        assert_close(errors.rotation_deg, np.zeros(()), DEGREES)
        assert errors.translation == 0
        assert not np.any(errors.euler_difference_deg) and not np.any(errors.translation_difference)
        assert errors.finite


def test_isotropic_errors_do_not_depend_on_the_frame_of_the_target():
    frame, predicted, truth = random_motions(1, 3)
    here = metrics.motion_errors(predicted, truth)
    there = metrics.motion_errors(rigid.compose(frame, predicted), rigid.compose(frame, truth))
    assert_close(there.rotation_deg, here.rotation_deg, DEGREES)
    assert_close(there.translation, here.translation, FLOAT32)


def test_translation_error_is_the_translation_of_true_inverse_times_predicted():
    predicted, truth = random_motions(2, 2)
    between = rigid.compose(rigid.invert(truth), predicted)
    expected = np.linalg.norm(between.translation)
    assert_close(metrics.translation_error(predicted, truth), expected, FLOAT32)


@pytest.mark.parametrize("y", [None, 89.9, -89.9])
def test_euler_angles_are_scipys(y):
    rng = np.random.default_rng(3)
    for _ in range(20):
        angles = rng.uniform([-180, -90, -180], [180, 90, 180])
        angles[1] = angles[1] if y is None else y
        rotation = Rotation.from_euler("xyz", angles, degrees=True)
        found = metrics.euler_xyz_deg(motion(rotation).rotation)
        tolerance = DEGREES if y is None and abs(angles[1]) < 80 else EULER_DEGREES
        expected = Rotation.from_matrix(np.asarray(motion(rotation).rotation)).as_euler("xyz", True)
        assert_close(found, expected, tolerance)


@pytest.mark.parametrize("y", [90.0, -90.0])
def test_euler_angles_at_gimbal_lock_still_give_the_rotation(y):
    rotation = Rotation.from_euler("xyz", [25.0, y, 40.0], degrees=True)
    found = np.asarray(metrics.euler_xyz_deg(motion(rotation).rotation))
    assert found[2] == 0
    again = Rotation.from_euler("xyz", found, degrees=True)
    assert np.rad2deg((again.inv() * rotation).magnitude()) < 0.05  # cos(y) < 1e-6 became 0


def test_euler_differences_are_not_wrapped():
    predicted = motion(Rotation.from_euler("xyz", [0, 0, 179], degrees=True))
    truth = motion(Rotation.from_euler("xyz", [0, 0, -179], degrees=True))
    errors = metrics.motion_errors(predicted, truth)
    assert_close(errors.euler_difference_deg, np.array([0, 0, 358.0]), DEGREES)
    assert_close(errors.rotation_deg, np.asarray(2.0), DEGREES)


def test_summary_against_numpy_on_known_errors():
    truth = [motion(Rotation.identity(), t) for t in np.zeros((4, 3))]
    angles = np.array([[3.0, 0, 0], [0, 0, 10], [0, 0, -20], [0, 4, 0]])
    steps = np.array([[0.05, 0, 0], [0, 0.2, 0], [0, 0, 0.05], [0, 0, -0.35]])
    predicted = [
        motion(Rotation.from_euler("xyz", a, degrees=True), t)
        for a, t in zip(angles, steps, strict=True)
    ]
    summary = metrics.summarise(jax.vmap(metrics.motion_errors)(stack(predicted), stack(truth)))
    expected = {
        "rmse_euler_deg": np.sqrt((9 + 100 + 400 + 16) / 12),
        "mae_euler_deg": 37 / 12,
        "rmse_translation": np.sqrt((0.0025 + 0.04 + 0.0025 + 0.1225) / 12),
        "mae_translation": 0.65 / 12,
        "error_rotation_deg": 37 / 4,
        "error_translation": 0.65 / 4,
        "median_rotation_deg": 7.0,
        "median_translation": 0.125,
        "recall_5deg_0p1": 1 / 4,
        "recall_15deg_0p3": 2 / 4,
    }
    for name, value in expected.items():
        assert_close(getattr(summary, name), np.asarray(value), DEGREES)
    assert (summary.pairs, summary.non_finite) == (4, 0)


@pytest.mark.parametrize("broken", ["rotation", "translation"])
@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_a_non_finite_answer_counts_as_180_degrees_and_twice_the_translation(broken, value):
    truth = motion(Rotation.from_euler("xyz", [0.3, 0.2, 0.1]), [0.0, 0.6, 0.8])
    bad = truth._replace(**{broken: getattr(truth, broken).at[1].set(value)})
    errors = metrics.motion_errors(bad, truth)
    assert errors.rotation_deg == 180 and not errors.finite
    assert np.all(errors.euler_difference_deg == 180)
    assert_close(errors.translation, np.asarray(2.0), FLOAT32)
    summary = metrics.summarise(stack([errors, metrics.motion_errors(truth, truth)]))
    assert (summary.non_finite, summary.recall_5deg_0p1) == (1, 0.5)
    assert_close(summary.error_rotation_deg, np.asarray(90.0), DEGREES)


def test_a_true_motion_that_is_not_finite_is_refused():
    good = random_motions(4, 1)[0]
    bad = good._replace(translation=good.translation.at[0].set(jnp.nan))
    errors = jax.vmap(metrics.motion_errors)(stack([good, good]), stack([good, bad]))
    with pytest.raises(ValueError, match="true motions must be finite; pair 1 has NaN"):
        metrics.summarise(errors)


def test_no_pairs_are_refused():
    errors = stack([metrics.motion_errors(*random_motions(5, 2))])
    with pytest.raises(ValueError, match="must hold at least one pair"):
        metrics.summarise(jax.tree.map(lambda leaf: leaf[:0], errors))


def test_overlap_counts_by_hand():
    probability = jnp.array([0.9, 0.5, 0.6, 0.2, jnp.nan, jnp.nan, 0.9, 0.1])
    truth = jnp.array([True, True, False, False, True, False, True, True])
    mask = jnp.arange(8) < 6  # the last two are padding
    counts = metrics.overlap_confusion(probability, truth, mask)
    # 0.5 is not above the threshold, and a NaN is wrong whatever the truth
    assert tuple(map(int, counts)) == (1, 2, 1, 2)
    summary = metrics.summarise_overlap(counts)
    assert_close(summary, np.array([2 / 6, 1 / 3, 1 / 3, 1 / 3]), FLOAT32)


def test_overlap_ratios_without_positives_are_zero():
    no, four = np.array(0), np.array(4)
    counts = metrics.Confusion(no, no, four, no)
    assert metrics.summarise_overlap(counts) == (1.0, 0.0, 0.0, 0.0)
    assert metrics.summarise_overlap(metrics.Confusion(no, no, no, no)) is None


def answer_and_pair(seed: int) -> tuple[Registration, Pair]:
    """A registration and a pair of 6 and 5 rows, 5 and 3 of them valid."""
    rng = np.random.default_rng(seed)
    predicted, truth = random_motions(seed, 2)
    clouds = [
        Cloud(jnp.asarray(rng.normal(size=(rows, 3)), jnp.float32), jnp.asarray(count))
        for rows, count in ((6, 5), (5, 3))
    ]
    labels = [jnp.asarray(rng.random(rows) < 0.6) for rows in (6, 5)]
    probabilities = [jnp.asarray(rng.random(rows), jnp.float32) for rows in (6, 5)]
    branch = Branch(jnp.zeros((6, 5)), jnp.zeros((6, 3)), jnp.zeros(6))
    answer = Registration(
        *predicted,
        *probabilities,
        *(p > 0.5 for p in probabilities),
        branch,
        branch,
        jnp.zeros(6),
        jnp.asarray(True),
    )
    return answer, Pair(*clouds, truth, *labels, clouds[0].points, clouds[1].points)


def errors_and_counts(answer: Registration, pair: Pair):
    return (
        metrics.motion_errors(answer.motion, pair.target_from_source),
        metrics.pair_confusion(answer.src_overlap, answer.tgt_overlap, pair),
    )


def test_errors_under_jit_and_vmap_are_those_of_a_loop():
    answers, pairs = zip(*(answer_and_pair(seed) for seed in range(4)), strict=True)
    loop = [errors_and_counts(*each) for each in zip(answers, pairs, strict=True)]
    together = jax.jit(jax.vmap(errors_and_counts))(stack(answers), stack(pairs))
    jax.tree.map(lambda a, b: assert_close(a, b, DEGREES), together, stack(loop))
    counts = together[1]
    assert sum(int(np.sum(count)) for count in counts) == 4 * (5 + 3)
    wrong = counts.false_positive + counts.false_negative
    assert_close(metrics.overlap_error(counts), wrong / 8, FLOAT32)
    assert_close(
        metrics.overlap_f1(counts),
        2 * counts.true_positive / (2 * counts.true_positive + wrong),
        FLOAT32,
    )
    hits = sum(
        int(np.sum((np.asarray(p) > 0.5)[:n] & np.asarray(label)[:n]))
        for answer, pair in zip(answers, pairs, strict=True)
        for p, label, n in (
            (answer.src_overlap, pair.source_overlap, 5),
            (answer.tgt_overlap, pair.target_overlap, 3),
        )
    )
    assert int(np.sum(counts.true_positive)) == hits


@pytest.mark.parametrize("seed", range(3))
def test_point_distance_against_a_search_tree(seed):
    answer, pair = answer_and_pair(seed)
    predicted = answer.motion
    source, target = np.asarray(pair.source.points[:5]), np.asarray(pair.target.points[:3])
    true, moved = (
        source @ np.asarray(motion.rotation).T + np.asarray(motion.translation)
        for motion in (pair.target_from_source, predicted)
    )
    expected = cKDTree(np.concatenate([true, target])).query(moved)[0].mean()
    assert_close(metrics.point_distance(predicted, pair), expected, FLOAT32)
    assert metrics.point_distance(pair.target_from_source, pair) == 0.0
    broken = predicted._replace(rotation=predicted.rotation * np.nan)
    assert np.isfinite(metrics.point_distance(broken, pair))
