"""Distances, nearest neighbours, interpolation and maxima over neighbours."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial import cKDTree

from dbdnet_jax.ops import grouping
from tests import oracle
from tests.conftest import (
    EXACT,
    FLOAT32,
    FLOAT64,
    assert_close,
    assert_finite,
    check_gradients,
    random_cloud,
)


def upsample_eagerly(features, dense, sparse, count):
    index, weight = grouping.interpolation_weights(dense, sparse, count)
    return grouping.interpolate(features, index, weight)


squared_distances = jax.jit(grouping.squared_distances)
knn = jax.jit(grouping.knn, static_argnums=2)
upsample = jax.jit(upsample_eagerly)
max_over_neighbours = jax.jit(grouping.max_over_neighbours)
masked_max = jax.jit(grouping.masked_max)


def with_rows(x, more, garbage):
    return np.vstack([x, np.full((more, x.shape[1]), garbage)])


def test_squared_distances_are_the_sums_of_squares(precision):
    a, b = random_cloud(0, 20, 5), random_cloud(1, 30, 5)
    expected = [[oracle.squared_distance(x, y) for y in b] for x in a]
    found = squared_distances(a, b)
    assert found.dtype == precision.dtype
    assert_close(found, expected, precision.tolerance)


def test_squared_distances_are_never_negative(precision):
    points = 100.0 + 1e-3 * random_cloud(2, 50)  # cancellation
    assert np.min(squared_distances(points, points)) >= 0.0


def test_squared_distances_of_equal_rows_have_a_finite_gradient(degenerate):
    assert_finite(affinity_gradient(degenerate))


@jax.jit
@jax.grad
def affinity_gradient(points):
    return jnp.sum(jnp.exp(-grouping.squared_distances(points, points)))


def test_the_derivative_of_squared_distances_is_that_of_finite_differences(x64):
    check_gradients(
        lambda a, b: jnp.sum(jnp.sin(grouping.squared_distances(a, b))),
        random_cloud(33, 8),
        random_cloud(34, 9),
    )


@pytest.mark.parametrize("count", [1, 3, 5, 40])
def test_the_nearest_neighbours_are_the_oracles(count, x64):
    query, points = random_cloud(3, 15, 8), random_cloud(4, 40, 8)
    expected = oracle.knn(query, points, 5, count)
    np.testing.assert_array_equal(knn(query, points, 5, count), expected)


def test_the_nearest_neighbours_are_as_near_as_scipys(precision):
    query, points = random_cloud(5, 200), random_cloud(6, 300)
    found = np.asarray(knn(query, points, 20, 300))
    distance, index = cKDTree(points).query(query, 20)
    assert_close(np.linalg.norm(query[:, None] - points[found], axis=-1), distance, FLOAT32)
    if precision.dtype == np.float64:
        np.testing.assert_array_equal(found, index)
    assert all(len(set(row)) == 20 for row in found.tolist())


def test_where_k_exceeds_the_points_the_nearest_fills_up():
    query, points = random_cloud(7, 6), random_cloud(8, 4)
    np.testing.assert_array_equal(knn(query, points, 9, 4), oracle.knn(query, points, 9, 4))


def test_permuting_the_points_permutes_the_neighbours(x64):
    query, points = random_cloud(9, 20), random_cloud(10, 30)
    rng = np.random.default_rng(0)
    rows, columns = rng.permutation(20), rng.permutation(30)
    permuted = columns[np.asarray(knn(query[rows], points[columns], 6, 30))]
    np.testing.assert_array_equal(permuted, knn(query, points, 6, 30)[rows])


@pytest.mark.parametrize("garbage", [1e6, 0.0])
def test_padding_does_not_change_the_neighbours(garbage):
    query, points = random_cloud(11, 20), random_cloud(12, 30)
    alone = knn(query, points, 6, 30)
    for more in (7, 30):
        found = knn(with_rows(query, more, garbage), with_rows(points, more, garbage), 6, 30)
        np.testing.assert_array_equal(found[:20], alone)
        assert np.min(found) >= 0 and np.max(found) < 30


def test_neighbours_of_degenerate_clouds_are_as_near_as_the_oracles(degenerate, x64):
    found = np.asarray(knn(degenerate, degenerate, 5, len(degenerate)))
    expected = oracle.knn(degenerate, degenerate, 5, len(degenerate))
    distances = [
        np.linalg.norm(degenerate[:, None] - degenerate[rows], axis=-1) ** 2
        for rows in (found, expected)
    ]
    assert_close(*distances, FLOAT64)
    assert all(len(set(row)) == 5 for row in found.tolist())


def test_neighbours_are_the_same_in_a_batch_and_without_compiling():
    queries = np.stack([random_cloud(seed, 20) for seed in range(3)])
    points = np.stack([random_cloud(seed, 30) for seed in range(3, 6)])
    counts = np.array([30, 17, 3])
    batch = jax.jit(jax.vmap(lambda *x: grouping.knn(x[0], x[1], 5, x[2])))(queries, points, counts)
    for i, found in enumerate(batch):
        np.testing.assert_array_equal(knn(queries[i], points[i], 5, counts[i]), found)
    eager = grouping.knn(*map(jnp.asarray, (queries[1], points[1])), 5, jnp.asarray(counts[1]))
    np.testing.assert_array_equal(eager, batch[1])


@pytest.mark.parametrize("count", [1, 2, 3, 25])
def test_interpolation_is_the_oracles(count, precision):
    features, dense, sparse = random_cloud(13, 25, 6), random_cloud(14, 40), random_cloud(15, 25)
    found = upsample(features, dense, sparse, count)
    assert found.dtype == precision.dtype
    expected = oracle.interpolate(features, dense, sparse, count)
    assert_close(found, expected, precision.tolerance)


def test_interpolation_keeps_constants_and_the_values_at_the_sparse_points(precision):
    sparse, features = random_cloud(16, 20), random_cloud(17, 20, 4)
    dense = np.vstack([sparse, random_cloud(18, 20)])
    values = upsample(features, dense, sparse, 20)
    assert_close(values[:20], features, FLOAT32)  # 1e-8 / distance of the others' share is left
    constant = upsample(np.full((20, 4), 7.0), dense, sparse, 20)
    assert_close(constant, np.full((40, 4), 7.0), precision.tolerance)


def test_padding_does_not_change_an_interpolation():
    arrays = random_cloud(19, 20, 4), random_cloud(20, 30), random_cloud(21, 20)
    alone = upsample(*arrays, 20)
    for more in (7, 20):
        found = upsample(*(with_rows(x, more, 1e6) for x in arrays), 20)
        assert_close(found[:30], alone, FLOAT32)


def test_interpolation_is_the_same_in_a_batch_and_without_compiling():
    arrays = [
        np.stack([random_cloud(10 * i + seed, n, width) for seed in range(3)])
        for i, (n, width) in enumerate(((12, 4), (20, 3), (12, 3)))
    ]
    counts = np.array([12, 5, 2])
    batch = jax.jit(jax.vmap(upsample_eagerly))(*arrays, counts)
    for i, found in enumerate(batch):
        assert_close(upsample(*(x[i] for x in arrays), counts[i]), found, FLOAT32)
    eager = upsample_eagerly(*(jnp.asarray(x[1]) for x in arrays), jnp.asarray(counts[1]))
    assert_close(eager, batch[1], FLOAT32)


def test_the_derivative_of_an_interpolation_is_that_of_finite_differences(x64):
    features, dense, sparse = (random_cloud(22 + i, 12) for i in range(3))
    index, weight = jax.jit(grouping.interpolation_weights)(dense, sparse, 12)
    check_gradients(
        lambda f, w: jnp.sum(jnp.sin(grouping.interpolate(f, index, w))), features, weight
    )


@jax.jit
def interpolation_gradients(features, points):
    def loss(features, points):
        return jnp.sum(upsample_eagerly(features, points, points[:8], jnp.asarray(8)) ** 2)

    return jax.grad(loss, argnums=(0, 1))(features, points)


def test_interpolation_of_degenerate_clouds_is_finite_and_gives_coordinates_no_gradient(degenerate):
    features = random_cloud(25, len(degenerate), 4)
    by_features, by_points = interpolation_gradients(features, degenerate)
    assert_finite(by_features)
    assert np.any(by_features[:8] != 0)
    assert_close(by_points, np.zeros_like(degenerate), EXACT)


def test_the_maximum_over_neighbours_is_numpys(x64):
    features, index = random_cloud(26, 30, 5), np.random.default_rng(1).integers(0, 30, (20, 6))
    assert_close(max_over_neighbours(features, index), features[index].max(axis=1), EXACT)


def test_the_derivative_of_a_maximum_goes_to_the_largest_neighbour(x64):
    features, index = random_cloud(27, 30, 5), np.random.default_rng(2).integers(0, 30, (20, 6))
    check_gradients(
        lambda f: jnp.sum(jnp.sin(grouping.max_over_neighbours(f, jnp.asarray(index)))), features
    )


def test_repeating_the_nearest_neighbour_does_not_change_the_maximum():
    query, points, features = random_cloud(28, 10), random_cloud(29, 12), random_cloud(30, 12, 4)
    few, many = (max_over_neighbours(features, knn(query, points, k, 3)) for k in (3, 8))
    assert_close(many, few, EXACT)


def test_the_maximum_over_slots_is_numpys_and_its_derivative_goes_to_the_first(x64):
    values = random_cloud(35, 24).reshape(4, 6, 3)
    assert_close(grouping.max_over_slots(jnp.asarray(values)), values.max(axis=0), EXACT)
    check_gradients(lambda x: jnp.sum(jnp.sin(grouping.max_over_slots(x))), values)
    tied = np.zeros((4, 6, 3))
    tied[1:] = 1.0
    gradient = jax.grad(lambda x: jnp.sum(grouping.max_over_slots(x)))(jnp.asarray(tied))
    assert_close(gradient, np.where(np.arange(4)[:, None, None] == 1, tied, 0.0), EXACT)


def test_a_masked_maximum_sees_valid_rows_only(x64):
    features = random_cloud(31, 20, 4) - 5.0  # all negative: zero would show
    valid = np.random.default_rng(3).random(20) < 0.5
    spoilt = np.where(valid[:, None], features, 1e6)
    assert_close(masked_max(spoilt, valid), features[valid].max(axis=0), EXACT)


def test_the_derivative_of_a_masked_maximum_goes_to_the_largest_valid_row(x64):
    features, valid = random_cloud(36, 20, 4), np.arange(20) % 3 > 0
    spoilt = np.where(valid[:, None], features, 1e3)
    check_gradients(lambda f: jnp.sum(jnp.sin(grouping.masked_max(f, jnp.asarray(valid)))), spoilt)
    value, gradient = jax.value_and_grad(
        lambda f: jnp.sum(grouping.masked_max(f, jnp.asarray(valid)))
    )(jnp.asarray(spoilt))
    assert_close(value, np.sum(features[valid].max(axis=0)), FLOAT64)
    assert_close(gradient, (features == features[valid].max(axis=0)) * 1.0, EXACT)


def test_a_masked_maximum_of_nothing_is_zero_with_no_gradient():
    features, nothing = random_cloud(32, 6, 4), np.zeros(6, bool)
    assert_close(masked_max(features, nothing), np.zeros(4), EXACT)
    gradient = jax.jit(jax.grad(lambda f: jnp.sum(grouping.masked_max(f, jnp.asarray(nothing)))))
    assert_close(gradient(features), np.zeros((6, 4)), EXACT)
