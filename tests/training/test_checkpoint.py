"""Checkpoints come back bit for bit, or say which folder to delete."""

import errno
import gc
import logging

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from dbdnet_jax.errors import CheckpointError
from dbdnet_jax.training.checkpoint import Checkpoints
from dbdnet_jax.training.step import init_state
from tests.conftest import EXACT, assert_close

OPTIMIZER = optax.chain(optax.clip_by_global_norm(1.0), optax.adamw(lambda step: 1e-3 / (step + 1)))


def state(seed: int, *, ema_decay: float = 0.0):
    rng = np.random.default_rng(seed)
    params = {"b": {"kernel": rng.normal(size=(64, 64)), "bias": rng.normal(size=7)}, "a": [1.5]}
    params = jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.float32), params)
    return init_state(params, OPTIMIZER, ema_decay=ema_decay)


def assert_same(found, expected):
    assert jax.tree.structure(found) == jax.tree.structure(expected)
    for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        assert a.dtype == b.dtype
        assert_close(a, b, EXACT)


def steps(folder) -> set[int]:
    return {int(path.name) for path in (folder / "checkpoints").iterdir() if path.name.isdigit()}


def flip_a_bit(folder) -> None:
    """In the middle of the file that holds the arrays."""
    path = max((p for p in folder.rglob("*") if p.is_file()), key=lambda p: p.stat().st_size)
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    path.write_bytes(content)


@pytest.mark.parametrize("ema_decay", [0.0, 0.9])
def test_a_state_comes_back_bit_for_bit(tmp_path, ema_decay):
    saved = state(1, ema_decay=ema_decay)
    with Checkpoints(tmp_path) as checkpoints:
        assert checkpoints.latest_step() is None and checkpoints.best_step() is None
        checkpoints.save(7, saved)
    with Checkpoints(tmp_path) as checkpoints:
        assert checkpoints.latest_step() == 7
        assert_same(checkpoints.restore(7, state(2, ema_decay=ema_decay)), saved)


def test_the_newest_two_and_the_best_are_kept(tmp_path):
    with Checkpoints(tmp_path) as checkpoints:
        for step, error in enumerate([3.0, 1.0, None, 2.0, None, 1.0, 5.0, None], start=1):
            checkpoints.save(step, state(step), error)
            if step == 5:
                assert checkpoints.best_step() == 2 and steps(tmp_path) == {2, 4, 5}
        assert checkpoints.best_step() == 6  # of equals, the one trained longer
        assert steps(tmp_path) == {6, 7, 8}


def test_of_equal_errors_the_one_trained_longer_is_the_best(tmp_path):
    with Checkpoints(tmp_path) as checkpoints:
        for step in (1, 2):
            checkpoints.save(step, state(step), 0.5)
        assert steps(tmp_path) == {1, 2} and checkpoints.best_step() == 2


def test_a_folder_left_by_a_kill_while_saving_is_no_checkpoint(tmp_path):
    with Checkpoints(tmp_path) as checkpoints:
        checkpoints.save(1, state(1))
    torn = tmp_path / "checkpoints" / "2.orbax-checkpoint-tmp"
    (torn / "state").mkdir(parents=True)
    with Checkpoints(tmp_path) as checkpoints:
        assert checkpoints.latest_step() == 1
        checkpoints.save(2, state(2))
        assert_same(checkpoints.restore(2, state(0)), state(2))


@pytest.mark.parametrize("damage", ["a flipped bit", "half a file", "an empty file", "no file"])
def test_a_damaged_checkpoint_names_the_folder_to_delete(tmp_path, caplog, damage):
    with Checkpoints(tmp_path) as checkpoints:
        checkpoints.save(1, state(1))
        checkpoints.save(2, state(2))
    folder = tmp_path / "checkpoints" / "2"
    if damage == "a flipped bit":
        flip_a_bit(folder)
    elif damage == "half a file":
        path = max((folder / "state" / "d").iterdir(), key=lambda path: path.stat().st_size)
        path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    else:
        path = folder / "state" / "manifest.ocdbt"
        path.unlink() if damage == "no file" else path.write_bytes(b"")
    with Checkpoints(tmp_path) as checkpoints:
        with pytest.raises(
            CheckpointError, match=r"checkpoints/2 is damaged .* Delete what is named"
        ):
            checkpoints.restore(2, state(0))
        assert_same(checkpoints.restore(1, state(0)), state(1))
    gc.collect()  # of failed tasks asyncio says so when they are collected
    assert not caplog.records  # libraries log pages


def test_tasks_that_are_collected_later_say_nothing_of_a_damage_that_was_said(tmp_path, caplog):
    with Checkpoints(tmp_path) as checkpoints:
        checkpoints.save(1, state(1))
        (folder := tmp_path / "checkpoints" / "1").joinpath("state", "manifest.ocdbt").unlink()
        with pytest.raises(CheckpointError):
            checkpoints.restore(1, state(0))
    for place in (folder, folder.with_name("10")):
        logging.getLogger("asyncio").error("Task exception was never retrieved: %s/state", place)
    assert [f"{folder}0/state" in record.getMessage() for record in caplog.records] == [True]


def test_a_damaged_newest_checkpoint_is_set_aside(tmp_path):
    with Checkpoints(tmp_path) as checkpoints:
        checkpoints.save(1, state(1), window=[{"loss": 0.1}])
        checkpoints.save(2, state(2))
    for aside in ("damaged-2", "damaged-2-1"):
        flip_a_bit(tmp_path / "checkpoints" / "2")
        with Checkpoints(tmp_path) as checkpoints:
            with pytest.warns(RuntimeWarning, match=f"2 is damaged .*checksum.* now .*{aside}, "):
                step, found, window = checkpoints.resume(state(0))
            assert step == checkpoints.latest_step() == 1 and window == [{"loss": 0.1}]
            assert_same(found, state(1))
            checkpoints.save(2, state(2))
        assert (tmp_path / "checkpoints" / aside).is_dir()


def test_where_all_checkpoints_are_damaged_all_are_named_and_kept(tmp_path):
    with Checkpoints(tmp_path) as checkpoints:
        assert checkpoints.resume(state(0)) is None
        for step in (1, 2):
            checkpoints.save(step, state(step))
            flip_a_bit(tmp_path / "checkpoints" / str(step))
        with pytest.raises(CheckpointError, match=r"/2 is damaged .*/1 is damaged .*Delete what"):
            checkpoints.resume(state(0))
    assert steps(tmp_path) == {1, 2}


@pytest.mark.parametrize("content", ["{", '{"loss": 1}', "", "\0\0"])
def test_unreadable_metrics_cost_their_checkpoint_only(tmp_path, content):
    with Checkpoints(tmp_path) as checkpoints:
        checkpoints.save(1, state(1), 0.5)
        checkpoints.save(2, state(2), 0.4)
    (tmp_path / "checkpoints" / "2" / "metrics" / "metrics").write_text(content)
    with pytest.raises(CheckpointError, match=r"checkpoints/2 is damaged \(its metrics"):
        Checkpoints(tmp_path, read_only=True)
    with pytest.warns(RuntimeWarning, match="damaged-2, which may be deleted"):
        with Checkpoints(tmp_path) as checkpoints:
            assert checkpoints.best_step() == checkpoints.latest_step() == 1
    with Checkpoints(tmp_path) as checkpoints:  # and without a warning from then on
        assert checkpoints.latest_step() == 1


@pytest.mark.parametrize(
    "failure",
    [
        OSError(errno.EMFILE, "Too many open files"),
        ValueError("Error reading ... [OS error 13: EACCES Permission denied] [source ..."),
        MemoryError(),
    ],
)
def test_errors_of_the_machine_are_no_damage(tmp_path, monkeypatch, failure):
    with Checkpoints(tmp_path) as checkpoints:
        checkpoints.save(1, state(1))

        def fail(*_, **__):
            try:
                raise failure
            except Exception as error:
                raise RuntimeError("a thread of a library failed") from error

        monkeypatch.setattr(type(checkpoints._orbax), "load", fail)
        with pytest.raises(OSError, match=r"Too many|Permission|memory.*checkpoints/1"):
            checkpoints.resume(state(0))
        monkeypatch.setattr(type(checkpoints._orbax), "save", fail)
        with pytest.raises(OSError, match=r"Too many|Permission|memory"):
            checkpoints.save(2, state(2))
    assert steps(tmp_path) == {1}


def test_a_reader_leaves_what_a_training_is_writing(tmp_path):
    with Checkpoints(tmp_path) as checkpoints:
        checkpoints.save(1, state(1))
    writing = tmp_path / "checkpoints" / "2.orbax-checkpoint-tmp"
    writing.mkdir()
    with Checkpoints(tmp_path, read_only=True) as checkpoints:
        assert checkpoints.latest_step() == 1 and writing.is_dir()
