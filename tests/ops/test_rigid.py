"""Rigid motions: their algebra, their draws, and the Procrustes solution with its derivative."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import kstest

from dbdnet_jax.ops import rigid
from dbdnet_jax.types import Rigid
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


def mixed(rotation):
    """A scalar that depends on every entry of a rotation, and on none as on another."""
    return jnp.sum(jnp.sin(jnp.arange(1, 10, dtype=rotation.dtype).reshape(3, 3) * rotation))


def pose_loss(source, target, weights):
    found, _ = rigid.procrustes(source, target, weights)
    return mixed(found.rotation) + jnp.sum(found.translation**2)


procrustes = jax.jit(rigid.procrustes)
pose_gradient = jax.jit(jax.value_and_grad(pose_loss, argnums=(0, 1, 2)))


def motion(seed):
    """A motion of any size as a record, and as the oracle's 4 x 4 matrix."""
    rng = np.random.default_rng(seed)
    rotation, translation = Rotation.random(rng=rng).as_matrix(), rng.normal(size=3)
    return Rigid(rotation, translation), oracle.homogeneous(rotation, translation)


def noisy_pair(seed, n=30):
    """A cloud, the cloud moved with noise, and uneven positive weights."""
    rng = np.random.default_rng(seed)
    source = random_cloud(seed, n)
    moved = source @ Rotation.random(rng=rng).as_matrix().T + rng.normal(size=3)
    return source, moved + 0.05 * rng.normal(size=(n, 3)), rng.uniform(0.1, 2.0, n)


def assert_rotation(matrix, tolerance):
    matrix = np.float64(matrix)
    assert_close(matrix @ matrix.T, np.eye(3), tolerance)
    assert_close(np.linalg.det(matrix), 1.0, tolerance)


def test_motions_apply_compose_and_invert_as_their_matrices_do(precision):
    (b_from_a, ba), (c_from_b, cb) = motion(1), motion(2)
    points = random_cloud(3, 20)
    moved = jax.jit(rigid.apply)(b_from_a, points)
    assert moved.dtype == precision.dtype
    assert_close(moved, oracle.apply(*b_from_a, points), precision.tolerance)
    composed = jax.jit(rigid.compose)(c_from_b, b_from_a)
    assert_close(oracle.homogeneous(*composed), cb @ ba, precision.tolerance)
    inverse = jax.jit(rigid.invert)(b_from_a)
    assert_close(oracle.homogeneous(*inverse), np.linalg.inv(ba), precision.tolerance)


def test_the_identity_moves_nothing(precision):
    points = jnp.asarray(random_cloud(0, 5))
    still = rigid.identity(precision.dtype)
    assert still.rotation.dtype == still.translation.dtype == precision.dtype
    np.testing.assert_array_equal(rigid.apply(still, points), points)


def test_euler_angles_are_scipys_extrinsic_xyz(precision):
    rotation_from_euler = jax.jit(rigid.rotation_from_euler)
    for angles in np.random.default_rng(0).uniform(-np.pi, np.pi, (20, 3)):
        scipys = Rotation.from_euler("xyz", angles).as_matrix()
        assert_close(rotation_from_euler(angles), scipys, precision.tolerance)
        assert_close(oracle.rotation_from_euler(angles), scipys, FLOAT64)


def test_a_rotation_about_an_axis_is_scipys(precision):
    rotation_about = jax.jit(rigid.rotation_about)
    for vector in random_cloud(0, 10):
        angle = np.linalg.norm(vector)
        found = rotation_about(*(jnp.asarray(x, precision.dtype) for x in (vector / angle, angle)))
        assert_close(found, Rotation.from_rotvec(vector).as_matrix(), precision.tolerance)


def test_random_motions_are_uniform_within_their_bounds():
    keys = jax.random.split(jax.random.key(0), 2000)
    drawn = jax.jit(jax.vmap(lambda key: rigid.random_rigid(key, 0.7, 2.0)))(keys)
    angles = Rotation.from_matrix(np.float64(drawn.rotation)).as_euler("xyz")
    everything = np.hstack([angles / 0.7, drawn.translation / 2.0])
    assert np.abs(everything).max() <= 1.0 + 1e-5
    for column in everything.T:
        assert kstest(column, "uniform", args=(-1.0, 2.0)).pvalue > 1e-3
    correlation = np.corrcoef(everything.T) - np.eye(6)
    assert np.abs(correlation).max() < 0.1, "components are not independent"


def test_procrustes_is_the_weighted_least_squares_motion(precision):
    for seed in range(5):
        pair = noisy_pair(seed)
        found, _ = procrustes(*pair)
        rotation, translation = oracle.procrustes(*pair)
        assert found.rotation.dtype == found.translation.dtype == precision.dtype
        assert_close(found.rotation, rotation, precision.tolerance)
        assert_close(found.translation, translation, precision.tolerance)
        assert_rotation(found.rotation, precision.tolerance)


def test_procrustes_agrees_with_scipys_align_vectors(x64):
    source, target, weights = noisy_pair(7)
    found, _ = procrustes(source, target, weights)
    centred = [x - np.average(x, axis=0, weights=weights) for x in (target, source)]
    scipys, _ = Rotation.align_vectors(*centred, weights=weights)
    assert_close(found.rotation, scipys.as_matrix(), FLOAT64)


def test_procrustes_of_a_mirror_image_is_still_a_rotation(precision):
    for seed in range(5):
        source, target, weights = noisy_pair(seed)
        pair = (source, target * np.array([1.0, 1.0, -1.0]), weights)
        found, _ = procrustes(*pair)
        assert_rotation(found.rotation, precision.tolerance)
        rotation, _ = oracle.procrustes(*pair)
        assert_close(found.rotation, rotation, precision.tolerance)


def test_moving_the_input_moves_the_procrustes_solution_along(x64):
    source, target, weights = noisy_pair(4)
    found, _ = procrustes(source, target, weights)
    g, matrix = motion(5)
    moved_source, _ = procrustes(oracle.apply(*g, source), target, weights)
    moved_target, _ = procrustes(source, oracle.apply(*g, target), weights)
    plain = oracle.homogeneous(*found)
    assert_close(oracle.homogeneous(*moved_source), plain @ np.linalg.inv(matrix), FLOAT64)
    assert_close(oracle.homogeneous(*moved_target), matrix @ plain, FLOAT64)


def test_procrustes_ignores_the_scale_of_the_weights_and_rows_of_weight_zero(precision):
    source, target, weights = noisy_pair(6)
    found, _ = procrustes(source, target, weights)
    garbage = np.full(source.shape, 1e6)
    scaled, _ = procrustes(source, target, 1000.0 * weights)
    padded, _ = procrustes(
        np.vstack([source, garbage]), np.vstack([target, -garbage]), np.append(weights, 0 * weights)
    )
    for other in (scaled, padded):
        assert_close(other.rotation, found.rotation, precision.tolerance)
        assert_close(other.translation, found.translation, precision.tolerance)


def test_the_second_singular_value_tells_a_line_from_a_plane(precision):
    cloud, weights = random_cloud(8, 30), np.ones(30)

    def second(points):
        _, singular = procrustes(points, points, weights)
        assert singular[0] >= singular[1] >= singular[2] >= 0
        return singular[1]

    assert second(cloud) > 0.3
    assert second(cloud * np.array([1.0, 1.0, 0.0])) > 0.3
    assert second(cloud[:, :1] * np.array([[1.0, 2.0, 3.0]])) < 1e-6
    assert second(0.0 * cloud) == 0.0


def test_the_derivative_of_procrustes_is_that_of_finite_differences(x64):
    check_gradients(pose_loss, *noisy_pair(9))


@pytest.mark.parametrize("mirror", [1.0, -1.0])
def test_the_derivative_of_the_rotation_is_that_of_finite_differences(x64, mirror):
    covariance = np.random.default_rng(3).normal(size=(3, 3))
    covariance[2] *= mirror * np.sign(np.linalg.det(covariance))
    check_gradients(lambda h: mixed(rigid.rotation_from_covariance(h)[0]), covariance)


def test_coplanar_clouds_have_a_true_derivative(x64):
    source, _, weights = noisy_pair(11)
    flat = source * np.array([1.0, 1.0, 0.0])
    check_gradients(pose_loss, flat, oracle.apply(*motion(12)[0], flat), weights)


def test_degenerate_clouds_give_a_rotation_and_finite_gradients(degenerate, precision):
    moved = oracle.apply(*motion(13)[0], degenerate)
    for target in (moved, degenerate, 0.0 * degenerate):
        pair = degenerate, target, np.ones(len(degenerate))
        found, _ = procrustes(*pair)
        assert_rotation(found.rotation, precision.tolerance)
        assert_finite((found, pose_gradient(*pair)))


@pytest.mark.parametrize("total", [0.0, 1e-30, 1e-21])
def test_vanishing_weights_give_the_identity_and_finite_gradients(total):
    source, target, weights = noisy_pair(10)
    found, singular = procrustes(source, target, total * weights)
    assert_close(oracle.homogeneous(*found), np.eye(4), EXACT)
    assert_close(singular, np.zeros(3), EXACT)
    assert_finite(pose_gradient(source, target, total * weights))


def test_a_step_along_an_undetermined_axis_is_bounded(x64):
    flat = np.diag([1.0, 0.0, 0.0])  # any turn about x is as good
    for covariance in (flat, 1e-12 * flat, np.zeros((3, 3))):
        gradient = jax.jit(jax.grad(lambda h: mixed(rigid.rotation_from_covariance(h)[0])))(
            covariance
        )
        size = covariance.max() or 1.0
        assert 0.0 < np.abs(gradient).max() * size < 1e6


def test_procrustes_is_the_same_in_a_batch_and_without_compiling():
    pairs = [noisy_pair(seed) for seed in range(3)]
    values, gradients = jax.jit(jax.vmap(jax.value_and_grad(pose_loss, argnums=(0, 1, 2))))(
        *(np.stack(x) for x in zip(*pairs, strict=True))
    )
    for i, pair in enumerate(pairs):
        value, gradient = pose_gradient(*pair)
        assert_close(values[i], value, FLOAT32)
        for mapped, alone in zip(gradients, gradient, strict=True):
            assert_close(mapped[i], alone, FLOAT32)
    assert_close(pose_loss(*(jnp.asarray(x) for x in pairs[0])), values[0], FLOAT32)
