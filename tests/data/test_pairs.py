"""The protocol: what a pair is made of, and test sets that stay as they are."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from dbdnet_jax.data.cad import cad_split
from dbdnet_jax.data.frozen import CAD_VARIANTS, cad_test_pairs, load_test_set, save_test_set
from dbdnet_jax.data.pairs import (
    Protocol,
    draw_pair,
    initial_pose,
    make_pair,
    perturbed_overlap,
    perturbed_pose,
    transform_source,
)
from dbdnet_jax.data.shapes import select
from dbdnet_jax.ops import rigid
from tests.conftest import FLOAT32, assert_close

SMALL = Protocol(points=64)
# What a published table says of its pairs; a changed file is another test set.
CAD_HASHES = {
    "noise": "23a8d0cb09d9ebcf0810dfd583a7137d723f37a4577c487551253aae70f67899",
    "clean": "c57b05507000b9817c14a6c2ece95f08576b77fe28ce4526a0324854a75e6569",
    "disjoint": "80e1edb5dabf1650a562751ca9c0a52f4397f41f73c44edf277ed71b514cc4c2",
    "unseen": "84bcbccaea50b4616dad9c441a1cd1e25b4b2d3fd56261617a3ccbebaee6717f",
}


@pytest.fixture(scope="module")
def shapes():
    return select(cad_split("val"), np.arange(3))


@pytest.fixture(scope="module")
def pairs(shapes):
    """Sixteen pairs of one shape under the full protocol."""
    keys = jax.random.split(jax.random.key(3), 16)
    points, normals = jnp.asarray(shapes.points[0]), jnp.asarray(shapes.normals[0])
    draw = jax.jit(jax.vmap(lambda key: make_pair(key, points, normals, Protocol())))
    return jax.device_get(draw(keys))


def test_a_pair_has_the_protocols_size_motion_and_labels(pairs, shapes):
    assert pairs.source.points.shape == pairs.target.points.shape == (16, 717, 3)
    assert (pairs.source.count == 717).all()
    tree = cKDTree(shapes.points[0])
    for i in range(16):
        rotation, translation = (leaf[i] for leaf in pairs.target_from_source)
        angles = Rotation.from_matrix(rotation.T).as_euler("xyz", degrees=True)
        assert np.abs(angles).max() <= 45.001  # of the drawn motion, the pose's inverse
        assert np.abs(-rotation.T @ translation).max() <= 1.00001
        aligned = pairs.source.points[i] @ rotation.T + translation
        # Both clouds lie on the shape, up to the clipped noise.
        for cloud in (aligned, pairs.target.points[i]):
            assert tree.query(cloud)[0].max() < 0.05 * 3**0.5 + 1e-5
        near = cKDTree(pairs.target.points[i]).query(aligned)[0]
        clear = np.abs(near - 0.1) > 1e-5
        assert (pairs.source_overlap[i] == (near < 0.1))[clear].all()
        near = cKDTree(aligned).query(pairs.target.points[i])[0]
        clear = np.abs(near - 0.1) > 1e-5
        assert (pairs.target_overlap[i] == (near < 0.1))[clear].all()
    assert 0.5 < pairs.source_overlap.mean() < 0.95


def test_noise_has_its_sigma_and_normals_turn_with_the_cloud(shapes):
    points, normals = jnp.asarray(shapes.points[0]), jnp.asarray(shapes.normals[0])
    draw = draw_pair(jax.random.key(0), points, Protocol())
    noise = np.concatenate([draw.source_noise, draw.target_noise])
    assert noise.std() == pytest.approx(0.01, rel=0.05) and np.abs(noise).max() <= 0.05
    pair = make_pair(jax.random.key(0), points, normals, Protocol())
    back = pair.source_normals @ pair.target_from_source.rotation.T
    np.testing.assert_allclose(back, normals[draw.source_rows], atol=1e-5)


def test_each_crop_is_a_half_space_of_its_own(shapes):
    points = jnp.asarray(shapes.points[0])
    clean = Protocol(keep=0.5, noise_sigma=0.0)
    draw = draw_pair(jax.random.key(1), points, clean)
    for rows in (draw.source_rows, draw.target_rows):
        assert len(set(np.asarray(rows).tolist())) == 512
    kept = [set(np.asarray(rows).tolist()) for rows in (draw.source_rows, draw.target_rows)]
    assert len(kept[0] & kept[1]) < 256  # two draws and two planes


def test_disjoint_clouds_share_no_point_and_want_enough_of_them(shapes):
    points = jnp.asarray(shapes.points[0])
    draw = draw_pair(jax.random.key(2), points, Protocol(disjoint=True))
    assert not set(np.asarray(draw.source_rows)) & set(np.asarray(draw.target_rows))
    with pytest.raises(ValueError, match="shapes of at least 4000; got 2048. Lower points"):
        draw_pair(jax.random.key(2), points, Protocol(points=2000, disjoint=True))


def test_a_pair_is_decided_by_its_key(shapes):
    points, normals = jnp.asarray(shapes.points[0]), jnp.asarray(shapes.normals[0])
    draw = jax.jit(lambda key: make_pair(key, points, normals, SMALL))
    first, again, other = (draw(jax.random.key(seed)) for seed in (0, 0, 1))
    assert all(
        np.array_equal(a, b)
        for a, b in zip(jax.tree.leaves(first), jax.tree.leaves(again), strict=True)
    )
    assert not np.array_equal(first.source.points, other.source.points)


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"points": 5, "keep": 0.5}, "leave at least 4 points.*points=5"),
        ({"keep": 1.5}, r"keep must be in \(0, 1\]; got 1.5"),
        ({"noise_sigma": -1.0}, "noise_sigma must be finite and not negative; got -1.0"),
        ({"overlap_radius": 0.0}, "overlap_radius must be positive; got 0.0"),
    ],
)
def test_a_protocol_that_cannot_be_drawn_is_refused(fields, message):
    with pytest.raises(ValueError, match=message):
        Protocol(**fields)


def test_a_frozen_set_thaws_to_what_was_drawn(tmp_path, shapes):
    digest = save_test_set(tmp_path / "set.npz", shapes, SMALL, seed=4, count=5)
    pairs, found = load_test_set(tmp_path / "set.npz", shapes)
    assert found == digest and pairs.source.points.shape == (5, 45, 3)
    assert save_test_set(tmp_path / "again.npz", shapes, SMALL, seed=4, count=5) == digest
    key = jax.random.split(jax.random.key(4), 5)[4]
    drawn = make_pair(key, jnp.asarray(shapes.points[1]), jnp.asarray(shapes.normals[1]), SMALL)
    # The noise is stored in steps of 3e-5.
    np.testing.assert_allclose(pairs.source.points[4], drawn.source.points, atol=2e-5)
    np.testing.assert_array_equal(pairs.target_normals[4], drawn.target_normals)


def test_a_frozen_set_refuses_other_shapes_and_damage(tmp_path, shapes):
    path = tmp_path / "set.npz"
    save_test_set(path, shapes, SMALL, seed=4, count=2)
    with pytest.raises(ValueError, match="was frozen on shapes with hash .* Give the same data"):
        load_test_set(path, select(shapes, np.arange(2)))
    path.write_bytes(path.read_bytes()[:-200])
    with pytest.raises(ValueError, match="must be readable; .*set.npz is not"):
        load_test_set(path, shapes)


@pytest.mark.parametrize("variant", CAD_VARIANTS)
def test_the_packages_test_sets_are_the_published_ones(variant):
    pairs, digest = cad_test_pairs(variant)
    assert digest == CAD_HASHES[variant]
    assert pairs.source.points.shape == (200, 717, 3)


def test_an_unknown_test_set_is_refused():
    with pytest.raises(ValueError, match="variant must be one of .*'noise'.*; got 'rain'"):
        cad_test_pairs("rain")


def test_a_perturbed_pose_turns_about_the_middle_of_the_cloud(pairs):
    pair = jax.tree.map(lambda leaf: jnp.asarray(leaf[0]), pairs)
    for key in jax.random.split(jax.random.key(9), 4):
        found = perturbed_pose(key, pair, max_angle_deg=60.0, shift_sigma=0.0)
        ends = (rigid.apply(x, pair.source.points) for x in (found, pair.target_from_source))
        np.testing.assert_allclose(*(jnp.mean(end, axis=0) for end in ends), atol=1e-5)


def test_perturbed_overlap_is_now_true_now_everything_now_something_between(pairs):
    pair = jax.tree.map(lambda leaf: jnp.asarray(leaf[0]), pairs)
    keys = jax.random.split(jax.random.key(9), 300)
    draw = jax.jit(jax.vmap(lambda key: perturbed_overlap(key, pair, 0.1)))
    for masks, truth in zip(draw(keys), (pair.source_overlap, pair.target_overlap), strict=True):
        masks, truth = np.asarray(masks), np.asarray(truth)
        true, everything = (masks == truth).all(1), masks.all(1)
        assert 0.12 < true.mean() < 0.28 and 0.12 < everything.mean() < 0.28
        others = masks[~true & ~everything]
        assert (others & ~truth).any() and (~others & truth).any()
        assert 0.6 < (others == truth).mean() < 0.99


def test_a_pass_starts_from_aligned_centroids_or_from_a_rough_pose(pairs):
    pair = jax.tree.map(lambda leaf: jnp.asarray(leaf[0]), pairs)
    keys = jax.random.split(jax.random.key(10), 300)
    found = jax.jit(jax.vmap(lambda key: initial_pose(key, pair)))(keys)
    rotation, translation = map(np.asarray, found)
    blind = np.all(rotation == np.eye(3), axis=(1, 2))
    assert 0.3 < blind.mean() < 0.5
    centroids = [np.mean(cloud.points, axis=0) for cloud in (pair.source, pair.target)]
    expected = np.broadcast_to(centroids[1] - centroids[0], translation[blind].shape)
    assert_close(translation[blind], expected, FLOAT32)
    left = Rotation.from_matrix(rotation[~blind] @ np.asarray(pair.target_from_source.rotation).T)
    angles = np.degrees(left.magnitude())
    assert angles.max() <= 40.01 and angles.min() < 3 and 15 < angles.mean() < 25


def test_a_moved_pair_has_the_rest_of_the_motion_left(pairs):
    pair = jax.tree.map(lambda leaf: jnp.asarray(leaf[1]), pairs)
    motion = initial_pose(jax.random.key(3), pair)
    moved = transform_source(pair, motion)
    aligned, again = (rigid.apply(p.target_from_source, p.source.points) for p in (pair, moved))
    assert_close(again, aligned, FLOAT32)
    assert not np.allclose(moved.source.points, pair.source.points, atol=0.1)
