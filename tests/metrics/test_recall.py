"""Registration recall: the two definitions, their thresholds, and the two means."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from dbdnet_jax.metrics.recall import (
    ScanRecall,
    Scans,
    correspondence_rmse_m,
    rmse_within_20cm,
    scan_recall,
    scene_mean,
    within_15deg_30cm,
)
from dbdnet_jax.types import Rigid
from tests.conftest import FLOAT64, assert_close, random_cloud


def test_pose_thresholds_are_strict_and_both_must_hold():
    angles = np.array([14.9, 15.0, 14.9, 3.0, np.nan, 3.0, 180.0])
    lengths = np.array([0.29, 0.1, 0.30, 0.4, 0.1, np.nan, 0.0])
    expected = [True, False, False, False, False, False, False]
    assert list(within_15deg_30cm(angles, lengths)) == expected


def test_rmse_threshold_is_strict():
    values = np.array([0.0, 0.199, 0.2, 5.0, np.nan, np.inf])
    assert list(rmse_within_20cm(values)) == [True, True, False, False, False, False]


def test_rmse_is_the_mean_over_correspondences():
    rotation = Rotation.from_rotvec([0.3, -0.2, 0.5]).as_matrix()
    translation = np.array([0.4, 0.1, -0.2])
    source = random_cloud(0, 50)
    target = random_cloud(1, 50)
    total = 0.0
    for s, t in zip(source, target, strict=True):
        total += float(np.sum((rotation @ s + translation - t) ** 2))
    rmse = correspondence_rmse_m(Rigid(rotation, translation), source, target)
    assert_close(rmse, np.sqrt(total / 50), FLOAT64)


def test_rmse_of_a_pure_translation_error_is_its_length():
    source = random_cloud(2, 20)
    offset = np.array([0.1, 0.2, -0.2])
    rmse = correspondence_rmse_m(Rigid(np.eye(3), offset), source, source)
    assert_close(rmse, 0.3, FLOAT64)


def test_rmse_in_float64_for_a_float32_answer():
    rotation = Rotation.from_rotvec([0.3, -0.2, 0.5]).as_matrix().astype(np.float32)
    motion = Rigid(rotation, np.zeros(3, np.float32))
    source = random_cloud(2, 20)
    target = source @ rotation.astype(np.float64).T
    assert correspondence_rmse_m(motion, source, target) < 1e-15


@pytest.mark.parametrize("rows", [0, 4])
def test_rmse_without_correspondence_or_finite_motion_is_no_success(rows):
    motion = Rigid(np.eye(3) if rows == 0 else np.full((3, 3), np.nan), np.zeros(3))
    rmse = correspondence_rmse_m(motion, np.ones((rows, 3)), np.ones((rows, 3)))
    assert np.isnan(rmse) and not rmse_within_20cm(np.array([rmse]))[0]


def test_scene_mean_weighs_scenes_alike_in_any_order():
    scenes = np.array(["kitchen"] * 6 + ["study"] * 2 + ["lab"])
    registered = np.array([1, 1, 1, 1, 1, 1, 0, 1, 0], bool)
    order = np.random.default_rng(0).permutation(9)
    for rows in (slice(None), order):
        assert scene_mean(registered[rows], scenes[rows]) == pytest.approx((1 + 0.5 + 0) / 3)


def scans(scenes, consecutive) -> Scans:
    return Scans(scenes, np.array(consecutive), [])  # the RMSE is given


def test_each_definition_and_each_mean_has_its_name():
    found = scan_recall(
        rotation_error_deg=np.array([1.0, 20.0, 1.0]),
        translation_error_m=np.array([0.1, 0.1, 0.1]),
        rmse_m=np.array([0.3, 0.1, 0.1]),
        scans=scans(["a", "b", "b"], [False, True, False]),
    )
    assert found == ScanRecall(
        recall_15deg_30cm_pair_mean=pytest.approx(2 / 3),
        recall_15deg_30cm_scene_mean=0.75,
        recall_rmse_20cm_pair_mean=pytest.approx(2 / 3),
        recall_rmse_20cm_scene_mean=0.5,
        recall_rmse_20cm_scene_mean_apart=0.5,
    )


def test_consecutive_fragments_only():
    one = np.array([0.1])
    found = scan_recall(one, one, one, scans(["a"], [True]))
    assert found.recall_rmse_20cm_scene_mean == 1.0
    assert found.recall_rmse_20cm_scene_mean_apart is None


@pytest.mark.parametrize(("pairs", "scenes"), [(0, []), (2, ["a"])])
def test_recall_of_nothing_or_of_pairs_without_scene(pairs, scenes):
    errors = np.ones(pairs)
    with pytest.raises(ValueError, match=f"got {pairs} pairs and {len(scenes)} scenes. Give"):
        scan_recall(errors, errors, errors, scans(scenes, [False] * len(scenes)))
