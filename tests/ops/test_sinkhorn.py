"""Log-domain Sinkhorn with one slack row and one slack column."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import linear_sum_assignment

from dbdnet_jax.ops import sinkhorn as ops
from dbdnet_jax.ops.grouping import squared_distances
from tests import oracle
from tests.conftest import (
    EXACT,
    FLOAT32,
    FLOAT64,
    assert_close,
    assert_finite,
    check_gradients,
)

log_sinkhorn = jax.jit(ops.sinkhorn, static_argnums=3)


def sinkhorn(*arguments):
    """The matrix itself, not its logarithm."""
    return np.exp(log_sinkhorn(*arguments))


@jax.jit
@jax.value_and_grad
def value_and_gradient(affinity, row_valid, column_valid):
    return jnp.sum(jnp.exp(ops.sinkhorn(affinity, row_valid, column_valid, 5)) ** 2)


def inputs(seed, n=12, m=15):
    """Affinity of order three and masks with holes."""
    rng = np.random.default_rng(seed)
    return 3.0 * rng.normal(size=(n, m)), rng.random(n) < 0.7, rng.random(m) < 0.7


def all_valid(n, m):
    return np.ones(n, bool), np.ones(m, bool)


@pytest.mark.parametrize("iterations", [1, 5])
@pytest.mark.parametrize("masked", [False, True])
def test_sinkhorn_is_the_oracles(iterations, masked, precision):
    affinity, *valid = inputs(0)
    valid = valid if masked else all_valid(*affinity.shape)
    found = sinkhorn(affinity, *valid, iterations)
    assert found.dtype == precision.dtype
    expected = oracle.sinkhorn(affinity, *valid, iterations)
    assert_close(found, expected, precision.tolerance)


def test_columns_sum_to_at_most_one_and_rows_converge_to_it(x64):
    affinity, *_ = inputs(1)
    for iterations in (1, 5, 200):
        mass = sinkhorn(affinity, *all_valid(12, 15), iterations)
        assert mass.sum(axis=0).max() <= 1.0 + 1e-12
    assert mass.sum(axis=1).max() <= 1.0 + 1e-9
    assert mass.min() >= 0.0


def test_points_without_a_counterpart_go_to_the_slack(x64):
    affinity = np.full((4, 4), -30.0)
    affinity[0, 0] = 30.0
    for iterations in (1, 5, 100):
        # The slack row's entry over the good pair goes 1, 1/2, 1/3, ... while it is normalised.
        expected = np.zeros((4, 4))
        expected[0, 0] = iterations / (iterations + 1)
        mass = sinkhorn(affinity, *all_valid(4, 4), iterations)
        np.testing.assert_allclose(mass, expected, atol=1e-10)


def test_strong_affinities_leave_a_doubly_stochastic_matrix(x64):
    affinity = np.random.default_rng(2).normal(size=(10, 10)) + 30.0
    for iterations in (100, 1000):  # the slack's share falls as one over the iterations
        mass = sinkhorn(affinity, *all_valid(10, 10), iterations)
        assert np.abs(mass.sum(axis=0) - 1.0).max() < 2.0 / iterations
        assert np.abs(mass.sum(axis=1) - 1.0).max() < 2.0 / iterations


@pytest.mark.parametrize("shape", [(10, 10), (8, 11)])
def test_a_sharp_sinkhorn_agrees_with_the_optimal_assignment(shape, x64):
    for seed in range(4):  # the two best assignments of the next one cost almost the same
        cost = np.random.default_rng(seed).uniform(size=shape)
        mass = sinkhorn(300.0 * (2.0 - cost), *all_valid(*shape), 3000)
        rows, columns = linear_sum_assignment(cost)
        assert mass[rows, columns].min() > 0.5  # of a row's and a column's one


def test_permuting_rows_and_columns_permutes_sinkhorn(x64):
    affinity, row_valid, column_valid = inputs(3)
    rng = np.random.default_rng(0)
    rows, columns = rng.permutation(12), rng.permutation(15)
    plain = sinkhorn(affinity, row_valid, column_valid, 5)
    permuted = sinkhorn(affinity[rows][:, columns], row_valid[rows], column_valid[columns], 5)
    assert_close(permuted, plain[rows][:, columns], FLOAT64)


@pytest.mark.parametrize("more", [3, 15])
def test_padding_does_not_change_sinkhorn(more, precision):
    affinity, *_ = inputs(4)
    alone = log_sinkhorn(affinity, *all_valid(12, 15), 5)
    for garbage in (1e6, -1e6, 0.0):
        padded = np.pad(affinity, ((0, more), (0, more)), constant_values=garbage)
        valid = np.arange(12 + more) < 12, np.arange(15 + more) < 15
        found = log_sinkhorn(padded, *valid, 5)
        assert_close(found[:12, :15], alone, precision.tolerance)
        assert_finite(found)  # large negative numbers, not -inf
        mass = np.exp(found)
        assert np.all(mass[12:] == 0.0) and np.all(mass[:, 15:] == 0.0)


def test_padding_gets_no_gradient_and_spoils_none():
    affinity, *valid = inputs(5)
    both = valid[0][:, None] & valid[1][None, :]
    _, plain = value_and_gradient(affinity, *valid)
    _, spoilt = value_and_gradient(np.where(both, affinity, 1e6), *valid)
    assert_close(spoilt, plain, FLOAT32)
    np.testing.assert_array_equal(plain != 0.0, both)


def test_with_nothing_valid_the_result_is_log_zero_and_the_gradient_zero():
    affinity, *_ = inputs(6)
    nothing = np.zeros(12, bool), np.zeros(15, bool)
    found = log_sinkhorn(affinity, *nothing, 5)
    assert_finite(found)
    assert np.all(found <= ops.LOG_ZERO) and np.all(np.exp(found) == 0.0)
    value, gradient = value_and_gradient(affinity, *nothing)
    assert_close(value, 0.0, EXACT)
    assert_close(gradient, np.zeros((12, 15)), EXACT)


@pytest.mark.parametrize("scale", [0.0, 1e-3, 1e4, -1e4])
def test_flat_and_extreme_affinities_are_finite(scale, precision):
    affinity, *valid = inputs(7)
    assert_finite(value_and_gradient(scale * np.abs(affinity), *valid))


@jax.jit
@jax.value_and_grad
def cloud_loss(points):
    affinity = -50.0 * (squared_distances(points, points) - 0.1)
    valid = jnp.ones(len(points), bool)
    return jnp.sum(jnp.exp(ops.sinkhorn(affinity, valid, valid, 5)) ** 2)


def test_sinkhorn_between_degenerate_clouds_is_finite(degenerate):
    assert_finite(cloud_loss(degenerate))


def test_the_derivative_of_sinkhorn_is_that_of_finite_differences(x64):
    affinity, *valid = inputs(8)
    check_gradients(
        lambda a: jnp.sum(jnp.sin(jnp.exp(ops.sinkhorn(a, *map(jnp.asarray, valid), 5)))), affinity
    )


def test_sinkhorn_is_the_same_in_a_batch_and_without_compiling():
    batch = [np.stack(x) for x in zip(*(inputs(seed) for seed in range(3)), strict=True)]
    mapped = np.exp(jax.jit(jax.vmap(lambda *arrays: ops.sinkhorn(*arrays, 5)))(*batch))
    for i, found in enumerate(mapped):
        assert_close(sinkhorn(*(x[i] for x in batch), 5), found, FLOAT32)
    eager = ops.sinkhorn(*(jnp.asarray(x[0]) for x in batch), 5)
    assert_close(np.exp(eager), mapped[0], FLOAT32)
