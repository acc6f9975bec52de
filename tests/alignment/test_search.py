"""Rivals of a pose: how well turned clouds fit, and what counts as another pose."""

import numpy as np
import pytest

from dbdnet_jax.alignment import search
from dbdnet_jax.classical import refine as refine
from tests.aligning import solid


def table(count: int, seed: int) -> np.ndarray:
    """(count, 3): a square plate on four legs, the same after every quarter of a turn."""
    rng = np.random.default_rng(seed)
    plate = np.column_stack([rng.uniform(-0.5, 0.5, (count // 2, 2)), np.zeros(count // 2)])
    legs = rng.choice([-0.45, 0.45], (count - count // 2, 2))
    return np.vstack([plate, np.column_stack([legs, rng.uniform(-0.6, 0.0, len(legs))])])


def test_a_square_table_has_rivals_a_quarter_and_half_a_turn_away():
    alternative = search.strongest_alternative(np.eye(4), table(360, 0), table(360, 1))
    assert abs(alternative.margin) < 0.1
    assert alternative.angle_deg == pytest.approx(round(alternative.angle_deg / 90) * 90, abs=3)
    assert abs(alternative.axis[2]) > 0.99
    assert alternative.alternatives > 1.5


def test_a_shape_without_symmetry_has_none_that_fits_as_well():
    alternative = search.strongest_alternative(np.eye(4), solid(380, 0), solid(380, 1))
    assert alternative.margin > 0.4
    assert alternative.alternatives < 3


def test_what_refining_would_make_of_a_pose_is_no_rival_of_it():
    rough = np.eye(4)
    turn = np.radians(20)
    rough[:2, :2] = [[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]]
    source, target = solid(380, 0), solid(380, 1)
    assert search.angle_between(search.refine(rough, source, target), np.eye(4))[0] < 3
    alternative = search.strongest_alternative(rough, source, target)
    assert search.angle_between(np.eye(4), rough)[0] > 15
    assert alternative.margin > -0.1


@pytest.mark.parametrize(("count", "scale"), [(60, 1.0), (60, 3.0), (380, 3.0)])
def test_the_true_pose_fits_far_better_in_sparse_and_in_large_clouds_too(count, scale):
    source, target = scale * solid(count, 0), scale * solid(count, 1)
    own = search.truncated_rmse(np.eye(4), source, target)
    rng = np.random.default_rng(0)
    for _ in range(20):
        turned = search.as_transform(rng.normal(size=(3, 3)), scale * rng.normal(size=3) * 0.1)
        if search.angle_between(turned, np.eye(4))[0] > 30:
            assert search.truncated_rmse(turned, source, target) > 1.25 * own


@pytest.mark.parametrize("count", [300, 1100, 5000])
def test_refining_takes_as_many_points_as_it_can(monkeypatch, count):
    seen = []
    monkeypatch.setattr(
        search,
        "_run_polish",
        lambda _, pose, *clouds: seen.extend(clouds) or (np.eye(3), np.ones(3)),
    )
    search.refine(np.eye(4), solid(count, 0), solid(2 * count, 1))
    assert [len(points) for points in seen] == [
        min(n, refine.MOST_POINTS) for n in (count, 2 * count)
    ]
