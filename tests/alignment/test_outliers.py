"""What is left out of a cloud, and what is not."""

import numpy as np
import pytest

from dbdnet_jax.alignment.downsampling import downsample
from dbdnet_jax.alignment.outliers import inlying
from tests.aligning import solid


def around(count: int, reach: float) -> np.ndarray:
    return np.random.default_rng(9).uniform(-reach, reach, (count, 3))


EXTRA = {  # points beside a solid of 2,000 and the largest distance to leave
    "two percent scattered": around(40, 3),
    "ten percent scattered": around(200, 3),
    "ten percent, far": around(200, 30),
    "a heap": [4, 1, 0] + 0.1 * around(100, 1),
    "two heaps": np.vstack([[4, 1, 0] + 0.1 * around(60, 1), [-3, 2, 2] + 0.1 * around(60, 1)]),
    "-9999": np.full((100, 3), -9999.0),
    "1e10": np.full((100, 3), 1e10),
    "the largest float": np.full((100, 3), 3.4028235e38),
    "zero returns": np.tile([[2.5, 0.0, 0.0]], (600, 1)),
}


@pytest.mark.parametrize("name", EXTRA)
@pytest.mark.parametrize("count", [2000, 12_000])
def test_what_does_not_belong_is_left_out_and_nothing_depends_on_it(name, count):
    own = solid(count, 3)
    extra = np.tile(EXTRA[name], (count // 2000, 1))
    kept = inlying(np.vstack([own, extra]))
    assert kept[:count].mean() > 0.995
    far = np.abs(extra).max(axis=1) > 1.5
    assert kept[count:][far].mean() < 0.02
    plain, cleaned = downsample(own, 300), downsample(np.vstack([own, extra]), 300)
    assert cleaned.size == pytest.approx(plain.size, rel=0.1)
    assert np.linalg.norm(cleaned.centre - plain.centre) < 0.05


def test_surfaces_of_uneven_density_and_of_two_parts_are_left_whole():
    rng = np.random.default_rng(0)
    radius = np.exp(rng.uniform(np.log(0.3), np.log(5), 5000))  # as a lidar sees the ground
    angle = rng.uniform(0, 2 * np.pi, 5000)
    ground = np.column_stack([radius * np.cos(angle), radius * np.sin(angle), 0 * radius])
    assert inlying(ground).mean() > 0.95
    two = np.vstack([solid(1000, 1), solid(1000, 2) + [3.0, 0, 0]])
    assert inlying(two).all()
    assert inlying(np.repeat(solid(20, 1), 30, axis=0)).all()
    assert inlying(np.ones((50, 3))).all()


def test_the_choice_does_not_depend_on_the_order():
    points = np.vstack([solid(3000, 3), EXTRA["ten percent scattered"]])
    order = np.random.default_rng(0).permutation(len(points))
    np.testing.assert_array_equal(inlying(points[order]), inlying(points)[order])
    first, second = downsample(points, 300), downsample(points[order], 300)
    for rows in ("dense", "sparse"):
        np.testing.assert_array_equal(order[getattr(second, rows)], getattr(first, rows))
    np.testing.assert_array_equal(first.even, second.even)
