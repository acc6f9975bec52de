"""The pairs that a configuration is tested on, and `evaluate.py` from the command line."""

import json
import subprocess
import sys
from pathlib import Path

import jax
import numpy as np
import pytest

from configs import cad
from dbdnet_jax.data import test_pairs
from dbdnet_jax.data.frozen import cad_test_pairs
from dbdnet_jax.data.modelnet40 import FILES, load_modelnet40
from dbdnet_jax.evaluation.methods import Weights, labels_of, load_weights
from dbdnet_jax.evaluation.run import evaluate
from dbdnet_jax.metrics.recall import correspondence_rmse_m
from dbdnet_jax.networks.dbdnet.config import ModelConfig
from dbdnet_jax.networks.params import Params, unflatten
from dbdnet_jax.networks.table import parameter_shapes
from dbdnet_jax.networks.weights import PRETRAINED, save_params
from dbdnet_jax.training.config import RunConfig, read_config
from tests.data.test_modelnet40 import LABELS, write_file
from tests.data.threedmatch_folder import SCENES, write_folder

ROOT = Path(__file__).parents[1]
TINY = ModelConfig(
    overlap_channels=4,
    overlap_blocks=1,
    registration_channels=4,
    shared_blocks=1,
    rotation_blocks=1,
    translation_blocks=1,
    neighbours=4,
    neighbour_space="coordinates",
)


def tiny_params() -> Params:
    """Small random weights: finite answers, no skill."""
    rng = np.random.default_rng(0)
    shapes = parameter_shapes(TINY)
    arrays = {name: rng.normal(0, 0.2, shape) for name, shape in shapes.items()}
    return unflatten({name: array.astype(np.float32) for name, array in arrays.items()}, TINY)


def cad_config(**fields) -> RunConfig:
    config = cad.get_config()
    config.update_from_flattened_dict({k.replace("__", "."): v for k, v in fields.items()})
    return read_config(config)


def asked_for(config: RunConfig, folder: Path, *benchmark: str) -> test_pairs.PairSet:
    return test_pairs.load_test_pairs(config.data, config.protocol, folder, *benchmark)


def run(*arguments: str) -> subprocess.CompletedProcess:
    command = [sys.executable, "evaluate.py", "--config=configs/cad.py", *arguments]
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True)


@pytest.mark.parametrize(
    ("fields", "variant"),
    [
        ({}, "noise"),
        ({"protocol__noise_sigma": 0.0}, "clean"),
        ({"protocol__disjoint": True}, "disjoint"),
        ({"data__categories": "seen"}, "unseen"),
    ],
)
def test_the_packages_frozen_sets_are_used_where_they_fit(fields, variant, tmp_path):
    found = asked_for(cad_config(**fields), tmp_path)
    pairs, digest = cad_test_pairs(variant)
    assert (found.name, found.digest) == (f"cad_test_{variant}", digest)
    assert np.array_equal(found.pairs.source.points, pairs.source.points)
    assert not list(tmp_path.iterdir())


def test_another_protocol_is_drawn_once_and_the_same_every_time(tmp_path, monkeypatch):
    monkeypatch.setattr(test_pairs, "CAD_PAIRS", 4)
    config = cad_config(protocol__points=64, data__categories="unseen")
    first, again = (asked_for(config, tmp_path / name) for name in "ab")
    assert first.name == "cad_test_seen" and first.digest == again.digest
    assert first.pairs.source.points.shape == (4, 45, 3)
    assert [path.name for path in (tmp_path / "a").iterdir()] == ["cad_test_seen.npz"]
    clean = cad_config(protocol__points=64, protocol__noise_sigma=0.0, data__categories="unseen")
    assert asked_for(clean, tmp_path / "a").digest != first.digest


def test_modelnet40_has_one_pair_for_every_test_shape_of_the_other_half(tmp_path):
    for split in FILES.values():
        for seed, name in enumerate(split):
            write_file(tmp_path / name, LABELS, seed)
    config = cad_config(
        data__name="modelnet40",
        data__folder=str(tmp_path),
        data__categories="seen",
        protocol__points=16,
    )
    found = asked_for(config, tmp_path / "run")
    assert found.name == "modelnet40_test_unseen"
    assert len(found.pairs.source.count) == len(load_modelnet40(tmp_path, "test", "unseen")) == 4


def test_scans_are_the_benchmarks_pairs_and_come_without_normals(tmp_path):
    write_folder(tmp_path)
    (tmp_path / "train.pkl").rename(tmp_path / "3DLoMatch.pkl")
    config = cad_config(
        data__name="threedmatch",
        data__folder=str(tmp_path),
        protocol__points=64,
        protocol__overlap_radius=0.0375,
    )
    first, again = (asked_for(config, tmp_path / "run", "3DLoMatch") for _ in range(2))
    assert first.name == "3DLoMatch" and first.digest == again.digest
    assert first.pairs.source.points.shape == (3, 64, 3)
    assert not first.pairs.source_normals.any()
    assert first.scans.scenes == SCENES and list(first.scans.consecutive) == [False, True, False]
    for (source, target), i in zip(first.scans.correspondences, range(3), strict=True):
        motion = jax.tree.map(lambda leaf, i=i: leaf[i], first.pairs.target_from_source)
        assert (
            source.dtype == np.float32 and 0 < correspondence_rmse_m(motion, source, target) < 0.04
        )
    assert [len(part) for part in first.scans.first(2)] == [2, 2, 2]


def test_pairs_are_not_read_from_nowhere_nor_is_a_benchmark_of_scans_passed_over(tmp_path):
    with pytest.raises(ValueError, match=r"config\.data\.folder must be where modelnet40 stands"):
        asked_for(cad_config(data__name="modelnet40"), tmp_path)
    with pytest.raises(ValueError, match="must be '3DMatch' unless .* got '3DLoMatch' for 'cad'"):
        asked_for(cad_config(), tmp_path, "3DLoMatch")


@pytest.mark.parametrize(
    ("given", "labels"),
    [
        (["runs/a/params.npz", "runs/b/params.npz"], ["a", "b"]),
        (["one/a/params.npz", "two/a/params.npz", "mine.npz"], ["one/a", "two/a", "mine"]),
        (["runs/a/best.npz", "runs/b/best.npz"], ["a/best", "b/best"]),
        (["cad", "runs/cad/params.npz"], ["cad", "runs/cad"]),
        (["a.npz", "a/params.npz"], ["a", "params"]),
        (["runs/a/params.npz"], ["a"]),
    ],
)
def test_weights_are_called_by_what_tells_them_apart(given, labels):
    assert labels_of(given) == labels


@pytest.mark.parametrize("again", ["runs/../mine.npz", "mine.npz", "PACKAGED"])
def test_the_same_weights_twice_are_refused(again):
    again = again.replace("PACKAGED", str(PRETRAINED / "cad.npz"))
    with pytest.raises(ValueError, match=f"must each be of another file; got {again} for .* Leave"):
        load_weights(["mine.npz", "cad", again])


def test_params_without_a_registration_network_are_refused(tmp_path):
    params = Params({"overlap": {}}, ModelConfig())
    with pytest.raises(
        ValueError, match="needs a registration network.*hold only overlap.*--stage=registration"
    ):
        evaluate([Weights("", params)], asked_for(cad_config(), tmp_path), seed=0, command="")


def test_the_script_prints_the_table_and_writes_it(tmp_path):
    save_params(tmp_path / "tiny.npz", tiny_params())
    flags = f"--params={tmp_path}/tiny.npz", f"--run_dir={tmp_path}", "--config.protocol.points=128"
    done = run(*flags, "--count=2", "--report")
    assert done.returncode == 0, done.stderr
    for method in ("identity", "ICP", "FGR, true normals", "DBDNet (untrained)", "DBDNet "):
        assert f"\n{method}" in done.stdout
    content = json.loads((tmp_path / "evaluation_cad_test_all_first_2.json").read_text())
    assert content["pairs"] == 2 and content["pairs_hash"] in done.stdout
    assert content["command"].startswith("python evaluate.py --config=configs/cad.py")
    assert {row["method"] for row in content["rows"] if row["overlap_f1"] is not None} == {
        "DBDNet", "DBDNet (untrained)", "align, DBDNet", "all points overlapping (constant)",
    }  # fmt: skip
    assert (tmp_path / "evaluation_cad_test_all_first_2.csv").is_file()
    page = (tmp_path / "evaluation_cad_test_all_first_2.html").read_text()
    assert page.startswith("<!DOCTYPE html>") and "Worst pair" in page


@pytest.mark.parametrize(
    ("flag", "message"),
    [
        ("--params=nothing.npz", "there is no file nothing.npz. Train first"),
        ("--params=unknown", "name must be one of the weights"),
        ("--run_dir=no_such_run", "must hold a validated checkpoint; no_such_run has none"),
        ("--config.protocol.point=3", "it has no"),
    ],
)
def test_mistakes_are_one_line(flag, message):
    done = run(flag)
    lines = done.stderr.splitlines()
    assert done.returncode == 1 and message in lines[-1] and "Traceback" not in done.stderr
