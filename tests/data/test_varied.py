"""Varied pairs: every condition is met, and each pair is what its labels and its pose say."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial import cKDTree

from dbdnet_jax.data.cad import cad_split
from dbdnet_jax.data.pairs import Protocol
from dbdnet_jax.data.varied import make_varied_pair

COUNT = 200
PROTOCOL = Protocol(points=512)


@pytest.fixture(scope="module")
def shape():
    return cad_split("val").points[0]


@pytest.fixture(scope="module")
def pairs(shape):
    """Many varied pairs of one shape, and the same without noise."""
    keys = jax.random.split(jax.random.key(5), COUNT)
    points, normals = jnp.asarray(shape), jnp.zeros(shape.shape)

    def drawn(protocol):
        draw = jax.jit(jax.vmap(lambda key: make_varied_pair(key, points, normals, protocol)))
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


def test_crops_leave_a_half_to_all_of_a_shape_and_labels_follow(pairs):
    noisy, clean = pairs
    assert noisy.source.points.shape == (COUNT, PROTOCOL.size, 3)
    overlap = clean.source_overlap.mean(axis=1)
    assert overlap.min() < 0.5 and overlap.max() > 0.97
    for i in range(10):
        near = cKDTree(noisy.target.points[i]).query(aligned(noisy, i))[0]
        clear = np.abs(near - PROTOCOL.overlap_radius) > 1e-5
        assert (noisy.source_overlap[i] == (near < PROTOCOL.overlap_radius))[clear].all()


def test_a_shape_of_too_few_points_is_refused():
    points = jnp.zeros((600, 3))
    with pytest.raises(ValueError, match="at least 716; got 600. Lower protocol.points, or set"):
        make_varied_pair(jax.random.key(0), points, points, PROTOCOL)
