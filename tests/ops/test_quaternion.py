"""Quaternions against SciPy's."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from dbdnet_jax.ops import quaternion
from tests.conftest import FLOAT64, assert_close

pytestmark = pytest.mark.usefixtures("x64")


def rotations() -> Rotation:
    """Small and large turns, and three of 180 degrees."""
    turns = [*np.random.default_rng(0).normal(size=(20, 3)), *(np.pi * np.eye(3)), np.zeros(3)]
    return Rotation.from_rotvec(np.array(turns))


def test_to_and_from_matrices():
    matrices = jnp.asarray(rotations().as_matrix())
    q = quaternion.quaternion_from_rotation(matrices)
    assert (q[:, 0] >= 0).all()
    assert_close(jnp.linalg.norm(q, axis=-1), np.ones(len(q)), FLOAT64)
    assert_close(quaternion.rotation_from_quaternion(q), matrices, FLOAT64)


def test_a_product_is_one_rotation_after_the_other():
    first, second = rotations(), rotations()[::-1]
    q, p = (
        quaternion.quaternion_from_rotation(jnp.asarray(r.as_matrix())) for r in (first, second)
    )
    product = quaternion.rotation_from_quaternion(quaternion.multiply(p, q))
    assert_close(product, (second * first).as_matrix(), FLOAT64)


def test_any_rotation_is_one():
    turn = jax.vmap(quaternion.any_rotation)(jax.random.split(jax.random.key(0), 400))
    unit = jnp.einsum("nij,nkj->nik", turn, turn)
    np.testing.assert_allclose(unit, np.tile(np.eye(3), (400, 1, 1)), atol=1e-5)
    np.testing.assert_allclose(jnp.linalg.det(turn), 1.0, atol=1e-5)
    np.testing.assert_allclose(turn.mean(axis=0), 0.0, atol=0.1)  # uniform
