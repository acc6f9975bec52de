"""Farthest-point order and its prefixes, resampling, random directions, half-space crops."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.distance import cdist
from scipy.stats import kstest

from dbdnet_jax.ops import sampling
from tests import oracle
from tests.conftest import FLOAT32, assert_close, random_cloud

farthest_order = jax.jit(sampling.farthest_order)
half_space_crop = jax.jit(sampling.half_space_crop, static_argnums=2)
resample = jax.jit(sampling.resample, static_argnums=(1, 2))


def assert_same_rows(found, expected, message=""):
    np.testing.assert_array_equal(np.asarray(found), np.asarray(expected), err_msg=message)


def test_the_prefix_mask_marks_the_first_rows():
    assert_same_rows(sampling.prefix_mask(5, jnp.asarray(3)), [True, True, True, False, False])


def test_the_prefix_order_brings_kept_rows_forward_and_keeps_both_sequences():
    keep = np.random.default_rng(0).random(40) < 0.5
    order = jax.jit(sampling.prefix_order)(keep)
    assert_same_rows(order, np.append(np.flatnonzero(keep), np.flatnonzero(~keep)))


def test_the_inverse_order_undoes_an_order():
    order = np.random.default_rng(1).permutation(30)
    inverse = np.asarray(jax.jit(sampling.inverse_order)(order))
    assert_same_rows(order[inverse], np.arange(30))
    assert_same_rows(inverse[order], np.arange(30))


@pytest.mark.parametrize("count", [0, 1, 2, 3, 4, 7, 30, 47, 48])
def test_the_farthest_order_is_the_oracles(count, precision):
    points = random_cloud(2, 48)
    assert_same_rows(farthest_order(points, count), oracle.farthest_order(points, count))


def test_fewer_or_more_farthest_points_can_be_asked_for():
    points = random_cloud(2, 48)
    for size, sampled in ((10, 10), (40, 40), (60, 48)):
        found = np.asarray(sampling.farthest_order(jnp.asarray(points), jnp.asarray(48), size))
        assert_same_rows(found[:sampled], oracle.farthest_samples(points, sampled))
        assert_same_rows(found[sampled:], np.setdiff1d(np.arange(48), found[:sampled]))


@pytest.mark.parametrize("scale", [(1, 1, 1), (0, 1, 9), (5, 0, 0)])
def test_farthest_rows_on_the_host_are_the_oracles(scale):
    points = np.random.default_rng(1).normal(size=(60, 3)) * scale
    assert_same_rows(sampling.farthest_rows(points, 20), oracle.farthest_samples(points, 20))
    begun = sampling.farthest_rows(np.roll(points, 7, axis=0), 20, 7)
    assert_same_rows((begun - 7) % 60, oracle.farthest_samples(points, 20))


def test_farthest_rows_on_the_host_skip_copies():
    points = random_cloud(3, 30)
    rows = sampling.farthest_rows(np.repeat(points, 3, axis=0), 90) // 3
    assert_same_rows(rows, oracle.farthest_samples(points, 30))


def test_ties_and_duplicates_in_the_farthest_order_go_to_the_lower_row(degenerate):
    rounded = np.round(degenerate * 64) / 64  # distances are exact, so that ties are ties
    expected = oracle.farthest_order(rounded, len(rounded))
    assert_same_rows(farthest_order(rounded, len(rounded)), expected)


def test_a_cloud_in_farthest_order_has_every_level_as_a_prefix():
    points, count = random_cloud(3, 80), 75
    points = points[np.asarray(farthest_order(points, count))]
    for level in range(4):
        kept = count >> level
        again = farthest_order(points[:kept], kept)
        assert_same_rows(again, np.arange(kept), f"the order of the first {kept} rows changes")
        if level:
            samples = oracle.farthest_samples(points[:count], kept)
            assert_same_rows(samples, np.arange(kept), f"level {level} is no prefix")


def test_samples_lie_farther_apart_than_any_point_lies_from_its_sample():
    points = random_cloud(4, 300)
    samples = points[np.asarray(farthest_order(points, 300))[:150]]
    apart = cdist(samples, samples) + 10.0 * np.eye(150)
    assert apart.min() >= cdist(points, samples).min(axis=1).max() - 1e-6


def test_padding_does_not_change_the_farthest_order():
    points = random_cloud(5, 60)
    alone = farthest_order(points, 60)
    for total in (75, 120):
        garbage = np.full((total - 60, 3), 1e6)
        garbage[::2] = 0.0
        order = farthest_order(np.vstack([points, garbage]), 60)
        assert_same_rows(order[:60], alone)
        assert_same_rows(order[60:], np.arange(60, total))


def test_the_farthest_order_is_the_same_in_a_batch_and_without_compiling():
    clouds, counts = np.stack([random_cloud(seed, 50) for seed in range(3)]), [50, 33, 4]
    orders = jax.jit(jax.vmap(sampling.farthest_order))(clouds, jnp.asarray(counts))
    for cloud, count, order in zip(clouds, counts, orders, strict=True):
        assert_same_rows(farthest_order(cloud, count), order)
    eager = sampling.farthest_order(jnp.asarray(clouds[1]), jnp.asarray(counts[1]))
    assert_same_rows(eager, orders[1])


@pytest.mark.parametrize("size", [1, 20, 50])
def test_a_smaller_sample_repeats_no_row(size):
    rows = resample(jax.random.key(0), 50, size).tolist()
    assert len(rows) == len(set(rows)) == size and min(rows) >= 0 and max(rows) < 50


def test_a_larger_sample_covers_all_rows():
    for seed in range(5):
        rows = resample(jax.random.key(seed), 50, 70).tolist()
        assert len(rows) == 70
        assert set(rows) == set(range(50))


def test_samples_differ_by_key_and_only_by_key():
    first, again, other = (resample(jax.random.key(seed), 50, 70).tolist() for seed in (0, 0, 1))
    assert first == again
    assert first[:50] != other[:50] and first[50:] != other[50:]


def test_every_row_is_as_likely_in_a_sample():
    keys = jax.random.split(jax.random.key(3), 2000)
    rows = jax.jit(jax.vmap(lambda key: sampling.resample(key, 10, 4)))(keys)
    counts = np.bincount(np.ravel(rows), minlength=10)
    assert np.abs(counts - 800).max() < 5 * np.sqrt(2000 * 0.4 * 0.6)


def test_random_directions_are_uniform_on_the_sphere():
    keys = jax.random.split(jax.random.key(4), 2000)
    directions = np.asarray(jax.jit(jax.vmap(sampling.random_direction))(keys))
    assert_close(np.linalg.norm(directions, axis=1), np.ones(2000), FLOAT32)
    for axis in directions.T:  # a coordinate of a point on the sphere is uniform (Archimedes)
        assert kstest(axis, "uniform", args=(-1.0, 2.0)).pvalue > 1e-3


@pytest.mark.parametrize("size", [1, 35, 50])
def test_a_crop_keeps_exactly_so_many_points_on_one_side_of_a_plane(size, precision):
    points, direction = random_cloud(6, 50), np.array([0.48, -0.6, 0.64])
    rows = np.asarray(half_space_crop(points, direction, size))
    assert len(rows) == size and np.all(np.diff(rows) > 0), "the given order is not kept"
    assert_same_rows(rows, oracle.half_space_crop(points, direction, size))
    along = points @ direction
    dropped = np.setdiff1d(np.arange(50), rows)
    assert along[rows].min() > along[dropped].max(initial=-np.inf)


@pytest.mark.parametrize("crop", ["half_space_crop", "ball_crop"])
def test_a_crop_chooses_among_the_first_points_only(crop):
    points, where = random_cloud(8, 50), np.array([0.48, -0.6, 0.64])
    cut = jax.jit(getattr(sampling, crop), static_argnums=2)
    for count in (20, 33, 50):
        expected = getattr(oracle, crop)(points[:count], where, 20)
        assert_same_rows(cut(points, where, 20, jnp.asarray(count)), expected)
    assert_same_rows(cut(points, where, 20), expected)


def test_a_crop_of_equal_points_still_has_its_size():
    rows = half_space_crop(np.zeros((20, 3)), np.array([0.0, 0.0, 1.0]), 14).tolist()
    assert len(rows) == len(set(rows)) == 14


def test_a_crop_turns_with_the_cloud(x64):
    points, direction = random_cloud(7, 50), np.array([0.48, -0.6, 0.64])
    turn = oracle.rotation_from_euler([0.3, 1.0, -2.0])
    plain = half_space_crop(points, direction, 35)
    assert_same_rows(half_space_crop(points @ turn.T, turn @ direction, 35), plain)


def test_crops_and_samples_are_the_same_in_a_batch_and_without_compiling():
    clouds = jnp.stack([jnp.asarray(random_cloud(seed, 40)) for seed in range(3)])
    keys = jax.random.split(jax.random.key(5), 3)

    def cut(key, points):
        crop_key, sample_key = jax.random.split(key)
        rows = sampling.half_space_crop(points, sampling.random_direction(crop_key), 28)
        return rows[sampling.resample(sample_key, 28, 32)]

    batch = jax.jit(jax.vmap(cut))(keys, clouds)
    compiled = jax.jit(cut)
    for key, cloud, rows in zip(keys, clouds, batch, strict=True):
        assert_same_rows(compiled(key, cloud), rows)
    assert_same_rows(cut(keys[0], clouds[0]), batch[0])
