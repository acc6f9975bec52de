"""Training pairs: every shape in its turn, the same after a restart, nothing of the test sets."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial import cKDTree

from configs import threedmatch
from dbdnet_jax.data.cad import cad_split
from dbdnet_jax.data.mixture import Mixture
from dbdnet_jax.data.modelnet40 import FILES, load_modelnet40
from dbdnet_jax.data.threedmatch import load_info
from dbdnet_jax.data.training_pairs import (
    load_training_pairs,
    load_training_shapes,
    pairs_of_shapes,
)
from dbdnet_jax.training.config import DataConfig, read_config
from tests import stand_in
from tests.data.test_modelnet40 import write_file
from tests.data.threedmatch_folder import write_folder


def test_every_epoch_sees_every_shape_once():
    train = stand_in.shapes()
    train.points[:] = np.arange(len(train))[:, None, None]  # all points of shape i are (i, i, i)
    still = dataclasses.replace(
        stand_in.PROTOCOL, noise_sigma=0.0, max_angle_deg=0.0, max_translation=0.0
    )
    pairs = stand_in.pairs_of_shapes(train, train, still, seed=1, validation_pairs=20)
    points, key = jnp.asarray(next(pairs.arrays(0))), jax.random.key(0)
    draw = jax.jit(lambda number: pairs.draw(key, number, points).target.points[0, 0])
    seen = [int(draw(number)) for number in range(24)]
    epochs = np.reshape(seen, (3, 8))
    assert (np.sort(epochs, axis=1) == np.arange(8)).all()
    assert len({tuple(epoch) for epoch in epochs}) == 3
    assert list(pairs.validation.target.points[:, 0, 0].astype(int)) == [i % 8 for i in range(20)]


def test_cad_shapes_are_those_of_the_training_and_validation_splits():
    train, validation = load_training_shapes(DataConfig("cad", "", "seen"))
    assert list(train.paths) == list(cad_split("train", "seen").paths)
    assert list(validation.paths) == list(cad_split("val", "seen").paths)


def test_procedural_shapes_are_trained_on_beside_the_others():
    train, _ = load_training_shapes(DataConfig("cad", "", "seen"))
    more, _ = load_training_shapes(DataConfig("cad", "", "seen", procedural=3))
    assert len(more) == len(train) + 3 and set(more.libraries[-3:]) == {"procedural"}
    np.testing.assert_array_equal(more.points[: len(train)], train.points)


def test_a_share_of_the_pairs_is_drawn_more_widely():
    shapes = stand_in.shapes(count=2, points=64)
    clean = dataclasses.replace(stand_in.PROTOCOL, noise_sigma=0.0)
    key, points = jax.random.key(0), jnp.asarray(shapes.points)

    def radii(augment, stretch=1.0):
        options = {"seed": 0, "validation_pairs": 1, "augment": augment, "stretch": stretch}
        pairs = pairs_of_shapes(shapes, shapes, clean, **options)
        draw = jax.jit(lambda n: pairs.draw(jax.random.fold_in(key, n), n, points).target.points)
        on_shape = cKDTree(points.reshape(-1, 3)).query
        return np.array([on_shape(draw(jnp.asarray(n)))[0].max() for n in range(60)])

    assert radii(0.0).max() < 1e-5
    assert 0.15 < (radii(0.3) > 1e-3).mean() < 0.45  # another scale: no longer on the shape
    assert (radii(1.0) > 1e-3).mean() > 0.9
    assert (radii(0.0, stretch=1.5) > 1e-3).mean() > 0.9


def test_shapes_too_small_to_draw_widely_are_refused_before_anything_starts():
    shapes = stand_in.shapes(count=2, points=20)
    with pytest.raises(ValueError, match="points need shapes of at least 24; got 20"):
        pairs_of_shapes(shapes, shapes, stand_in.PROTOCOL, seed=0, validation_pairs=1, augment=0.1)


def test_every_twentieth_modelnet_shape_is_held_out(tmp_path):
    for number, name in enumerate(FILES["train"]):
        write_file(tmp_path / name, range(9), number)
    train, validation = load_training_shapes(DataConfig("modelnet40", str(tmp_path), "all"))
    names = list(load_modelnet40(tmp_path, "train").names)
    assert list(validation.names) == [names[19], names[39]]
    assert sorted([*train.names, *validation.names]) == sorted(names)


def test_no_shapes_are_refused():
    nothing, some = stand_in.shapes(0), stand_in.shapes(8)
    with pytest.raises(ValueError, match="at least one shape each; got 0 and 8"):
        pairs_of_shapes(nothing, some, stand_in.PROTOCOL, seed=0, validation_pairs=1)


def test_scans_come_in_batches_and_go_on_where_they_were(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    write_folder(tmp_path)
    (tmp_path / "valid.pkl").write_bytes((tmp_path / "train.pkl").read_bytes())
    config = threedmatch.get_config()
    config.data.folder = str(tmp_path)
    config.protocol.points = 128
    config.train.validation_pairs = 2
    read = read_config(config)
    source = load_training_pairs(
        read.data, read.protocol, seed=0, validation_pairs=read.train.validation_pairs, batch_size=2
    )
    assert source.epoch_pairs == len(load_info(tmp_path, "train")) == 3
    assert source.validation.source.points.shape == (2, 128, 3)
    first = source.arrays(0)
    batches = [next(first) for _ in range(3)]
    resumed = next(source.arrays(2))
    jax.tree.map(np.testing.assert_array_equal, resumed, batches[2])
    assert source.batched
    # A row of the batch is the pair.
    row = jax.tree.map(lambda leaf: jnp.asarray(leaf[1]), batches[2])
    pair = source.draw(jax.random.key(0), jnp.asarray(5), row)
    jax.tree.map(np.testing.assert_array_equal, pair, row)
    monkeypatch.setattr(jax, "process_count", lambda: 2)
    monkeypatch.setattr(jax, "process_index", lambda: 1)
    own = next(source.arrays(2))
    jax.tree.map(
        lambda part, whole: np.testing.assert_array_equal(part, whole[1:]), own, batches[2]
    )


def test_a_share_of_the_pairs_is_of_the_mixture():
    shapes = stand_in.shapes(count=2, points=64)
    clean = dataclasses.replace(stand_in.PROTOCOL, noise_sigma=0.0)
    key = jax.random.key(0)

    def translations(mixture):
        pairs = pairs_of_shapes(shapes, shapes, clean, seed=0, validation_pairs=1, mixture=mixture)
        arrays = jax.tree.map(jnp.asarray, next(pairs.arrays(0)))
        draw = jax.jit(lambda n: pairs.draw(jax.random.fold_in(key, n), n, arrays).target.points)
        return np.array([np.linalg.norm(draw(jnp.asarray(n)).mean(axis=0)) for n in range(40)])

    # The mixture's clouds are centred; a crop of the protocol is not.
    assert (translations(Mixture()) > 1e-3).all()
    assert 0.3 < (translations(Mixture(low_overlap=0.3, turned=0.3)) < 1e-5).mean() < 0.9
