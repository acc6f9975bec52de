"""The numbers about each point's surroundings that no motion changes."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dbdnet_jax.ops.local_geometry import (
    FEATURES,
    MEAN,
    RADII,
    SPREAD,
    WEIGHT,
    local_geometry,
    local_invariants,
)
from tests import oracle
from tests.conftest import EXACT, FLOAT32, Tolerance, assert_close, assert_finite, random_cloud

CLOUD = 0.3 * random_cloud(3, 60)  # within each other's smallest radius, and lopsided
# The cube roots of numbers of 1e-7 and of their rounding errors in float64, 1e-16 of the largest.
ROOTS = Tolerance(rtol=1e-5, atol=1e-5)
RADIUS_COUNT = len(RADII)
CHIRAL = slice(FEATURES - 1, None, FEATURES)

found = jax.jit(local_invariants, static_argnums=2)
inputs = jax.jit(local_geometry, static_argnums=2)


def invariants(points, radii=RADIUS_COUNT):
    return np.asarray(found(jnp.asarray(points), jnp.asarray(len(points)), radii))


@pytest.mark.parametrize("radii", [1, 3, RADIUS_COUNT])
def test_the_numbers_are_those_of_loops(x64, radii):
    assert_close(invariants(CLOUD, radii), oracle.local_invariants(CLOUD, RADII[:radii]), ROOTS)


def test_float32_is_enough():
    single = invariants(np.float32(CLOUD))
    expected = oracle.local_invariants(np.float64(np.float32(CLOUD)), RADII)
    assert_close(single, expected, Tolerance(rtol=0.0, atol=2e-3))


def test_no_motion_changes_them(x64):
    rotation = oracle.rotation_from_euler([2.0, -1.0, 0.5])
    moved = CLOUD @ rotation.T + np.array([[3.0, -2.0, 1.0]])
    assert_close(invariants(moved), invariants(CLOUD), ROOTS)


def test_they_follow_the_points(x64):
    order = np.random.default_rng(0).permutation(len(CLOUD))
    assert_close(invariants(CLOUD[order]), invariants(CLOUD)[order], ROOTS)


def test_a_reflection_turns_the_sign_of_the_last_alone(x64):
    plain, mirrored = np.array(invariants(CLOUD)), invariants(CLOUD * [[-1, 1, 1]])
    assert np.abs(plain[:, CHIRAL]).max() > 1e-3
    plain[:, CHIRAL] *= -1
    assert_close(mirrored, plain, ROOTS)


@pytest.mark.parametrize("garbage", [0.0, 0.05, np.nan])
def test_padding_changes_nothing_and_is_zero(garbage):
    points = jnp.asarray(CLOUD, jnp.float32)
    rest = jnp.full((31, 3), garbage, jnp.float32)
    count = jnp.asarray(len(points))
    padded = inputs(jnp.concatenate([points, rest]), count, 3)
    # Sums of more terms go in another order; the noise is that of the cube roots.
    assert_close(padded[: len(points)], inputs(points, count, 3), Tolerance(rtol=1e-3, atol=5e-3))
    assert_close(padded[len(points) :], jnp.zeros((31, 3 * FEATURES)), EXACT)


def test_the_input_is_standardised(x64):
    count = jnp.asarray(len(CLOUD))
    raw = (invariants(CLOUD) - np.reshape(MEAN, (1, -1))) / np.reshape(SPREAD, (1, -1))
    assert_close(inputs(jnp.asarray(CLOUD), count, RADIUS_COUNT), WEIGHT * raw, FLOAT32)


def test_no_derivative_passes_through():
    points, count = jnp.asarray(CLOUD, jnp.float32), jnp.asarray(len(CLOUD))
    gradient = jax.grad(lambda x: jnp.sum(local_geometry(x, count, 2) ** 2))(points)
    assert_close(gradient, jnp.zeros_like(points), EXACT)


def test_degenerate_clouds_give_finite_numbers(degenerate):
    points = jnp.asarray(degenerate, jnp.float32)
    for count in (0, 1, 2, len(points)):
        assert_finite(inputs(points, jnp.asarray(count), RADIUS_COUNT))
