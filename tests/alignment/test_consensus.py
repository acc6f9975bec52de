"""Poses on which matches of surface features agree."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from dbdnet_jax.alignment.consensus import (
    PROPOSED,
    MatchedPoints,
    agreed_poses,
    agreement,
    match_surfaces,
    mutual_matches,
)
from dbdnet_jax.alignment.surfaces import surface
from dbdnet_jax.ops.transforms import angle_between, move, transform_of
from tests.aligning import solid


def any_motion(seed: int) -> np.ndarray:
    shift = np.random.default_rng(seed).uniform(-2, 2, 3)
    return transform_of(Rotation.random(random_state=seed).as_matrix(), shift)


def test_mutual_matches_are_each_others_nearest():
    rng = np.random.default_rng(0)
    source, target = rng.random((30, 5)), rng.random((25, 5))
    apart = [[np.sum((a - b) ** 2) for b in target] for a in source]
    nearest = [int(np.argmin(row)) for row in apart]
    back = [int(np.argmin(column)) for column in np.transpose(apart)]
    expected = [(i, j) for i, j in enumerate(nearest) if back[j] == i]
    assert list(zip(*map(list, mutual_matches(source, target)), strict=True)) == expected


@pytest.mark.parametrize("seed", range(3))
def test_a_quarter_of_true_matches_is_enough(seed):
    rng = np.random.default_rng(seed)
    source, true = rng.uniform(-1, 1, (200, 3)), any_motion(seed)
    target = move(true, source) + rng.normal(0, 0.005, source.shape)
    target[50:] = rng.uniform(-1, 1, (150, 3)) + true[:3, 3]
    found = agreed_poses(MatchedPoints(source, target))
    assert len(found) <= PROPOSED
    assert angle_between(found[0], true)[0] < 1
    assert np.linalg.norm(found[0][:3, 3] - true[:3, 3]) < 0.02


def test_two_motions_are_both_proposed():
    source = np.random.default_rng(0).uniform(-1, 1, (100, 3))
    first, second = any_motion(1), any_motion(2)
    target = np.vstack([move(first, source[:60]), move(second, source[60:])])
    found = agreed_poses(MatchedPoints(source, target))
    np.testing.assert_allclose(found[0], first, atol=1e-9)
    np.testing.assert_allclose(found[1], second, atol=1e-9)


@pytest.mark.parametrize("count", [0, 2, 40])
def test_too_few_matches_or_points_at_one_place_propose_nothing(count):
    assert agreed_poses(MatchedPoints(np.ones((count, 3)), np.ones((count, 3)))) == []


def test_two_partial_samples_of_a_surface_are_brought_together_from_any_rotation():
    source, target = solid(3000, 0), solid(3000, 1)
    source, target = source[source[:, 0] < 0.4], target[target[:, 0] > -0.2]
    for seed in range(3):
        true = any_motion(seed)
        matched = match_surfaces(surface(source), surface(move(true, target)))
        found = agreed_poses(matched)
        assert angle_between(found[0], true)[0] < 12  # what refinement brings home with ease
        assert agreement(true, matched) > 3 * agreement(any_motion(9), matched)
