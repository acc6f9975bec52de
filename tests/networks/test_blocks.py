"""The small layers against plain forms: masked norms, moves between levels, attention blocks."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dbdnet_jax.networks.blocks import AttentionBlock, DenseNorm, Exchange
from dbdnet_jax.ops.grouping import interpolation_weights, knn
from tests import oracle
from tests.conftest import Tolerance, assert_close, assert_finite, check_gradients, random_cloud
from tests.networks.dbdnet.small import assert_same_derivative, cast, perturbed

N, COUNT = 20, 14
# Inputs about 1000 in float32, whose spacing there is 6e-5, normalised to about 1.
OFFSET = Tolerance(rtol=0.0, atol=1e-3)


def affine(seed: int, fan_in: int, fan_out: int) -> dict[str, np.ndarray]:
    return {
        "kernel": random_cloud(seed, fan_in, fan_out),
        "bias": random_cloud(seed + 1, fan_out, 1)[:, 0],
    }


def norm(seed: int, width: int) -> dict[str, np.ndarray]:
    """Scales of both signs."""
    return {
        "scale": random_cloud(seed, width, 1)[:, 0],
        "bias": random_cloud(seed + 1, width, 1)[:, 0],
    }


DENSE_NORM = {"conv": affine(0, 5, 8), "norm": norm(2, 8)}
dense_norm = jax.jit(lambda layer, x, valid: DenseNorm(8, 4).apply({"params": layer}, x, valid))


def dense_norm_oracle(layer, x):
    x = x @ layer["conv"]["kernel"] + layer["conv"]["bias"]
    return np.maximum(oracle.group_norm(x, 4, layer["norm"]["scale"], layer["norm"]["bias"]), 0)


@pytest.mark.parametrize("garbage", [0.0, 1e3])
def test_dense_norm_is_the_oracles_over_the_valid_rows(garbage, precision):
    x = random_cloud(4, N, 5)
    valid = np.arange(N) % 3 != 1
    x[~valid] = garbage
    found = dense_norm(cast(DENSE_NORM, precision.dtype), jnp.asarray(x, precision.dtype), valid)
    assert found.dtype == precision.dtype
    expected = dense_norm_oracle(DENSE_NORM, x[valid])
    assert_close(np.asarray(found)[valid], expected, precision.tolerance)


def test_dense_norm_keeps_its_digits_far_from_the_origin():
    kernel = np.eye(8)[:, ::-1]
    layer = {"conv": {"kernel": kernel, "bias": np.zeros(8)}, "norm": DENSE_NORM["norm"]}
    x = np.float32(1000.0 + random_cloud(5, 200, 8))
    found = dense_norm(cast(layer, np.float32), x, np.ones(200, bool))
    assert_close(found, dense_norm_oracle(layer, np.float64(x)), OFFSET)


def test_dense_norm_of_no_rows_and_of_equal_rows_is_finite(degenerate):
    layer = cast({**DENSE_NORM, "conv": affine(0, 3, 8)}, np.float32)

    @jax.jit
    @jax.grad
    def gradient(x, valid):
        return jnp.sum(dense_norm(layer, x, valid) ** 2)

    x = jnp.asarray(degenerate, jnp.float32)
    for valid in (np.ones(len(x), bool), np.zeros(len(x), bool), np.arange(len(x)) < 1):
        assert_finite((dense_norm(layer, x, valid), gradient(x, valid)))


def test_the_derivative_of_dense_norm_is_that_of_finite_differences(x64):
    valid = jnp.arange(N) < COUNT
    layer = cast(DENSE_NORM, np.float64)

    def total(x, kernel, scale):
        changed = {
            "conv": {"kernel": kernel, "bias": layer["conv"]["bias"]},
            "norm": {"scale": scale, "bias": layer["norm"]["bias"]},
        }
        out = DenseNorm(8, 4).apply({"params": changed}, x, valid)
        return jnp.sum(jnp.sin(out) * valid[:, None].astype(out.dtype))

    kernel, scale = layer["conv"]["kernel"], layer["norm"]["scale"]
    check_gradients(total, random_cloud(6, N, 5), kernel, scale)


def test_transition_down_is_the_oracles_with_its_derivative(precision):
    points, x = random_cloud(7, N), random_cloud(8, N, 6)
    layer = affine(9, 6, 8)
    kept = N // 2

    @jax.jit
    def pool(x, kernel, bias):
        cloud = jnp.asarray(points)
        index = knn(cloud[:kept], cloud, 5, jnp.asarray(N))
        variables = {"params": {"conv": {"kernel": kernel, "bias": bias}}}
        return Exchange(8).apply(variables, x, index, method="pool")

    def plain(x, kernel, bias):
        return oracle.transition_down(points, x, range(kept), 5, kernel, bias)

    inputs = (x, layer["kernel"], layer["bias"])
    found = pool(*cast(inputs, precision.dtype))
    assert found.dtype == precision.dtype
    assert_close(found, plain(*inputs), precision.tolerance)
    if precision.dtype == np.float64:
        assert_same_derivative(pool, plain, inputs)


def test_transition_up_is_the_oracles_with_its_derivative(precision):
    fine, coarse = random_cloud(10, N), random_cloud(11, COUNT)
    layer = affine(12, 6, 8)

    @jax.jit
    def up(x, kernel, bias):
        nearest = interpolation_weights(jnp.asarray(fine), jnp.asarray(coarse), jnp.asarray(COUNT))
        nearest = nearest[0], nearest[1].astype(x.dtype)
        variables = {"params": {"conv": {"kernel": kernel, "bias": bias}}}
        return Exchange(8).apply(variables, x, *nearest, method="up")

    def plain(x, kernel, bias):
        return np.maximum(oracle.interpolate(x, fine, coarse, COUNT) @ kernel + bias, 0.0)

    inputs = (random_cloud(14, COUNT, 6), layer["kernel"], layer["bias"])
    assert_close(up(*cast(inputs, precision.dtype)), plain(*inputs), precision.tolerance)
    if precision.dtype == np.float64:
        assert_same_derivative(up, plain, inputs)


def attention_block_oracle(block, features, valid, heads):
    """Plain rows: self on each cloud, then cross on what self left, both ways at once."""

    def attended(name, x, memory, memory_valid):
        layer = block[f"{name}_attention"]
        kernels = np.split(layer["in_proj"]["kernel"], 3, axis=1)
        biases = np.split(layer["in_proj"]["bias"], 3)
        q, k, v = (y @ w + b for y, w, b in zip((x, memory, memory), kernels, biases, strict=True))
        out = oracle.attention(q, k, v, memory_valid, heads)
        x = x + out @ layer["out_proj"]["kernel"] + layer["out_proj"]["bias"]
        scale, bias = (block[f"{name}_layer_norm"][part] for part in ("scale", "bias"))
        return np.stack([oracle.group_norm(row[None], 1, scale, bias)[0] for row in x])

    alone = [attended("self", x, x, rows) for x, rows in zip(features, valid, strict=True)]
    return np.stack([attended("cross", alone[i], alone[1 - i], valid[1 - i]) for i in (0, 1)])


@pytest.fixture
def block(precision):
    """An attention block of width 8 with two heads, and its parameters."""
    module = AttentionBlock(heads=2, dropout=0.3)
    valid = jnp.ones((2, N), bool)
    variables = module.init(jax.random.key(0), jnp.zeros((2, N, 8)), valid)
    return module, cast(perturbed(variables["params"], 1), precision.dtype)


def test_an_attention_block_is_the_oracles_over_the_valid_rows(block, precision):
    module, variables = block
    features = random_cloud(15, 2 * N, 8).reshape(2, N, 8)
    valid = np.stack([np.arange(N) < COUNT, np.arange(N) % 2 == 0])
    features[~valid] = 50.0
    found = jax.jit(module.apply)(
        {"params": variables}, jnp.asarray(features, precision.dtype), valid
    )
    assert found.dtype == precision.dtype
    expected = attention_block_oracle(jax.tree.map(np.float64, variables), features, valid, 2)
    # The LayerNorm of rows about 1 follows sums of products about 10.
    tolerance = Tolerance(10 * precision.tolerance.rtol, 10 * precision.tolerance.atol)
    assert_close(np.asarray(found)[valid], expected[valid], tolerance)


def test_dropout_needs_a_key_and_is_decided_by_it(x64):
    module = AttentionBlock(heads=2, dropout=0.3)
    features, valid = (
        jnp.asarray(random_cloud(16, 2 * N, 8).reshape(2, N, 8)),
        jnp.ones((2, N), bool),
    )
    variables = perturbed(module.init(jax.random.key(0), features, valid), 2)
    apply = jax.jit(module.apply)
    first, again, other = (
        apply(variables, features, valid, jax.random.key(seed)) for seed in (1, 1, 2)
    )
    np.testing.assert_array_equal(first, again)
    plain = apply(variables, features, valid)
    for cloud in range(2):
        assert not np.allclose(first[cloud], other[cloud])
        assert not np.allclose(first[cloud], plain[cloud])
