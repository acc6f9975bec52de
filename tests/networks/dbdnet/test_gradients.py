"""Derivatives of the whole network with respect to the clouds, and clouds of no shape."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dbdnet_jax.networks.dbdnet.register import register
from dbdnet_jax.networks.dbdnet.registration import ParameterNetwork
from dbdnet_jax.types import Cloud
from tests.conftest import Tolerance, assert_close, assert_finite, random_cloud
from tests.networks.dbdnet.small import SMALL, small_params

N, COUNT = 24, 20


def answer_and_gradient_eagerly(params, clouds, masks):
    """The answer, and the derivative of a sum of everything it holds."""

    def total(clouds):
        answer = register(params, *clouds, *masks)
        leaves = [x for x in jax.tree.leaves(answer) if x.dtype != bool]
        weights = [jnp.cos(jnp.arange(x.size, dtype=x.dtype)).reshape(x.shape) for x in leaves]
        value = sum(jnp.sum(x * w) for x, w in zip(leaves, weights, strict=True))
        return value, (value, answer)

    gradient, (value, answer) = jax.grad(total, has_aux=True)(clouds)
    return value, answer, gradient


answer_and_gradient = jax.jit(answer_and_gradient_eagerly)


def all_rows():
    return jnp.ones(N, bool), jnp.ones(N, bool)


def test_compilation_keeps_the_derivative_of_the_maximum_over_points(x64):
    # Features are computed again for the derivative, where the compiler may round them otherwise.
    variables = {"params": small_params(5).registration["weight_net"]}
    counts = jnp.asarray([COUNT, N])

    @jax.jit
    @jax.value_and_grad
    def total(points):
        scale = ParameterNetwork(SMALL).apply(variables, Cloud(points, counts))
        return sum(weight * x for weight, x in enumerate(scale, start=1))

    points, direction = (random_cloud(seed, 2 * N).reshape(2, N, 3) for seed in (1, 2))
    _, gradient = total(jnp.asarray(points))
    ends = [total(jnp.asarray(points + step * direction))[0] for step in (1e-6, -1e-6)]
    # A rectified unit or two switch within the step.
    assert_close(jnp.sum(gradient * direction), (ends[0] - ends[1]) / 2e-6, Tolerance(1e-3, 0.0))


@pytest.mark.parametrize("garbage", [0.0, 1e3, np.nan])
def test_padding_gets_no_gradient_and_spoils_none(garbage):
    params = small_params(5, dtype=np.float32)
    masks = (jnp.arange(N) < COUNT, jnp.arange(N) % 6 != 1)
    clouds = tuple(
        jnp.where(mask[:, None], np.float32(random_cloud(seed, N)), garbage)
        for seed, mask in zip((1, 2), masks, strict=True)
    )
    _, _, gradient = answer_and_gradient(params, clouds, masks)
    assert_finite(gradient)
    for mask, of_cloud in zip(masks, gradient, strict=True):
        assert np.all(np.any(of_cloud != 0, axis=1) == mask)


def test_degenerate_clouds_have_finite_answers_and_gradients(degenerate):
    assert len(degenerate) == N
    params = small_params(5, dtype=np.float32)
    shape = jnp.asarray(degenerate, jnp.float32)
    other = jnp.asarray(random_cloud(3, N), jnp.float32)
    for clouds in ((shape, shape), (shape, other), (other, shape)):
        assert_finite(answer_and_gradient(params, clouds, all_rows()))


@pytest.mark.parametrize(
    "name", ["empty source", "empty target", "two points", "NaN", "infinity", "equal", "collinear"]
)
def test_where_nothing_can_be_estimated_the_motion_is_the_identity(name):
    params = small_params(5, dtype=np.float32)
    source, target = (np.float32(random_cloud(seed, N)) for seed in (1, 2))
    source_mask, target_mask = np.ones(N, bool), np.ones(N, bool)
    assert answer_and_gradient(params, (source, target), (source_mask, target_mask))[1].valid
    if name == "empty source":
        source_mask[:] = False
    elif name == "empty target":
        target_mask[:] = False
    elif name == "two points":
        source_mask[2:] = False
    elif name == "NaN":
        target[7, 1] = np.nan
    elif name == "infinity":
        source[3, 0] = np.inf
    elif name == "equal":
        source[:] = source[0]
    else:
        source[:] = source[:, :1] * np.float32([0.25, -0.5, 1.0])
    _, answer, _ = answer_and_gradient(params, (source, target), (source_mask, target_mask))
    assert not answer.valid
    np.testing.assert_array_equal(answer.rotation, np.eye(3))
    np.testing.assert_array_equal(answer.translation, np.zeros(3))
