"""Results in Parquet: all that the lines say, nothing lost to a kill, nobody's file replaced."""

import json
import sys
from pathlib import Path

import pytest

from dbdnet_jax.cli import main, results
from dbdnet_jax.cli.parquet import read_lines, write_lines
from dbdnet_jax.cli.statuses import UNSURE, UNUSABLE
from tests.cli.stand_ins import prepare_nothing, stand_in

parquet = pytest.importorskip("pyarrow.parquet", reason="the parquet extra is not installed")
MORE = "--results", "answers.parquet", "--json", "--jobs", "1"


@pytest.fixture
def batch(tmp_path, monkeypatch, capsys):
    """Run a list of pairs with the stand-in; returns status, records and stderr."""
    monkeypatch.setattr("dbdnet_jax.cli.batch.align_files", stand_in)
    monkeypatch.setattr("dbdnet_jax.cli.batch.prepare", prepare_nothing)
    monkeypatch.chdir(tmp_path)

    def batch(sources: str, *options: str):
        Path("pairs.txt").write_text("".join(f"{source} t\n" for source in sources.split()))
        status = main(["--batch", "pairs.txt", *options])
        out, err = capsys.readouterr()
        return status, [json.loads(line) for line in out.splitlines()], err

    return batch


def test_a_batch_goes_on_from_its_parquet_file(batch):
    status, _, _ = batch("a1 u2 b3", *MORE)
    assert status == UNUSABLE
    assert not Path("answers.parquet.jsonl").exists()
    table = parquet.read_table("answers.parquet").to_pylist()
    assert [row["source"] for row in table] == ["a1", "u2", "b3"]
    assert [row["valid"] for row in table] == [True, False, None]
    assert [row["failure"] for row in table] == [None, None, "input"]
    status, records, err = batch("a1 u2 a3", *MORE)
    assert status == UNSURE and "2 of 3 pairs are done already" in err
    assert [record["source"] for record in records] == ["a3"]
    assert batch("a1 u2 a3", *MORE)[:2] == (UNSURE, [])
    assert len(parquet.read_table("answers.parquet")) == 4


def test_answers_of_other_options_are_refused_and_nothing_is_left_beside_them(batch):
    batch("a1", *MORE)
    before = Path("answers.parquet").read_bytes()
    status, _, err = batch("a1", *MORE, "--seed", "3")
    assert status == UNUSABLE and "answers.parquet have seed 0, not 3" in err
    assert not Path("answers.parquet.jsonl").exists()
    assert Path("answers.parquet").read_bytes() == before


def test_what_a_kill_leaves_is_gone_on_from(batch):
    batch("a1 a2", *MORE)
    (first, second) = read_lines(Path("answers.parquet"))
    # Killed in the next run after a3; and before the lines that are in the file were deleted.
    third = second.replace(b"0002_a2_t", b"0003_a3_t").replace(b'"a2"', b'"a3"')
    Path("answers.parquet.jsonl").write_bytes(second + third + b'{"pair": "0004_a')
    status, records, err = batch("a1 a2 a3 a4", *MORE)
    assert "3 of 4 pairs are done already" in err and records[0]["source"] == "a4"
    lines = read_lines(Path("answers.parquet"))
    assert lines[:3] == [first, second, third] and len(lines) == 4


def test_an_interrupted_batch_has_its_table(batch, monkeypatch):
    append = results.append

    def interrupt(held, record):
        append(held, record)
        raise KeyboardInterrupt

    monkeypatch.setattr("dbdnet_jax.cli.batch.append", interrupt)
    batch("a1 a2", *MORE)
    assert len(parquet.read_table("answers.parquet")) == 1
    assert not Path("answers.parquet.jsonl").exists()


def test_damaged_files_and_those_of_others_are_refused_and_left_alone(batch):
    batch("a1", *MORE)
    whole = Path("answers.parquet").read_bytes()
    write_lines(Path("other.parquet"), [b'{"x": 1}\n'])
    table = parquet.read_table("answers.parquet", columns=["source"])
    parquet.write_table(table, "mine.parquet")
    theirs = [Path("mine.parquet").read_bytes(), Path("other.parquet").read_bytes()]
    for content in (b"", b"text", whole[:-20], whole[:100] + whole[-100:], *theirs):
        Path("answers.parquet").write_bytes(content)
        status, _, err = batch("a1 a2", *MORE)
        assert status == UNUSABLE and "answers.parquet" in err and "Name another file" in err
        assert "Traceback" not in err and Path("answers.parquet").read_bytes() == content
    Path("answers.parquet").unlink()
    Path("answers.parquet.jsonl").write_text("my own\n")
    status, _, err = batch("a1", *MORE)
    assert status == UNUSABLE and "answers.parquet.jsonl:1 is b'my own" in err
    assert Path("answers.parquet.jsonl").read_text() == "my own\n"


def test_values_of_several_types_are_json(tmp_path):
    path = tmp_path / "x.parquet"
    lines = [b'{"a": 1, "b": [[1.5, 2.0]], "c": []}\n', b'{"a": "x", "b": null, "d": {"e": 1}}\n']
    write_lines(path, lines)
    first, second = parquet.read_table(path).to_pylist()
    assert (first["a"], second["a"]) == ("1", '"x"') and first["b"] == [[1.5, 2.0]]
    assert second["d"] == {"e": 1} and read_lines(path) == lines


def test_without_pyarrow_the_extra_is_named_before_any_work(batch, monkeypatch):
    monkeypatch.setitem(sys.modules, "pyarrow.parquet", None)
    status, records, err = batch("a1", *MORE)
    assert status == UNUSABLE and not records
    assert 'pip install "dbdnet_jax[parquet]"' in err and not Path("answers.parquet").exists()
