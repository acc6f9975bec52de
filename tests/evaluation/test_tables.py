"""Evaluation of methods on a handful of pairs, and the tables and files made of it."""

import csv
import json
import os
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dbdnet_jax.classical import open3d as classical
from dbdnet_jax.data.test_pairs import PairSet
from dbdnet_jax.evaluation import run as evaluation
from dbdnet_jax.evaluation import tables as reports
from dbdnet_jax.evaluation.methods import (
    Method,
    Traits,
    from_network,
    from_normals,
    from_points,
    from_true_overlap,
)
from dbdnet_jax.evaluation.run import Evaluation, Row, constant_overlap, evaluate_method
from dbdnet_jax.metrics.pose import OverlapSummary, Summary
from dbdnet_jax.metrics.recall import ScanRecall, Scans
from dbdnet_jax.networks.dbdnet import method as dbdnet
from dbdnet_jax.networks.dbdnet.config import ModelConfig
from dbdnet_jax.networks.params import Params
from dbdnet_jax.ops import rigid
from dbdnet_jax.types import Answer, Branch, Cloud, Pair, Registration, Rigid
from tests.conftest import FLOAT32, assert_close

ROWS, COUNT = 40, 32  # rows of a cloud, and the points among them
STAND_IN = Params({"overlap": 0.9}, ModelConfig())


@pytest.fixture(scope="module")
def pairs() -> Pair:
    """Three NumPy pairs of full copies; three quarters of the valid points overlap."""
    rng = np.random.default_rng(0)

    def pair(key) -> Pair:
        motion = jax.device_get(rigid.random_rigid(key, 0.5, 0.5))
        points = rng.normal(size=(ROWS, 3)).astype(np.float32)
        target = points @ motion.rotation.T + motion.translation
        points[COUNT:] = np.nan  # padding must not matter
        label = np.arange(ROWS) < COUNT * 3 // 4
        normals = rng.normal(size=(ROWS, 3)).astype(np.float32)
        count = np.int32(COUNT)
        source = Cloud(points, count)
        return Pair(source, Cloud(target, count), motion, label, label, normals, normals)

    keys = jax.random.split(jax.random.key(1), 3)
    return jax.tree.map(lambda *leaves: np.stack(leaves), *map(pair, keys))


def by_procrustes(source, target, *, source_normals=None, target_normals=None) -> Rigid:
    """An oracle that knows the clouds are copies row by row; refuses padding."""
    assert source.shape == target.shape == (COUNT, 3)
    assert source_normals is None or source_normals.shape == target_normals.shape == (COUNT, 3)
    return rigid.procrustes(jnp.asarray(source), jnp.asarray(target), jnp.ones(COUNT))[0]


def summary(error: float, non_finite=0) -> Summary:
    figures = dict.fromkeys(Summary._fields, error)
    return Summary(**figures | {"pairs": 3, "non_finite": non_finite})


def make_evaluation(*rows: Row) -> Evaluation:
    return Evaluation(
        rows=rows,
        constant_overlap=OverlapSummary(0.76, 0.76, 1.0, 0.8636),
        pair_set="cad-test-noise",
        pairs=3,
        pairs_hash="a1b2c3",
        seed=7,
        command="python evaluate.py --config=configs/cad.py",
        device="cpu",
    )


ROWS_OF_ALL_KINDS = (
    Row("ICP", note='install it with `pip install "dbdnet_jax[baselines]"`'),
    Row("identity", summary(0.125), 0.0125),
    Row("network", summary(0.25, 2), 0.5, overlap=OverlapSummary(0.9, 0.8, 0.7, 0.95)),
    Row("untrained", summary(0.5), 0.5, overlap=OverlapSummary(0.76, 0.76, 1.0, 0.8636)),
)


@pytest.mark.parametrize("adapter", [from_points, from_normals])
def test_a_perfect_method_scores_zero_and_padding_is_cut_off(adapter, pairs):
    row = evaluate_method(Method("oracle", adapter(by_procrustes)), pairs)
    assert_close(row.summary.error_translation, np.zeros(()), FLOAT32)
    assert (row.summary.pairs, row.summary.recall_5deg_0p1) == (3, 1.0)
    assert row.overlap is None and row.seconds_per_pair > 0


def test_identity_scores_the_size_of_the_motion(pairs):
    found = evaluate_method(Method("identity", from_points(classical.identity)), pairs).summary
    expected = np.linalg.norm(pairs.target_from_source.translation, axis=1)
    assert_close(found.error_translation, expected.mean(), FLOAT32)
    assert_close(found.median_translation, np.median(expected), FLOAT32)


def test_scans_have_their_registration_recall_by_either_definition(pairs):
    corresponding = [
        (s[:COUNT], t[:COUNT]) for s, t in zip(pairs[0].points, pairs[1].points, strict=True)
    ]
    scans = Scans(["a", "b", "b"], np.array([False, False, True]), corresponding)
    oracle, identity = (
        evaluate_method(Method("", from_points(method)), pairs, scans).recall
        for method in (by_procrustes, classical.identity)
    )
    assert oracle == ScanRecall(1.0, 1.0, 1.0, 1.0, 1.0)
    assert identity == ScanRecall(0.0, 0.0, 0.0, 0.0, 0.0)


def oracle_network(params, source, target, weights=None) -> Registration:
    """Stands for `register_clouds`: the true motion of copies, ``params.overlap`` at every row."""
    mask = jnp.arange(ROWS) < source.count
    weights = mask.astype(jnp.float32) if weights is None else weights
    points = jnp.where(mask[:, None], source.points, 0)
    motion, _ = rigid.procrustes(points, target.points, weights)
    zeros = jnp.zeros(ROWS)
    branch = Branch(jnp.zeros((ROWS, ROWS)), jnp.zeros((ROWS, 3)), zeros)
    overlap = jnp.full(ROWS, params.overlap)
    return Registration(
        *motion, overlap, overlap, mask, mask, branch, branch, zeros, jnp.asarray(True)
    )


def test_the_network_is_scored_on_motion_and_overlap(pairs, monkeypatch):
    monkeypatch.setattr(dbdnet, "register_clouds", oracle_network)
    row = evaluate_method(Method("network", from_network(STAND_IN)), pairs)
    assert_close(row.summary.error_translation, np.zeros(()), FLOAT32)
    assert_close(row.overlap, constant_overlap(pairs), FLOAT32)


def test_the_registration_network_can_be_given_the_true_overlap(pairs, monkeypatch):
    def given_overlap(params, source, target, source_overlap, target_overlap, solves):
        return oracle_network(params, source, target, source_overlap * target_overlap)

    monkeypatch.setattr(dbdnet, "register_given_overlap", given_overlap)
    row = evaluate_method(Method("told", from_true_overlap(STAND_IN)), pairs)
    assert_close(row.summary.error_translation, np.zeros(()), FLOAT32)
    assert row.overlap is None


def test_compilation_is_not_in_the_time(pairs, monkeypatch):
    calls = []
    clock = iter(range(100))
    monkeypatch.setattr("time.perf_counter", lambda: float(next(clock)))

    def method(pair: Pair) -> Answer:
        calls.append(next(clock) if not calls else None)  # the first call takes long
        return Answer(classical.identity(pair.source.points, pair.target.points))

    assert evaluate_method(Method("slow start", method), pairs).seconds_per_pair == 1.0
    assert len(calls) == 4


def test_constant_overlap_is_the_share_of_overlapping_points(pairs):
    assert_close(constant_overlap(pairs), np.array([0.75, 0.75, 1.0, 2 * 0.75 / 1.75]), FLOAT32)


def test_a_missing_library_gives_a_row_that_says_what_to_install(pairs, monkeypatch):
    monkeypatch.setitem(sys.modules, "open3d", None)
    row = evaluate_method(Method("ICP", from_points(classical.icp)), pairs)
    assert row.summary is None and row.seconds_per_pair is None
    assert 'pip install "dbdnet_jax[baselines]"' in reports.render(make_evaluation(row))


def test_the_table_holds_figures_definitions_and_where_they_come_from():
    text = reports.render(make_evaluation(*ROWS_OF_ALL_KINDS))
    for piece in (
        "RMSE R", "Euler", "deg", "MAE t", "Error R", "median", "< 5 deg", "& < 0.1", "< 15 deg",
        "& < 0.3", "s/pair", "geodesic", "T_true^-1 T", "compilation excluded",
        "F1", "TP /", "all points overlapping (constant)", "0.8636",
        "3 pairs of cad-test-noise, sha256 a1b2c3; seed 7; cpu",
        "python evaluate.py --config=configs/cad.py",
        "network: 2 of 3 answers were not finite.",
        "ICP: install it with",
        "untrained: accuracy and F1 are not both above",
    ):  # fmt: skip
        assert piece in text
    assert "network: accuracy" not in text
    motion, overlap = text.split("overlap prediction")
    assert "identity" in motion and "identity" not in overlap
    lines = motion.splitlines()
    heads, row = lines[0], next(line for line in lines if line.startswith("identity"))
    assert len(heads) == len(row) and row.split()[1:] == [
        "0.125", "0.1250", "0.125", "0.1250", "0.125", "0.1250", "0.125", "0.1250",
        "12.5", "%", "12.5", "%", "0.013",
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("accuracy", "f1", "skill"), [(0.9, 0.8636, False), (0.76, 0.95, False), (0.761, 0.8637, True)]
)
def test_skill_is_to_be_above_the_constant_in_accuracy_and_in_f1(accuracy, f1, skill):
    row = Row("network", summary(0.25), 0.5, overlap=OverlapSummary(accuracy, 0.8, 0.9, f1))
    assert ("no skill" not in reports.render(make_evaluation(row))) == skill


@pytest.mark.parametrize("scanned", [True, False])
def test_scans_have_no_refined_row_and_no_normals(pairs, monkeypatch, scanned):
    still = from_points(classical.identity)
    methods = [
        Method("still", still),
        Method("network, refined", still, Traits(learned=True, refined=True)),
        Method("with normals", still, Traits(needs_normals=True)),
    ]
    monkeypatch.setattr(evaluation, "make_methods", lambda *_: methods)
    corresponding = [
        (s[:COUNT], t[:COUNT]) for s, t in zip(pairs[0].points, pairs[1].points, strict=True)
    ]
    scans = Scans(["a", "b", "b"], np.array([False, False, True]), corresponding)
    if scanned:
        pairs = pairs._replace(source_normals=np.zeros_like(pairs.source_normals))
    test = PairSet("set", pairs, "a1", scans if scanned else None)
    found = evaluation.evaluate([], test, seed=0, command="", count=2)
    assert found.pairs == 2 and found.pair_set == "set_first_2"
    assert [row.method for row in found.rows] == (
        ["still"] if scanned else [method.name for method in methods]
    )


def test_registration_recall_has_a_table_of_its_own():
    rows = (
        ROWS_OF_ALL_KINDS[0],
        Row("scanned", summary(0.125), 0.5, "", ScanRecall(0.5, 0.25, 1.0, 0.125, None)),
    )
    _, recall = reports.render(make_evaluation(*rows)).split("registration recall")
    for piece in ("R < 15 deg", "t < 0.3 m", "RMSE", "< 0.2 m", "pair mean", "scene mean", "apart"):
        assert piece in recall
    cells = {line.split()[0]: line.split()[1:] for line in recall.splitlines() if line}
    assert cells["scanned"] == ["50.0", "%", "25.0", "%", "100.0", "%", "12.5", "%", "-"]
    assert cells["ICP"] == ["-"] * 5
    assert "registration recall" not in reports.render(make_evaluation(*ROWS_OF_ALL_KINDS))


def test_symmetric_shapes_have_a_table_of_their_own(pairs):
    row = evaluate_method(Method("identity", from_points(classical.identity)), pairs)
    evaluation = make_evaluation(row)._replace(symmetric=np.array([True, False, True]))
    text = reports.render(evaluation)
    plain, symmetric = row.errors.rotation_deg[1], row.errors.rotation_deg[[0, 2]].mean()
    (line,) = [line for line in text.splitlines() if line.startswith("identity  ")][1:]
    cells = [float(cell) for cell in line.split()[1:]]
    assert cells[0] == cells[1] == pytest.approx(plain, abs=1e-3)
    assert cells[4] == pytest.approx(symmetric, abs=1e-3)
    assert cells[3] == pytest.approx(row.point_distance[1], abs=1e-4)
    assert "Pairs: 1 plain, 2 symmetric." in text and "forgives such a turn" in text
    everything = evaluation._replace(symmetric=np.ones(3, bool))
    assert "Pairs: 3 symmetric." in reports.render(everything)


def test_without_overlap_predictions_there_is_one_table():
    assert "overlap prediction" not in reports.render(make_evaluation(ROWS_OF_ALL_KINDS[1]))


def test_json_and_csv_hold_the_same_figures(tmp_path):
    evaluated = make_evaluation(*ROWS_OF_ALL_KINDS)
    folder = tmp_path / "new folder"
    reports.save(evaluated, folder)
    stem = folder / "evaluation_cad-test-noise"
    content = json.loads(stem.with_suffix(".json").read_text())
    assert (content["pairs_hash"], content["seed"], content["pairs"]) == ("a1b2c3", 7, 3)
    names = [row["method"] for row in content["rows"]]
    assert names == ["ICP", "identity", "network", "untrained", reports.CONSTANT_NAME]
    assert content["rows"][0]["error_rotation_deg"] is None
    assert content["rows"][2]["overlap_f1"] == 0.95
    assert content["rows"][4]["overlap_accuracy"] == 0.76
    with stem.with_suffix(".csv").open(newline="") as stream:
        lines = list(csv.DictReader(stream))
    for line, row in zip(lines, content["rows"], strict=True):
        assert line["pairs_hash"] == "a1b2c3" and line["command"] == evaluated.command
        assert {name: line[name] for name in row} == {
            name: "" if value is None else str(value) for name, value in row.items()
        }
    assert sorted(folder.iterdir()) == [stem.with_suffix(".csv"), stem.with_suffix(".json")]


def test_a_write_that_fails_leaves_the_file_before_it(tmp_path, monkeypatch):
    path = tmp_path / "table.json"
    reports.write_json(path, make_evaluation(ROWS_OF_ALL_KINDS[1]))
    before = path.read_text()

    def fail(*_):
        raise OSError("disk full")

    monkeypatch.setattr(os, "replace", fail)
    with pytest.raises(OSError, match="disk full"):
        reports.write_json(path, make_evaluation(*ROWS_OF_ALL_KINDS))
    assert path.read_text() == before and list(tmp_path.iterdir()) == [path]
