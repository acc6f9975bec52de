"""The configurations say what the paper says, and a wrong one is told so in one line."""

import dataclasses
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
from ml_collections import ConfigDict

from configs import cad, cad_long, cad_short, modelnet, threedmatch
from configs.peers import (
    dcp,
    dcp_cad,
    finet,
    finet_cad,
    inenet,
    inenet_cad,
    masknet,
    masknet_cad,
    omnet,
    omnet_cad,
    rienet,
    rienet_cad,
)
from dbdnet_jax.data.pairs import Protocol
from dbdnet_jax.networks.dbdnet.config import ModelConfig
from dbdnet_jax.networks.masknet.network import MaskNetConfig
from dbdnet_jax.networks.table import LEARNED
from dbdnet_jax.training.config import default_config, read_config, stage_record
from dbdnet_jax.training.losses import LossWeights
from dbdnet_jax.training.table import STAGES
from dbdnet_jax.training.task import RunConfig, TrainConfig
from tests.ladder import LADDER

ROOT = Path(__file__).parents[1]
CONFIGS = {
    "modelnet": modelnet,
    "threedmatch": threedmatch,
    "cad": cad,
    "cad_short": cad_short,
    "cad_long": cad_long,
}
PEERS = {
    "masknet": masknet,
    "dcp": dcp,
    "rienet": rienet,
    "omnet": omnet,
    "finet": finet,
    "inenet": inenet,
}
PEERS |= {
    "masknet_cad": masknet_cad,
    "dcp_cad": dcp_cad,
    "rienet_cad": rienet_cad,
    "omnet_cad": omnet_cad,
    "finet_cad": finet_cad,
    "inenet_cad": inenet_cad,
}
ALL = CONFIGS | PEERS | LADDER


def train(*arguments: str) -> subprocess.CompletedProcess:
    return subprocess.run(
        [sys.executable, "train.py", *arguments],
        cwd=ROOT,
        env={**os.environ, "JAX_PLATFORMS": "cpu"},
        capture_output=True,
        text=True,
        timeout=120,
    )


def with_change(**changes: object) -> ConfigDict:
    """The CAD configuration with fields set by their dotted names (``__`` for the dot)."""
    config = cad.get_config()
    with config.unlocked():
        for name, value in changes.items():
            *path, last = name.split("__")
            section = config
            for step in path:
                section = section[step]
            section[last] = value
    return config


@pytest.mark.parametrize("name", ALL)
def test_every_configuration_holds_exactly_the_fields_there_are(name):
    config = ALL[name].get_config()
    found = read_config(config)
    assert isinstance(found, RunConfig)
    model = LEARNED[found.method].config
    for section, record in (("model", model), ("protocol", Protocol), ("train", TrainConfig)):
        assert set(config[section]) == {field.name for field in dataclasses.fields(record)}
    assert set(config) - set(found.stages) == {"method", "model", "data", "protocol", "train"}


@pytest.mark.parametrize("name", ALL)
def test_configurations_are_locked(name):
    with pytest.raises(AttributeError, match="batchsize"):
        ALL[name].get_config().train.batchsize = 4


@pytest.mark.parametrize("method", STAGES)
def test_a_method_has_a_record_of_every_stage_and_defaults_for_all(method):
    found = read_config(default_config(method))
    assert found.method == method and set(found.stages) == set(STAGES[method])
    assert set(LEARNED[method].parts) <= set(STAGES[method])  # a stage is named as its network
    for stage in found.stages.values():
        assert stage.epochs > 0 and stage.batch_size > 0 and stage.learning_rate > 0


def test_masknets_optimizer_is_its_authors():
    config = read_config(masknet.get_config())
    assert config.model == MaskNetConfig()
    stage = config.stages["masknet"]
    assert (stage.epochs, stage.batch_size, stage.learning_rate) == (500, 32, 1e-4)
    train = config.train
    assert (train.optimizer, train.weight_decay, train.schedule) == ("adam", 0.0, "constant")
    assert train.warmup_epochs == train.clip_norm == train.ema_decay == 0


def test_modelnet_is_the_papers():
    config = read_config(modelnet.get_config())
    assert config.model == ModelConfig()  # the released architecture, which a test counts
    assert config.protocol == Protocol(
        points=1024,
        keep=0.7,
        max_angle_deg=45.0,
        max_translation=1.0,
        noise_sigma=0.01,
        noise_clip=0.05,
        disjoint=False,
        overlap_radius=0.1,
    )
    assert config.train.learning_rate == config.train.weight_decay == 1e-4
    assert config.train.warmup_epochs == 5
    assert config.train.clip_norm == config.train.ema_decay == 0
    assert config.stages["overlap"].gamma == 4
    assert config.stages["registration"].weights == LossWeights(
        correspondence=5.0, rotation=1.0, translation=1.0, distance=1.0
    )
    assert config.stages["registration"].masks == "predicted"
    for stage in (config.stages["overlap"], config.stages["registration"]):
        assert (stage.epochs, stage.batch_size, stage.learning_rate) == (300, 8, 1e-4)


def test_threedmatch_is_the_papers():
    config = read_config(threedmatch.get_config())
    assert config.model == ModelConfig()
    assert (config.protocol.points, config.protocol.overlap_radius) == (2048, 0.0375)
    overlap, registration = config.stages["overlap"], config.stages["registration"]
    assert (overlap.epochs, overlap.batch_size) == (150, 2)
    assert (registration.epochs, registration.batch_size) == (50, 1)
    assert registration.weights == LossWeights(rotation=5.0)
    assert overlap.learning_rate == registration.learning_rate == 1e-4


def test_the_cad_configurations_keep_the_papers_protocol():
    for config in (cad, cad_short, cad_long):
        assert read_config(config.get_config()).protocol == Protocol()


def test_stages_follow_the_shared_fields_until_set():
    config = cad.get_config()
    config.train.batch_size = 4
    assert (config.overlap.batch_size, config.registration.batch_size) == (4, 4)
    config.registration.batch_size = 2
    config = read_config(config)
    assert (config.stages["overlap"].batch_size, config.stages["registration"].batch_size) == (4, 2)


def test_a_stage_may_resume_only_with_what_decides_its_outcome():
    base, other = (read_config(with_change(registration__epochs=e)) for e in (1.0, 2.0))
    assert stage_record(base, "overlap") == stage_record(other, "overlap")
    assert stage_record(base, "registration") != stage_record(other, "registration")
    assert stage_record(base, "joint") != stage_record(other, "joint")  # its loss is of both
    elsewhere = {"train__devices": 3, "train__accumulate": 2, "train__remat": True}
    more_devices = read_config(with_change(registration__epochs=1.0, **elsewhere))
    assert stage_record(base, "registration") == stage_record(more_devices, "registration")


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"model__overlap_chanels": 8}, r"config\.model\.overlap_channels\?"),
        ({"registration__weights__rotatoin": 1.0}, r"config\.registration\.weights\.rotation\?"),
        ({"trian": {}}, r"Did you mean config\.train\?"),
        ({"data__name": "modelnet"}, r"one of \('cad', 'modelnet40', 'threedmatch'\); got 'mod"),
        ({"train__log_every": 30}, r"validate_every must be a multiple of .*log_every = 30"),
        ({"train__accumulate": 0}, r"accumulate must be at least 1; got 0"),
        ({"train__validation_pairs": 0}, r"validation_pairs must be at least 1; got 0"),
        ({"overlap__epochs": 0.0}, r"config\.overlap\.epochs must be positive; got 0"),
        ({"method": "icp"}, r"config\.method must be one of dbdnet, masknet.*; got 'icp'"),
        ({"train__optimizer": "sgd"}, r"optimizer must be one of \('adamw', 'adam'\); got 'sgd'"),
        ({"train__precision": "half"}, r"one of \('float32', 'bfloat16'\); got 'half'"),
        ({"train__schedule": "steps"}, r"milestones must be given for schedule='steps'"),
        ({"joint__batch_size": 0}, r"config\.joint\.batch_size must be from 1 .*; got 0"),
        (
            {"data__augment": 1.5},
            r"config\.data\.augment must be in \[0, 1\].*; got 1\.5 for 'cad'",
        ),
        ({"data__augment": 0.5, "data__name": "threedmatch"}, r"0 for 'threedmatch'.*got 0\.5"),
        ({"model__overlap_channels": 6}, r"multiple of 4"),
    ],
)
def test_a_wrong_configuration_is_refused(changes, message):
    with pytest.raises(ValueError, match=message):
        read_config(with_change(**changes))


def test_a_precision_is_for_the_method_that_knows_it():
    config = masknet_cad.get_config()
    config.train.precision = "bfloat16"
    with pytest.raises(ValueError, match="'float32' but for the method dbdnet; got 'bfloat16' for"):
        read_config(config)


def leaves(section: ConfigDict, *path: str) -> list[tuple[str, ...]]:
    """The dotted names of all fields, as tuples."""
    found = []
    for name, value in section.items():
        inside = isinstance(value, ConfigDict)
        found += leaves(value, *path, name) if inside else [(*path, name)]
    return found


@pytest.mark.parametrize("path", leaves(cad.get_config()), ids=".".join)
def test_every_field_refuses_what_is_no_number_and_other_types(path):
    for value in (float("nan"), float("inf"), -float("inf"), 1e300, None, [1], {"a": 1}, b"x"):
        config = cad.get_config().to_dict()
        section = config
        for name in path[:-1]:
            section = section[name]
        section[path[-1]] = value
        with pytest.raises(ValueError, match=rf"{re.escape('.'.join(path))} must be .*; got"):
            read_config(ConfigDict(config))


@pytest.mark.parametrize("field", ["heads", "neighbours", "overlap_channels", "iterations"])
def test_a_network_of_nothing_is_refused_by_its_field(field):
    with pytest.raises(ValueError, match=rf"in config\.model: {field} must be from"):
        read_config(with_change(**{f"model__{field}": 0}))


def test_only_the_released_network_iterates():
    with pytest.raises(
        ValueError, match=r"iterations must be 1 unless released=True.*got 2\. Use 1"
    ):
        read_config(with_change(model__iterations=2))


def test_a_missing_section_is_named_and_a_missing_field_has_its_default():
    config = with_change()
    with config.unlocked():
        del config.train["seed"]
    assert read_config(config).train.seed == TrainConfig().seed
    with config.unlocked():
        del config["train"]
    with pytest.raises(ValueError, match=r"every section of the method dbdnet; it lacks train"):
        read_config(config)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--config=configs/cad.py", "--config.train.batchsize=4"], 'Did you mean "batch_size"'),
        (["--config=configs/cad.py", "--config.model.heads=0"], "heads must be from 1"),
        (["--config=configs/cad.py", "--config.train.learning_rate=nan"], "learning_rate must be"),
        (["--config=configs/cad.py", "--stage=masknet"], "one of overlap, registration, joint for"),
        (["--config=configs/nothing.py"], "there is none at configs/nothing.py"),
        (["--config=configs/modelnet.py", "--config.data.folder=/nowhere"], "none at /nowhere"),
        (["--config=configs/threedmatch.py"], "Give --config.data.folder=PATH"),
    ],
    ids=[
        "misspelt field",
        "no heads",
        "no number",
        "stage of another method",
        "no such configuration",
        "no such folder",
        "no folder given",
    ],
)
def test_the_script_says_in_one_line_what_is_wrong(arguments, message, tmp_path):
    done = train(*arguments, f"--run_dir={tmp_path / 'run'}")
    assert done.returncode == 1
    assert message in done.stderr and "Traceback" not in done.stderr
    lines = [line for line in done.stderr.splitlines() if line.strip()]
    assert lines[-1].startswith("error: "), done.stderr
    assert not (tmp_path / "run").exists()
