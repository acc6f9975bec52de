"""Poses refined in a batch: each for itself, on as many points as there are."""

import numpy as np
import pytest

from dbdnet_jax.alignment import pose_programs
from dbdnet_jax.alignment.surfaces import surface
from dbdnet_jax.classical import refine as em_icp
from dbdnet_jax.ops.transforms import angle_between, move
from tests.aligning import motion, solid


@pytest.fixture(scope="module")
def sides():
    """Two samples of one shape, where they are."""
    return surface(solid(380, 0)), surface(solid(380, 1))


@pytest.mark.parametrize(
    "level", [pose_programs.COARSE, pose_programs.FINE], ids=["coarse", "fine"]
)
def test_starts_are_refined_each_for_itself(sides, level):
    starts = [motion(seed, 12.0, 0.05) for seed in range(level.batch + 1)]
    found, residuals = pose_programs.refine_each(starts, *sides, level)
    alone, residual = pose_programs.refine_each(starts[-1:], *sides, level)
    assert len(found) == len(residuals) == len(starts)
    np.testing.assert_allclose(found[-1], alone[0], atol=1e-5)
    assert residuals[-1] == pytest.approx(residual[0], rel=1e-3)
    errors = [angle_between(pose, np.eye(4))[0] for pose in found]
    assert max(errors) < 5
    assert np.linalg.norm(move(found[0], np.zeros(3))) < 0.05


@pytest.mark.parametrize("count", [300, 1100, 5000])
def test_refining_takes_as_many_points_as_it_can(monkeypatch, count):
    seen = []

    def run(name, function, source, target, *rest):
        seen.extend(int(cloud[1]) for cloud in (source, target))
        return np.eye(3), np.ones(3)

    monkeypatch.setattr(pose_programs, "_run", run)
    pose_programs.refine(np.eye(4), solid(count, 0), solid(2 * count, 1))
    assert seen == [min(n, em_icp.MOST_POINTS) for n in (count, 2 * count)]
