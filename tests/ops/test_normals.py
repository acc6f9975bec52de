"""Normals estimated from a cloud."""

import jax.numpy as jnp
import numpy as np

from dbdnet_jax.ops.normals import estimate_normals
from tests.conftest import FLOAT32, assert_close, assert_finite, random_cloud


def test_normals_equal_numpy_svd_of_the_neighbours():
    points = random_cloud(0, 40)
    normals = np.asarray(estimate_normals(jnp.asarray(points, jnp.float32), jnp.asarray(40), 6))
    for point, normal in zip(points, normals, strict=True):
        near = points[np.argsort(np.linalg.norm(points - point, axis=1))[:6]]
        expected = np.linalg.svd(near - near.mean(0))[2][2]
        assert abs(normal @ expected) > 1 - 1e-4


def test_a_plane_has_its_normal_and_padding_says_nothing():
    points = random_cloud(1, 30) * [1, 1, 0]
    padded = np.concatenate([points, np.full((10, 3), 7.0)]).astype(np.float32)
    normals = estimate_normals(jnp.asarray(padded), jnp.asarray(30), 8)
    assert_close(np.abs(normals[:30]), np.tile([0.0, 0, 1], (30, 1)), FLOAT32)


def test_degenerate_clouds_give_unit_vectors(degenerate):
    points = jnp.asarray(degenerate, jnp.float32)
    for count in (0, 1, 2, len(points)):
        normals = estimate_normals(points, jnp.asarray(count), 6)
        assert_finite(normals)
        assert_close(jnp.linalg.norm(normals, axis=1), np.ones(len(points)), FLOAT32)
