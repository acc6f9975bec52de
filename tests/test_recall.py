"""Registration recall: the two definitions, their thresholds, and the two means."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from dbdnet_jax.recall import (
    correspondence_rmse_m,
    recall,
    recall_table,
    rmse_within_20cm,
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


def test_scene_mean_weighs_scenes_alike():
    scenes = ["kitchen"] * 6 + ["study"] * 2 + ["lab"]
    registered = np.array([1, 1, 1, 1, 1, 1, 0, 1, 0], bool)
    result = recall(registered, scenes)
    assert result.by_scene == {"kitchen": 1.0, "lab": 0.0, "study": 0.5}
    assert result.pair_mean == pytest.approx(7 / 9)
    assert result.scene_mean == pytest.approx(0.5)


def test_recall_ignores_the_order_of_pairs():
    scenes = ["a", "b", "b", "c", "a", "c", "c"]
    registered = np.array([1, 0, 1, 1, 0, 1, 0], bool)
    order = np.random.default_rng(0).permutation(7)
    assert recall(registered, scenes) == recall(registered[order], [scenes[i] for i in order])


def test_table_names_every_definition():
    table = recall_table(
        rotation_error_deg=np.array([1.0, 20.0, 1.0]),
        translation_error_m=np.array([0.1, 0.1, 0.1]),
        rmse_m=np.array([0.3, 0.1, 0.1]),
        scenes=["a", "b", "b"],
        consecutive=np.array([False, True, False]),
    )
    assert table == {
        "recall (R < 15 deg, t < 0.3 m), pair mean": pytest.approx(2 / 3),
        "recall (R < 15 deg, t < 0.3 m), scene mean": 0.75,
        "recall (RMSE < 0.2 m), pair mean": pytest.approx(2 / 3),
        "recall (RMSE < 0.2 m), scene mean": 0.5,
        "recall (RMSE < 0.2 m, fragments not consecutive), scene mean": 0.5,
    }


def test_table_of_consecutive_fragments_only():
    one = np.array([1.0])
    table = recall_table(one, one, one, ["a"], np.array([True]))
    assert len(table) == 4 and not any("not consecutive" in name for name in table)


@pytest.mark.parametrize(("pairs", "scenes"), [(0, []), (2, ["a"])])
def test_recall_of_nothing_or_of_pairs_without_scene(pairs, scenes):
    with pytest.raises(ValueError, match=f"got {pairs} pairs and {len(scenes)} scenes. Give"):
        recall(np.ones(pairs, bool), scenes)
