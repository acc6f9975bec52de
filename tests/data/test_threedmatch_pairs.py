"""3DMatch's pairs: the draw, the labels, their cache, and the order of training batches."""

import threading

import jax
import numpy as np
import pytest

from dbdnet_jax.data import overlap as overlap_module
from dbdnet_jax.data import threedmatch
from dbdnet_jax.data.threedmatch import (
    batches,
    load_correspondences,
    load_fragment,
    load_info,
    load_pair,
)
from dbdnet_jax.metrics.recall import correspondence_rmse_m
from tests.data.threedmatch_folder import closer_than, torch_zip, write_folder


@pytest.fixture
def folder(tmp_path):
    write_folder(tmp_path)
    return tmp_path


def trees_equal(a, b):
    for x, y in zip(flat(a), flat(b), strict=True):
        np.testing.assert_array_equal(x, y)


def flat(tree):
    return [leaf for part in tree for leaf in flat(part)] if isinstance(tree, tuple) else [tree]


@pytest.mark.parametrize("i", [0, 1, 2])
def test_pair_against_all_distances(folder, i):
    info = load_info(folder, "train")
    pair = load_pair(folder, info, i, points=256, radius_m=0.1)
    source = load_fragment(folder, info.source[i])
    target = load_fragment(folder, info.target[i])
    moved = source @ info.rotation[i].T + info.translation[i]
    near = {
        "source": (source, closer_than(moved, target, 0.1)),
        "target": (target, closer_than(target, moved, 0.1)),
    }
    for side, labels in (("source", pair.source_overlap), ("target", pair.target_overlap)):
        cloud, (full, expected) = getattr(pair, side), near[side]
        assert cloud.points.shape == (256, 3) and cloud.points.dtype == np.float32
        assert int(cloud.count) == 256
        distance = ((cloud.points[:, None] - full.astype(np.float32)) ** 2).sum(-1)
        rows = distance.argmin(1)
        assert distance.min(1).max() == 0.0 and len(set(rows)) == 256  # drawn, none twice
        np.testing.assert_array_equal(labels, expected[rows])
        assert 0.05 < expected.mean() < 0.95
    np.testing.assert_allclose(pair.target_from_source.rotation, info.rotation[i], atol=1e-7)
    np.testing.assert_allclose(pair.target_from_source.translation, info.translation[i], atol=1e-6)
    assert not pair.source_normals.any() and pair.target_normals.shape == (256, 3)


def test_draw_depends_on_seed_epoch_and_row(folder):
    info = load_info(folder, "train")
    draw = load_pair(folder, info, 0, points=64, seed=1, epoch=2)
    trees_equal(draw, load_pair(folder, info, 0, points=64, seed=1, epoch=2))
    for other in (dict(seed=2, epoch=2), dict(seed=1, epoch=3)):
        changed_draw = load_pair(folder, info, 0, points=64, **other)
        assert (changed_draw.source.points != draw.source.points).any()
    assert (draw.source.points[:64] != draw.target.points[:64]).any()


def test_small_fragment_is_kept_whole_and_padded(folder):
    info = load_info(folder, "train")
    pair = load_pair(folder, info, 0)
    source = load_fragment(folder, info.source[0])
    count = int(pair.source.count)
    assert count == len(source) < 2048 and pair.source.points.shape == (2048, 3)
    np.testing.assert_array_equal(
        np.sort(pair.source.points[:count], axis=0), np.sort(source.astype(np.float32), axis=0)
    )
    assert not pair.source.points[count:].any() and not pair.source_overlap[count:].any()


@pytest.mark.parametrize("i", [-1, 3])
def test_row_outside_the_info(folder, i):
    with pytest.raises(IndexError, match=rf"i must lie in 0\.\.2; got {i}"):
        load_pair(folder, load_info(folder, "train"), i)


def test_correspondences_fit_the_true_pose(folder):
    info = load_info(folder, "train")
    source, target = load_correspondences(folder, info, 0, radius_m=0.1)
    truth = load_pair(folder, info, 0, radius_m=0.1)
    assert len(source) == len(target) == truth.source_overlap.sum() > 50
    moved = source @ info.rotation[0].T + info.translation[0]
    distance = np.linalg.norm(moved - target, axis=1)
    assert distance.max() < 0.1
    assert correspondence_rmse_m(truth.target_from_source, source, target) == pytest.approx(
        np.sqrt((distance**2).mean()), abs=1e-6
    )


def test_overlap_is_searched_once_and_kept(folder, tmp_path, monkeypatch):
    info, cache = load_info(folder, "train"), tmp_path / "new" / "cache"
    first = load_pair(folder, info, 0, cache=cache)
    trees_equal(first, load_pair(folder, info, 0))
    (file,) = cache.iterdir()
    assert file.suffix == ".npz"
    with monkeypatch.context() as patch:
        patch.setattr(overlap_module, "nearest_within", None)
        trees_equal(first, load_pair(folder, info, 0, cache=cache))
        with pytest.raises(TypeError):  # another radius is another question
            load_pair(folder, info, 0, cache=cache, radius_m=0.05)
    for content in (b"", b"not a zip", file.read_bytes()[:-40], _flipped(file.read_bytes())):
        file.write_bytes(content)
        trees_equal(first, load_pair(folder, info, 0, cache=cache))
    load_pair(folder, info, 0, cache=cache, radius_m=0.05)
    assert len(list(cache.iterdir())) == 2


def _flipped(data):
    """A byte of the first array's content changed."""
    at = data.index(b"source.npy") + 40
    return data[:at] + bytes([data[at] ^ 255]) + data[at + 1 :]


def take(stream, count):
    """The next ``count`` batches; the reader is then closed."""
    taken = [next(stream) for _ in range(count)]
    stream.close()
    return taken


def test_batches_resume_where_they_stopped(folder):
    info = load_info(folder, "train")
    given = dict(batch_size=2, seed=5, points=64)
    whole = take(batches(folder, info, **given), 7)
    assert whole[0].source.points.shape == (2, 64, 3)
    assert whole[0].source.count.shape == (2,)
    assert whole[0].target_from_source.rotation.shape == (2, 3, 3)
    for start in (1, 4):
        resumed = take(batches(folder, info, start_step=start, **given), 3)
        for a, b in zip(whole[start : start + 3], resumed, strict=True):
            trees_equal(a, b)
    other = take(batches(folder, info, **(given | {"seed": 6})), 7)
    motions = zip(whole, other, strict=True)
    assert any((a.target_from_source[1] != b.target_from_source[1]).any() for a, b in motions)


def test_a_share_is_read_alone_and_is_its_part_of_the_batches(folder, monkeypatch):
    info, read = load_info(folder, "train"), []

    def noted(*args, epoch, **kwargs):
        read.append((epoch, args[2]))
        return load_pair(*args, epoch=epoch, **kwargs)

    given = dict(batch_size=4, seed=5, points=64, start_step=1)
    with monkeypatch.context() as patch:
        patch.setattr(threedmatch, "load_pair", noted)
        part = take(batches(folder, info, share=(1, 2), **given), 3)
        found = set(read)
    whole = take(batches(folder, info, **given), 3)
    others = set()
    for step, (a, b) in enumerate(zip(whole, part, strict=True), 1):
        trees_equal(jax.tree.map(lambda leaf: leaf[2:], a), b)
        for row, motion in enumerate(a.target_from_source.translation[:2]):
            i = int(np.abs(info.translation - motion).sum(1).argmin())
            others.add(((4 * step + row) // len(info), i))
    assert len(others) == 6 <= len(found) and not found & others


def test_every_epoch_holds_every_pair_in_a_new_order_and_draw(folder):
    info = load_info(folder, "train")
    seen = take(batches(folder, info, batch_size=3, seed=0, points=32), 12)
    orders = []
    for step, batch in enumerate(seen):
        rows = [
            int(np.abs(info.translation - motion).sum(1).argmin())
            for motion in batch.target_from_source.translation
        ]
        assert sorted(rows) == [0, 1, 2]
        orders.append(tuple(rows))
        for place, i in enumerate(rows):
            expected = load_pair(folder, info, i, points=32, seed=0, epoch=step)
            np.testing.assert_array_equal(batch.source.points[place], expected.source.points)
    assert len(set(orders)) > 1


def test_batches_are_read_ahead_but_not_without_end(folder, monkeypatch):
    info, loaded, enough = load_info(folder, "train"), [], threading.Event()

    def count(*args, **kwargs):
        loaded.append(threading.current_thread())
        if len(loaded) >= 3:  # the batch asked for, and two ahead of it
            enough.set()
        return load_pair(*args, **kwargs)

    monkeypatch.setattr(threedmatch, "load_pair", count)
    stream = batches(folder, info, batch_size=1, seed=0, points=32)
    next(stream)
    assert enough.wait(timeout=30)
    assert threading.main_thread() not in loaded
    stream.close()
    assert len(loaded) <= 2 + threedmatch.READ_AHEAD


def test_error_while_reading_ahead_reaches_the_caller(folder):
    info = load_info(folder, "train")
    (folder / info.source[2]).write_bytes(torch_zip(np.full((5, 3), np.nan)))
    stream = batches(folder, info, batch_size=3, seed=0, points=32)
    with pytest.raises(ValueError, match="cloud_bin_10.pth must be finite"):
        next(stream)
    stream.close()
