"""`dbdnet-register --batch`: every pair once, whatever becomes of the others."""

import importlib
import json
import os
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import jax
import numpy as np
import pytest

from dbdnet_jax import save_params
from dbdnet_jax.cli import main
from dbdnet_jax.cli.statuses import ALIGNED, FAILED, UNREAD, UNSURE, UNUSABLE
from dbdnet_jax.io.workers import run_through
from dbdnet_jax.networks.initial import init_params
from tests.aligning import tiny_params
from tests.cli.conftest import HTML, PNG, needs_report
from tests.cli.stand_ins import prepare_nothing, stand_in
from tests.dask_cluster import cluster
from tests.networks.dbdnet.small import SMALL

ALIGN = importlib.import_module("dbdnet_jax.alignment.align")  # not the function


@pytest.fixture
def in_this_process(monkeypatch):
    """Let a batch work where tests can reach it."""

    def work_here(work, items, jobs, prepare):
        with ThreadPoolExecutor(1) as executor:
            yield from run_through(executor, work, items, 1)

    monkeypatch.setattr("dbdnet_jax.cli.batch.run_in_processes", work_here)


def test_a_list_of_pairs_writes_a_transform_each_and_goes_on_after_a_bad_one(
    run, tmp_path, monkeypatch
):
    monkeypatch.setenv("JAX_NUM_CPU_DEVICES", "2")  # as here, so that programs are shared
    (tmp_path / "pairs.txt").write_text(
        f"# source target\n{Path.cwd()}/a.ply {Path.cwd()}/b.ply\n\nmissing.ply 'b b.ply'\n"
    )
    status, out, err = run("--batch", tmp_path / "pairs.txt", "-o", tmp_path, "--json", batch=True)
    assert status == UNUSABLE
    assert f"error: {tmp_path}/pairs.txt:4: a point file must exist" in err
    records = {record["pair"]: record for record in map(json.loads, out.splitlines())}
    assert np.shape(records.pop("0002_a_b")["transform"]) == (4, 4)
    ((_, failed),) = records.items()
    assert failed["failure"] == "input" and failed["source"] == f"{tmp_path}/missing.ply"
    assert {path.name for path in tmp_path.iterdir()} == {"pairs.txt", "0002_a_b.txt"}


def test_a_folder_of_pairs_goes_by_names(run, folder, tmp_path, in_this_process):
    for name in ("one", "two"):
        os.link(folder / "a.ply", tmp_path / f"{name}_source.ply")
        os.link(folder / "b.ply", tmp_path / f"{name}_target.ply")
    (tmp_path / "out").mkdir()
    status, out, _ = run("--batch", tmp_path, "-o", tmp_path / "out", batch=True)
    assert status in (ALIGNED, UNSURE)
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == ["one.txt", "two.txt"]


@pytest.mark.parametrize(
    ("error", "message"),
    [
        (MemoryError("Unable to allocate 9 GiB"), "out of memory: Unable to allocate 9 GiB"),
        (RuntimeError("RESOURCE_EXHAUSTED: no room\nmore"), "out of memory: RESOURCE_EXHAUSTED"),
        (TypeError("a bug\x1b[2J"), r"unexpected TypeError: a bug\x1b[2J. DBDNET_DEBUG=1 shows"),
        (RecursionError("too deep"), "unexpected RecursionError: too deep"),
    ],
)
def test_an_unexpected_error_costs_its_pair_alone(
    run, tmp_path, monkeypatch, in_this_process, error, message
):
    align, calls = ALIGN.align, []

    def fail_once(*args, **options):
        calls.append(1)
        if len(calls) == 1:
            raise error
        return align(*args, **options)

    monkeypatch.setattr(ALIGN, "align", fail_once)
    (tmp_path / "pairs.txt").write_text(f"{Path.cwd()}/a.ply {Path.cwd()}/b.ply\n" * 2)
    status, out, err = run("--batch", tmp_path / "pairs.txt", "-o", tmp_path, batch=True)
    assert status == FAILED and message in err and "Traceback" not in err
    assert out.count("T =") == 1 and (tmp_path / "0002_a_b.txt").exists()


@needs_report
def test_a_batch_writes_its_pages_and_pictures_into_folders(run, folder, tmp_path, in_this_process):
    (tmp_path / "pairs.txt").write_text(f"{folder}/a.ply {folder}/b.ply\n")
    run("--batch", tmp_path / "pairs.txt", "--report", tmp_path, "--png", tmp_path, batch=True)
    assert (tmp_path / "0001_a_b.html").read_bytes().startswith(HTML)
    assert (tmp_path / "0001_a_b.png").read_bytes().startswith(PNG)


@pytest.fixture
def batch(tmp_path, monkeypatch, capsys):
    """Run a list of pairs with the stand-in; returns status, stdout and stderr."""
    monkeypatch.setattr("dbdnet_jax.cli.batch.align_files", stand_in)
    monkeypatch.setattr("dbdnet_jax.cli.batch.prepare", prepare_nothing)
    monkeypatch.chdir(tmp_path)
    Path("out").mkdir()

    def batch(sources: str, *options: str):
        Path("pairs.txt").write_text("".join(f"{source} t\n" for source in sources.split()))
        status = main(["--batch", "pairs.txt", "-o", "out", *options])
        return status, *capsys.readouterr()

    return batch


def test_a_pair_that_kills_its_process_costs_that_pair_alone(batch):
    status, out, err = batch("a1 a2 k3 b4 u5 a6", "--json", "--jobs", "2")
    assert status == FAILED
    records = {record["source"]: record for record in map(json.loads, out.splitlines())}
    assert out.count("\n") == len(records) == 6
    assert {x: r["failure"] for x, r in records.items() if "failure" in r} == {
        "k3": "crash",
        "b4": "input",
    }
    assert "error: pairs.txt:3: the process that worked on it died" in err
    assert "error: pairs.txt:4: a bad cloud" in err
    assert len(set(os.listdir("out"))) == 4
    assert len({record.get("process") for record in records.values()} - {None}) >= 2
    assert err.count("6/6 ") == 1


def test_a_batch_goes_on_from_its_results(batch):
    more = "--results", "answers.jsonl", "--json", "--jobs", "1"
    status, _, _ = batch("a1 u2 b3", *more)
    assert status == UNUSABLE
    held = Path("answers.jsonl").read_text()
    Path("answers.jsonl").write_text(held + '{"pair": "0004_a')  # as a full disk leaves it
    Path("out/0001_a1_t.txt").unlink()
    status, out, err = batch("a1 u2 a3", *more)
    # What is not there any more, and what was another pair, is made; what was unsure still counts.
    assert status == UNSURE and "1 of 3 pairs are done already" in err
    assert [json.loads(line)["source"] for line in out.splitlines()] == ["a1", "a3"]
    status, out, err = batch("a1 u2 a3", *more)
    assert status == UNSURE and not out and "3 of 3 pairs are done already" in err
    lines = Path("answers.jsonl").read_text().splitlines()
    assert [json.loads(line)["source"] for line in lines] == ["a1", "u2", "b3", "a1", "a3"]


def test_results_of_weights_that_changed_in_place_are_refused(batch):
    more = "--results", "answers.jsonl", "--params", "own.npz"
    save_params("own.npz", tiny_params())
    assert batch("a1", *more)[0] == ALIGNED
    save_params("own.npz", init_params(jax.random.key(1), SMALL))  # trained on
    status, _, err = batch("a1", *more)
    assert status == UNUSABLE and "answers.jsonl have params_sha256" in err


def test_results_of_other_options_and_other_files_are_refused(batch):
    batch("a1", "--results", "answers.jsonl")
    status, _, err = batch("a1", "--results", "answers.jsonl", "--search", "any")
    assert status == UNUSABLE and "answers.jsonl have search 'auto', not 'any'" in err
    for text in ("no json\n", "no json", "[1, 2]\n", '{"x": 1}\n'):
        Path("mine.jsonl").write_text(text)
        status, _, err = batch("a1", "--results", "mine.jsonl")
        assert status == UNUSABLE and "mine.jsonl:1 is b" in err and "another file" in err
        assert Path("mine.jsonl").read_text() == text


def test_a_bar_with_rate_and_remaining_time_is_for_terminals(batch, monkeypatch):
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True)
    _, _, err = batch("a1 a2 a3", "--jobs", "1")
    assert "3/3" in err and "pair/s" in err and "a1 -> t" not in err


def test_a_batch_whose_output_nobody_reads_ends_quietly(batch, reader_gone):
    assert batch("a1 a2", "--jobs", "1")[0] == UNREAD


def test_a_dask_cluster_aligns_and_the_files_are_written_here(batch, tmp_path, monkeypatch):
    pytest.importorskip("distributed", reason="the dask extra is not installed")
    monkeypatch.setattr("dbdnet_jax.cli.batch._align_elsewhere", stand_in)
    (tmp_path / "dask").mkdir()
    with cluster(tmp_path / "dask") as (address, workers):
        status, out, _ = batch("a1 b2 a3 a4", "--json", "--executor", f"dask://{address}")
    assert status == UNUSABLE
    records = {record["source"]: record for record in map(json.loads, out.splitlines())}
    assert out.count("\n") == len(records) == 4 and records["b2"]["failure"] == "input"
    assert {records[x]["process"] for x in ("a1", "a3", "a4")} <= {x.pid for x in workers}
    assert len(os.listdir("out")) == 3


def test_no_scheduler_is_an_error_in_words(batch, monkeypatch):
    monkeypatch.setattr("dbdnet_jax.io.dask_executor.CONNECT_S", 1)
    pytest.importorskip("distributed", reason="the dask extra is not installed")
    status, _, err = batch("a1", "--executor", "dask://127.0.0.1:1")
    assert status == UNUSABLE and "dask://127.0.0.1:1 must be a Dask scheduler" in err
