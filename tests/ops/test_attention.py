"""Masked multi-head attention and the position code."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dbdnet_jax.ops import attention as ops
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

HEADS = 4
attention = jax.jit(ops.attention, static_argnames=("heads", "dropout"))
position_code = jax.jit(ops.position_code, static_argnums=1)


@jax.jit
def gradients(query, key, value, valid):
    """Of a scalar of the attention, by query, key and value."""

    def loss(query, key, value):
        return jnp.sum(jnp.sin(ops.attention(query, key, value, valid, HEADS)))

    return jax.grad(loss, argnums=(0, 1, 2))(query, key, value)


def inputs(seed, n=12, m=17, d=16):
    """Query (n, d), key and value (m, d) of order two, and a mask with holes."""
    rng = np.random.default_rng(seed)
    arrays = [2.0 * rng.normal(size=(rows, d)) for rows in (n, m, m)]
    return *arrays, rng.random(m) < 0.7


@pytest.mark.parametrize("heads", [1, 4])
def test_attention_is_the_oracles(heads, precision):
    arrays = inputs(0)
    found = attention(*arrays, heads)
    assert found.dtype == precision.dtype
    assert_close(found, oracle.attention(*arrays, heads), precision.tolerance)


def test_permuting_queries_permutes_the_answers_and_permuting_keys_changes_nothing(x64):
    query, key, value, valid = inputs(1)
    plain = attention(query, key, value, valid, HEADS)
    rng = np.random.default_rng(0)
    rows, columns = rng.permutation(12), rng.permutation(17)
    assert_close(attention(query[rows], key, value, valid, HEADS), plain[rows], FLOAT64)
    permuted = attention(query, key[columns], value[columns], valid[columns], HEADS)
    assert_close(permuted, plain, FLOAT64)


def test_attention_to_equal_values_returns_them(precision):
    query, key, value, valid = inputs(2)
    found = attention(query, key, np.tile(value[:1], (17, 1)), valid, HEADS)
    assert_close(found, np.tile(value[:1], (12, 1)), precision.tolerance)


def test_padding_does_not_change_attention():
    query, key, value, _ = inputs(3)
    alone = attention(query, key, value, np.ones(17, bool), HEADS)
    for rows in (5, 17):
        garbage = np.full((rows, 16), 1e6)
        padded = [np.vstack([x, garbage]) for x in (query, key, value)]
        found = attention(*padded, np.arange(17 + rows) < 17, HEADS)
        assert_close(found[:12], alone, FLOAT32)
        assert_finite(found)


def test_padding_gets_no_gradient_and_spoils_none():
    query, key, value, valid = inputs(4)
    plain = gradients(query, key, value, valid)
    spoilt = [np.where(valid[:, None], x, 1e6) for x in (key, value)]
    for gradient, expected in zip(gradients(query, *spoilt, valid), plain, strict=True):
        assert_close(gradient, expected, FLOAT32)
        assert np.any(expected != 0.0)
    for gradient in plain[1:]:
        assert_close(gradient[~valid], np.zeros_like(gradient[~valid]), EXACT)


def test_attention_to_nothing_is_zero_with_a_zero_gradient():
    query, key, value, _ = inputs(5)
    nothing = np.zeros(17, bool)
    assert_close(attention(query, key, value, nothing, HEADS), np.zeros((12, 16)), EXACT)
    for gradient in gradients(query, key, value, nothing):
        assert_close(gradient, np.zeros(gradient.shape), EXACT)


def test_huge_logits_pick_the_best_key_without_overflow(x64):
    key, value, valid = np.eye(16), random_cloud(6, 16, 16), np.ones(16, bool)
    assert_close(attention(1e6 * key, key, value, valid, heads=1), value, EXACT)
    assert_finite(gradients(1e6 * key, key, value, valid))


def test_attention_among_equal_rows_is_finite(degenerate):
    points = np.tile(degenerate, 4)
    valid = np.ones(len(points), bool)
    assert_finite(attention(points, points, points, valid, HEADS))
    assert_finite(gradients(points, points, points, valid))


def test_the_derivative_of_attention_is_that_of_finite_differences(x64):
    query, key, value, valid = inputs(7)
    check_gradients(
        lambda *x: jnp.sum(jnp.sin(ops.attention(*x, jnp.asarray(valid), HEADS))), query, key, value
    )


def test_attention_is_the_same_in_a_batch_and_without_compiling():
    batch = [np.stack(x) for x in zip(*(inputs(seed) for seed in range(3)), strict=True)]
    mapped = jax.jit(jax.vmap(lambda *arrays: ops.attention(*arrays, HEADS)))(*batch)
    for i, found in enumerate(mapped):
        assert_close(attention(*(x[i] for x in batch), HEADS), found, FLOAT32)
    eager = ops.attention(*(jnp.asarray(x[0]) for x in batch), HEADS)
    assert_close(eager, mapped[0], FLOAT32)


def test_dropout_leaves_the_expectation_and_needs_a_key():
    arrays, key = inputs(8), jax.random.key(0)
    plain = attention(*arrays, HEADS)
    assert_close(attention(*arrays, HEADS, dropout=0.5), plain, EXACT)
    assert_close(attention(*arrays, HEADS, dropout=0.0, dropout_key=key), plain, EXACT)
    draw = jax.jit(jax.vmap(lambda k: attention(*arrays, HEADS, dropout=0.1, dropout_key=k)))
    draws = draw(jax.random.split(key, 2000))
    standard_error = np.std(draws, axis=0) / np.sqrt(2000)
    assert np.all(standard_error > 0)
    assert np.all(np.abs(np.mean(draws, axis=0) - plain) < 5 * standard_error)


def test_dropout_drops_a_share_of_the_weights_and_scales_up_the_others():
    n = 64
    query, valid = np.zeros((n, n)), np.ones(n, bool)  # equal weights, shown by the identity
    key = jax.random.key(1)
    weights = attention(query, query, np.eye(n), valid, heads=1, dropout=0.25, dropout_key=key)
    dropped = np.asarray(weights) == 0.0
    assert_close(weights[~dropped], np.full((~dropped).sum(), 1 / n / 0.75), FLOAT32)
    assert abs(dropped.mean() - 0.25) < 5 * np.sqrt(0.25 * 0.75 / n**2)


def test_heads_drop_different_weights():
    n = 16
    query, value = np.zeros((n, 2 * n)), np.hstack([np.eye(n), np.eye(n)])
    key = jax.random.key(2)
    weights = attention(query, query, value, np.ones(n, bool), 2, dropout=0.5, dropout_key=key)
    assert np.any(weights[:, :n] != weights[:, n:])


@pytest.mark.parametrize("width", [6, 32, 128])
def test_the_position_code_is_the_oracles(width, precision):
    points = 2.0 * random_cloud(9, 20)
    code = position_code(points, width)
    assert code.dtype == precision.dtype
    assert_close(code, oracle.position_code(points, width), precision.tolerance)


def test_the_position_code_has_pairs_on_the_unit_circle_and_zeros_after_them():
    code = np.asarray(position_code(random_cloud(10, 20), 32))
    assert_close(code[:, 0:30:2] ** 2 + code[:, 1:30:2] ** 2, np.ones((20, 15)), FLOAT32)
    assert_close(code[:, 30:], np.zeros((20, 2)), EXACT)


def test_the_position_code_of_an_axis_depends_on_that_axis_only():
    points = random_cloud(11, 10)
    moved = points + np.array([0.0, 0.3, 0.0])
    same = np.all(position_code(points, 36) == position_code(moved, 36), axis=0)
    np.testing.assert_array_equal(same, np.repeat([True, False, True], 12))


def test_the_derivative_of_the_position_code_is_that_of_finite_differences(x64):
    check_gradients(lambda p: jnp.sum(jnp.sin(3.0 * position_code(p, 32))), random_cloud(12, 8))
