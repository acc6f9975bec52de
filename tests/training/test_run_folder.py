"""The best weights of a run's stages, or what is wrong with its folder."""

import json

import jax
import pytest

from dbdnet_jax.errors import CheckpointError
from dbdnet_jax.networks.dbdnet.config import ModelConfig
from dbdnet_jax.training.checkpoint import Checkpoints
from dbdnet_jax.training.run_folder import load_best, write_stage
from tests.training.test_checkpoint import assert_same, flip_a_bit, state


def test_what_an_older_release_did_not_write_has_its_default(tmp_path):
    defaults = {"train": {"seed": 0, "schedule": "cosine"}, "joint": {"epochs": 1.0}}
    write_stage(tmp_path / "overlap", {"train": {"seed": 3}})
    write_stage(tmp_path / "overlap", {"train": {"seed": 3, "schedule": "cosine"}}, defaults)
    with pytest.raises(CheckpointError, match="schedule = cosine, this configuration constant"):
        write_stage(tmp_path / "overlap", {"train": {"seed": 3, "schedule": "constant"}}, defaults)


def test_a_stage_goes_on_only_with_its_own_configuration(tmp_path):
    record = {"model": {"heads": 4}, "train": {"seed": 0}}
    write_stage(tmp_path / "overlap", record)
    write_stage(tmp_path / "overlap", record)
    with pytest.raises(CheckpointError, match=r"model\.heads = 4, this configuration 2"):
        write_stage(tmp_path / "overlap", {"model": {"heads": 2}, "train": {"seed": 0}})


def test_the_stages_of_a_run_are_of_one_network_and_each_of_its_own_settings(tmp_path):
    defaults = {"model": {"heads": 4, "overlap_passes": 1}}
    write_stage(tmp_path / "overlap", {"model": {"heads": 4}, "overlap": {"epochs": 3}})
    record = {"model": {"heads": 4, "overlap_passes": 1}, "registration": {"epochs": 5}}
    write_stage(tmp_path / "registration", record, defaults)
    record = {"model": {"heads": 4, "overlap_passes": 3}}
    with pytest.raises(CheckpointError, match=r"overlap has model\.overlap_passes = 1, .* 3\."):
        write_stage(tmp_path / "joint", record, defaults)
    with pytest.raises(CheckpointError, match=r"has method = dbdnet, this configuration masknet"):
        write_stage(tmp_path / "masknet", {"method": "masknet", **record})
    assert not (tmp_path / "joint").exists() and not (tmp_path / "masknet").exists()


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


def test_load_best_does_not_put_networks_of_two_configurations_together(tmp_path):
    save_run(tmp_path, "overlap", {}, 0.5)
    save_run(tmp_path, "registration", {}, 0.5)
    path = tmp_path / "registration" / "stage.json"
    path.write_text(json.dumps({"model": {"heads": 2}}))
    with pytest.raises(CheckpointError, match=r"overlap has model\.heads = 4, .*registration 2\."):
        load_best(tmp_path)


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
