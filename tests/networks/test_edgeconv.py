"""EdgeConv against its plain form, which has all neighbours of all points in one array."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dbdnet_jax.networks import edgeconv
from dbdnet_jax.networks.edgeconv import EdgeConv, edge_extremes, edge_moments
from dbdnet_jax.ops.grouping import knn
from dbdnet_jax.ops.sampling import prefix_mask
from tests import oracle
from tests.conftest import FLOAT64, Tolerance, assert_close, assert_finite, random_cloud
from tests.networks.dbdnet.small import assert_same_derivative, cast

N, K, WIDTH, GROUPS = 24, 5, 8, 4
# float32 about 1000 is spaced by 6e-5; variances are about 0.1.
OFFSET = Tolerance(rtol=2e-3, atol=2e-4)


def layer(seed: int, fan_in: int) -> tuple[np.ndarray, ...]:
    """Kernel, bias, norm scale, norm bias; scales of both signs."""
    return random_cloud(seed, fan_in, WIDTH), *random_cloud(seed + 1, 3, WIDTH)


def edge_conv_eagerly(x, count, *layers):
    """Neighbours in feature space, as in the encoder."""
    count = jnp.asarray(count)
    params = {}
    for i, (kernel, bias, scale, norm_bias) in enumerate(layers):
        params[f"conv_{i}"] = {"kernel": kernel, "bias": bias}
        params[f"norm_{i}"] = {"scale": scale, "bias": norm_bias}
    index = knn(x, x, K, count)
    return EdgeConv(WIDTH, GROUPS).apply({"params": params}, x, index, prefix_mask(len(x), count))


edge_conv = jax.jit(edge_conv_eagerly)
LAYERS = layer(0, 6), layer(2, WIDTH)


def test_edge_conv_is_the_oracles(precision):
    x = random_cloud(4, N)
    found = edge_conv(jnp.asarray(x, precision.dtype), N, *cast(LAYERS, precision.dtype))
    assert found.dtype == precision.dtype
    assert_close(found, oracle.edge_conv(x, K, LAYERS, GROUPS), precision.tolerance)


def test_the_derivative_of_edge_conv_is_that_of_the_oracle(x64):
    flat = [random_cloud(5, N), *LAYERS[0], *LAYERS[1]]

    def plain(x, *arrays):
        return oracle.edge_conv(x, K, (arrays[:4], arrays[4:]), GROUPS)

    def ours(x, *arrays):
        return edge_conv(x, N, arrays[:4], arrays[4:])

    assert_same_derivative(ours, plain, flat)


@pytest.mark.parametrize("garbage", [0.0, -70.0])
def test_padding_changes_neither_edge_conv_nor_its_derivative(garbage, precision):
    layers = cast(LAYERS, precision.dtype)
    x = jnp.asarray(random_cloud(6, N), precision.dtype)
    longer = jnp.concatenate([x, jnp.full_like(x, garbage)])

    @jax.jit
    @jax.value_and_grad
    def total(x):
        return jnp.sum(jnp.sin(edge_conv(x, N, *layers)[:N]))

    alone, padded = total(x), total(longer)
    assert_close(padded[0], alone[0], precision.tolerance)
    assert_close(padded[1][:N], alone[1], precision.tolerance)
    assert not padded[1][N:].any()


def test_statistics_keep_their_digits_far_from_the_origin():
    """About 0 the sums of squares would be 1e6, and their difference lost in float32."""
    n = 200
    near, own = (np.float32(500.0 + 0.3 * random_cloud(seed, n, WIDTH)) for seed in (7, 8))
    index = jnp.asarray(np.random.default_rng(9).integers(0, n, (n, K)))
    valid = jnp.arange(n) < 150
    edges = np.float64(near)[np.asarray(index)] + np.float64(own)[:, None]
    mean, variance = edge_moments(jnp.asarray(near), jnp.asarray(own), index, valid)
    assert_close(mean, edges[:150].mean((0, 1)), OFFSET)
    assert_close(variance, edges[:150].var((0, 1)), OFFSET)

    kernel, bias = jnp.eye(WIDTH), jnp.full(WIDTH, -30.0)
    rising = jnp.arange(WIDTH) % 2 == 0
    extreme, mean, variance = edge_extremes(
        jnp.asarray(near), jnp.asarray(own), kernel, bias, rising, index, valid
    )
    edges = edges - 30.0
    assert_close(extreme, np.where(rising, edges.max(1), edges.min(1)), OFFSET)
    assert_close(mean, edges[:150].mean((0, 1)), OFFSET)
    assert_close(variance, edges[:150].var((0, 1)), OFFSET)


def test_rows_in_several_blocks_give_what_one_block_does(monkeypatch, x64):
    layers, x = cast(LAYERS, np.float64), jnp.asarray(random_cloud(11, N))

    def total(x):
        return jnp.sum(jnp.sin(edge_conv_eagerly(x, N - 2, *layers)[: N - 2]))

    one = jax.jit(jax.value_and_grad(total))(x)
    monkeypatch.setattr(edgeconv, "BLOCK_VALUES", 5 * K * WIDTH)  # five rows, the last block four
    several = jax.jit(jax.value_and_grad(lambda x: total(x)))(x)
    for found, expected in zip(several, one, strict=True):
        assert_close(found, expected, FLOAT64)


def test_the_derivative_computes_edges_again_only_where_they_take_several_blocks(monkeypatch):
    layers, x = cast(LAYERS, np.float32), jnp.asarray(random_cloud(11, N), jnp.float32)

    def computes_again():
        traced = jax.make_jaxpr(lambda x: edge_conv_eagerly(x, N, *layers))(x)
        return "remat" in str(traced) or "checkpoint" in str(traced)

    assert not computes_again()
    monkeypatch.setattr(edgeconv, "BLOCK_VALUES", 5 * K * WIDTH)
    assert computes_again()


def test_edge_conv_of_degenerate_clouds_is_finite(degenerate):
    layers = cast(LAYERS, np.float32)
    x = jnp.asarray(degenerate, jnp.float32)
    for count in (len(x), 2, 1, 0):
        assert_finite((edge_conv(x, count, *layers), degenerate_gradient(x, count, layers)))


@jax.jit
@jax.grad
def degenerate_gradient(x, count, layers):
    return jnp.sum(edge_conv(x, count, *layers) ** 2)


def test_edge_conv_is_the_same_in_a_batch(x64):
    layers = cast(LAYERS, np.float64)
    clouds = jnp.asarray(random_cloud(10, 3 * N).reshape(3, N, 3))
    batch = jax.jit(jax.vmap(lambda x: edge_conv_eagerly(x, N, *layers)))(clouds)
    for x, found in zip(clouds, batch, strict=True):
        assert_close(found, edge_conv(x, N, *layers), Tolerance(0.0, 1e-12))
