"""Varied pairs: every condition is met, and each pair is what its labels and its pose say."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial import cKDTree

from dbdnet_jax.data import augment
from dbdnet_jax.data.augment import make_augmented_pair, stretched
from dbdnet_jax.data.cad import cad_split
from dbdnet_jax.data.pairs import Protocol

COUNT = 200
PROTOCOL = Protocol(points=512)


@pytest.fixture(scope="module")
def shape():
    return cad_split("val").points[0]


@pytest.fixture(scope="module")
def pairs(shape):
    """Many augmented pairs of one shape, and the same without noise."""
    keys = jax.random.split(jax.random.key(5), COUNT)
    points, normals = jnp.asarray(shape), jnp.zeros(shape.shape)

    def drawn(protocol):
        draw = jax.jit(jax.vmap(lambda key: make_augmented_pair(key, points, normals, protocol)))
        return jax.device_get(draw(keys))

    return drawn(PROTOCOL), drawn(Protocol(points=512, noise_sigma=0.0))


def aligned(pairs, i):
    return (
        pairs.source.points[i] @ pairs.target_from_source.rotation[i].T
        + (pairs.target_from_source.translation[i])
    )


def test_both_clouds_lie_on_one_shape_of_some_scale(pairs, shape):
    clean = pairs[1]
    tree, scales = cKDTree(shape), []
    for i in range(20):
        candidates = np.linspace(1 / 1.2, 1.2, 400)
        errors = [tree.query(clean.target.points[i][:40] / s)[0].max() for s in candidates]
        scale = candidates[np.argmin(errors)]
        scales.append(scale)
        assert tree.query(aligned(clean, i) / scale)[0].max() < 2e-3
    assert min(scales) < 0.95 and max(scales) > 1.05


def test_half_of_the_pairs_share_points_and_half_are_disjoint(pairs):
    clean = pairs[1]
    shared = np.array(
        [
            (cKDTree(clean.target.points[i]).query(aligned(clean, i))[0] < 1e-5).mean()
            for i in range(COUNT)
        ]
    )
    assert 0.35 < (shared == 0).mean() < 0.65
    assert shared.max() > 0.2  # of the points drawn at random from one set


def test_noise_is_none_or_up_to_three_times_the_protocols(pairs):
    noisy, clean = pairs
    noise = (noisy.target.points - clean.target.points).std(axis=(1, 2))
    assert 0.15 < (noise == 0).mean() < 0.35
    assert 0.025 < noise.max() < 0.0305
    assert np.abs(noisy.target.points - clean.target.points).max() <= 0.05 + 1e-6


def test_labels_say_which_points_have_a_neighbour(pairs):
    noisy = pairs[0]
    overlap = noisy.source_overlap.mean(axis=1)
    assert overlap.min() < 0.5 and overlap.max() > 0.97
    for i in range(10):
        near = cKDTree(noisy.target.points[i]).query(aligned(noisy, i))[0]
        clear = np.abs(near - PROTOCOL.overlap_radius) > 1e-5
        assert (noisy.source_overlap[i] == (near < PROTOCOL.overlap_radius))[clear].all()


def test_crops_leave_a_half_to_all_of_what_was_drawn_by_planes_and_by_balls(monkeypatch):
    """Crops that tell of their arguments: how many rows are 0 or 2, and which of the two."""
    total, size = 2048, Protocol().size

    def telling(first):
        def crop(points, where, wanted, count):
            rows = jnp.arange(wanted, dtype=float) * total
            return first + (rows >= jnp.float32(count) * wanted).astype(int)

        return crop

    monkeypatch.setattr(augment, "half_space_crop", telling(0))
    monkeypatch.setattr(augment, "ball_crop", telling(2))
    monkeypatch.setattr(jax.random, "permutation", lambda key, n: jnp.arange(n))
    points = jnp.zeros((total, 3)).at[:4].set(jnp.eye(4, 3)).at[-4:].set(2 * jnp.eye(4, 3)[::-1])
    clean = Protocol(noise_sigma=0.0)
    draw = jax.jit(jax.vmap(lambda key: make_augmented_pair(key, points, points, clean)))
    target = np.asarray(draw(jax.random.split(jax.random.key(8), COUNT)).target.points)
    # Of a disjoint pair the rows of the target count from the last point: of twice the length.
    rows = np.argmax(target > 0, axis=2) + 3 * (target.max(axis=2) == 0)
    ball = (rows >= 2).any(axis=1)
    assert 0.35 < ball.mean() < 0.65
    drawn = (rows % 2 == 0).mean(axis=1) * total
    kept = size / drawn
    disjoint = target.max(axis=(1, 2)) > 1.5
    assert 0.5 <= kept.min() < 0.53 and 0.95 < kept.max() < 1.01
    assert 0.69 < kept[disjoint].min() < 0.71


def test_a_shape_of_too_few_points_is_refused():
    points = jnp.zeros((600, 3))
    with pytest.raises(ValueError, match="at least 716; got 600. Lower config.protocol.points"):
        make_augmented_pair(jax.random.key(0), points, points, PROTOCOL)


def test_a_stretched_shape_is_one_map_of_the_shape(shape):
    points = jnp.asarray(shape)
    found = jax.vmap(lambda key: stretched(key, points, 1.5))(
        jax.random.split(jax.random.key(1), 50)
    )
    np.testing.assert_allclose(jnp.linalg.norm(found, axis=-1).max(axis=1), 1.0, atol=1e-5)
    np.testing.assert_allclose(found.mean(axis=1), 0.0, atol=1e-5)
    centred = np.asarray(shape - shape.mean(axis=0), np.float64)
    ratios = []
    for moved in np.asarray(found, np.float64):
        linear, residual, *_ = np.linalg.lstsq(centred, moved, rcond=None)
        assert residual.max() < 1e-6
        factors = np.linalg.svd(linear, compute_uv=False)
        ratios.append(factors[0] / factors[-1])
        assert np.abs(linear - linear.T).max() < 1e-4  # stretched, and not turned
    assert 1.0 < min(ratios) and 1.5 < max(ratios) <= 1.5**2
