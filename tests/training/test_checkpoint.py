"""Checkpoints come back bit for bit, or say which folder to delete."""

import json

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from dbdnet_jax.errors import CheckpointError
from dbdnet_jax.networks.dbdnet.config import ModelConfig
from dbdnet_jax.training.checkpoint import Checkpoints, load_best, write_stage
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


def test_what_an_older_release_did_not_write_has_its_default(tmp_path):
    defaults = {"train": {"seed": 0, "schedule": "cosine"}, "joint": {"epochs": 1.0}}
    write_stage(tmp_path / "overlap", {"train": {"seed": 3}})
    write_stage(tmp_path / "overlap", {"train": {"seed": 3, "schedule": "cosine"}}, defaults)
    with pytest.raises(CheckpointError, match="schedule = cosine, this configuration constant"):
        write_stage(tmp_path / "overlap", {"train": {"seed": 3, "schedule": "constant"}}, defaults)


def test_a_folder_left_by_a_kill_while_saving_is_no_checkpoint(tmp_path):
    with Checkpoints(tmp_path) as checkpoints:
        checkpoints.save(1, state(1))
    torn = tmp_path / "checkpoints" / "2.orbax-checkpoint-tmp"
    (torn / "state").mkdir(parents=True)
    with Checkpoints(tmp_path) as checkpoints:
        assert checkpoints.latest_step() == 1
        checkpoints.save(2, state(2))
        assert_same(checkpoints.restore(2, state(0)), state(2))


@pytest.mark.parametrize("damage", ["a flipped bit", "an empty file", "a missing file"])
def test_a_damaged_checkpoint_names_the_folder_to_delete(tmp_path, damage):
    with Checkpoints(tmp_path) as checkpoints:
        checkpoints.save(1, state(1))
        checkpoints.save(2, state(2))
    folder = tmp_path / "checkpoints" / "2"
    if damage == "a flipped bit":
        flip_a_bit(folder)
    else:
        path = folder / "state" / "manifest.ocdbt"
        path.unlink() if damage == "a missing file" else path.write_bytes(b"")
    with Checkpoints(tmp_path) as checkpoints:
        with pytest.raises(CheckpointError, match=r"checkpoints/2 is damaged .* step 1, again"):
            checkpoints.restore(2, state(0))
        assert_same(checkpoints.restore(1, state(0)), state(1))


def test_unreadable_metrics_name_the_folder(tmp_path):
    with Checkpoints(tmp_path) as checkpoints:
        checkpoints.save(1, state(1), 0.5)
    (tmp_path / "checkpoints" / "1" / "metrics" / "metrics").write_text("{")
    with pytest.raises(CheckpointError, match="Delete that folder"):
        Checkpoints(tmp_path)


def test_a_stage_goes_on_only_with_its_own_configuration(tmp_path):
    record = {"model": {"heads": 4}, "train": {"seed": 0}}
    write_stage(tmp_path / "overlap", record)
    write_stage(tmp_path / "overlap", record)
    with pytest.raises(CheckpointError, match=r"model\.heads = 4, this configuration 2"):
        write_stage(tmp_path / "overlap", {"model": {"heads": 2}, "train": {"seed": 0}})


def save_run(run_dir, stage: str, config: dict, error: float | None, *, ema_decay: float = 0.0):
    saved = state(3, ema_decay=ema_decay)
    if ema_decay:
        saved = saved.replace(ema=jax.tree.map(lambda leaf: leaf + 1, saved.params))
    write_stage(run_dir / stage, {"model": config})
    with Checkpoints(run_dir / stage) as checkpoints:
        checkpoints.save(1, saved, error)
        checkpoints.save(2, state(4), None)
    return saved


def test_load_best_takes_each_stage_and_prefers_the_average(tmp_path):
    config = {"heads": 2, "released": True}
    overlap = save_run(tmp_path, "overlap", config, 0.5)
    params = load_best(tmp_path)
    assert params.config == ModelConfig(heads=2, released=True) and params.registration is None
    assert_same(params.overlap, overlap.params)
    registration = save_run(tmp_path, "registration", config, 0.5, ema_decay=0.9)
    assert_same(load_best(tmp_path).registration, registration.ema)


def test_load_best_says_what_is_missing_or_wrong(tmp_path):
    with pytest.raises(CheckpointError, match=r"has none. Train first"):
        load_best(tmp_path)
    save_run(tmp_path, "overlap", {}, None)
    with pytest.raises(CheckpointError, match=r"has none. Train first"):
        load_best(tmp_path)
    save_run(tmp_path, "registration", {}, 0.5)
    path = tmp_path / "registration" / "stage.json"
    path.write_text(json.dumps({"model": {"no_such_field": 1}}))
    with pytest.raises(CheckpointError, match="must be the fields of ModelConfig.*no_such_field"):
        load_best(tmp_path)
    path.write_text("{")
    with pytest.raises(CheckpointError, match=r"readable stage\.json"):
        load_best(tmp_path)
    path.write_text(json.dumps({"model": {}}))
    flip_a_bit(tmp_path / "registration" / "checkpoints" / "1")
    with pytest.raises(CheckpointError, match="checkpoints/1 is damaged"):
        load_best(tmp_path)
