"""`dbdnet-register`: what it prints and writes, its exit status, and that it writes whole files."""

import importlib
import json
import os
import subprocess
import sys
import warnings
from pathlib import Path

import numpy as np
import pytest

from dbdnet_jax.cli.statuses import ALIGNED, FAILED, UNREAD, UNSURE, UNUSABLE
from dbdnet_jax.io.point_files import read_points
from dbdnet_jax.io.transform_files import read_transform
from tests.aligning import pair, rotation_error_deg, tiny_align
from tests.cli.conftest import HTML, PNG, needs_report

ALIGN = importlib.import_module("dbdnet_jax.alignment.align")  # not the function
EXAMPLES = Path(__file__).parents[2] / "examples"


def likely(monkeypatch, probability: float) -> None:
    """Let the success probability be what a test needs; the tiny network is untrained."""
    monkeypatch.setattr("dbdnet_jax.alignment.search.success_probability", lambda *_: probability)


def test_the_summary_goes_to_stdout_and_progress_to_stderr(run, monkeypatch):
    likely(monkeypatch, 0.9)
    status, out, err = run("a.ply", "b.ply")
    assert status == ALIGNED
    assert err == "a.ply -> b.ply ...\n"
    rows = np.array([line.split() for line in out.splitlines()[1:5]], float)
    assert rotation_error_deg(rows, pair()[2]) < 2
    assert out.splitlines()[-1] == "aligned"
    assert "probability  0.900" in out


def test_an_unlikely_pose_is_status_1_with_its_reason(run, monkeypatch):
    likely(monkeypatch, 0.2)
    status, out, _ = run("a.ply", "b.ply")
    assert status == UNSURE
    assert out.splitlines()[-1].startswith("not aligned with confidence: the pose is right with")


@pytest.mark.parametrize("ending", ["txt", "json", "npy"])
def test_the_transform_is_written_to_the_last_digit(run, folder, tmp_path, ending):
    run("a.ply", "b.ply", "-o", tmp_path / f"t.{ending}")
    clouds = [read_points(folder / name) for name in ("a.ply", "b.ply")]
    expected = tiny_align(*clouds, initial=read_transform(folder / "guess.txt"))
    np.testing.assert_array_equal(read_transform(tmp_path / f"t.{ending}"), expected.transform)
    assert [path.name for path in tmp_path.iterdir()] == [f"t.{ending}"]


def test_json_on_stdout_is_one_object_with_the_numbers(run):
    _, out, _ = run("a.ply", "b.ply", "--json")
    held = json.loads(out)
    assert out.count("\n") == 1
    assert held["source"] == "a.ply" and isinstance(held["valid"], bool)
    assert np.shape(held["transform"]) == (4, 4) and np.shape(held["information"]) == (6, 6)


def test_the_moved_source_is_saved(run, tmp_path):
    run("a.ply", "b.ply", "--save-aligned", tmp_path / "m.ply", "-o", tmp_path / "t.npy")
    transform = np.load(tmp_path / "t.npy")
    moved = read_points("a.ply") @ transform[:3, :3].T + transform[:3, 3]
    np.testing.assert_allclose(read_points(tmp_path / "m.ply"), moved, atol=1e-12)


def test_no_refinement_is_asked_for(run, monkeypatch):
    def settle(*_, refined, **__):
        assert refined is False
        pytest.fail("judged")

    monkeypatch.setattr("dbdnet_jax.alignment.search.settle", settle)
    examined = []
    monkeypatch.setattr(
        "dbdnet_jax.alignment.search.examine", lambda *_: examined.append(1) or pytest.fail()
    )
    with pytest.raises(pytest.fail.Exception, match="judged"):
        run("a.ply", "b.ply", "--no-refine")
    assert not examined


def test_a_traceback_is_shown_to_who_asks_for_it(run, monkeypatch):
    monkeypatch.setattr(ALIGN, "align", lambda *_, **__: {}["x"])
    monkeypatch.setenv("DBDNET_DEBUG", "1")
    status, _, err = run("a.ply", "b.ply")
    assert status == FAILED and "Traceback" in err and "KeyError: 'x'" in err


def test_a_name_does_not_steer_the_terminal(run, folder):
    name = "a\x1b[2J\u202e.ply"
    (folder / name).write_bytes((folder / "a.ply").read_bytes())
    for options in ([], ["--json"]):
        _, out, err = run(name, "b.ply", *options)
        assert not {"\x1b", "\u202e"} & set(out + err) and r"a\x1b[2J\u202e.ply" in err


@pytest.mark.filterwarnings("always")
def test_a_warning_is_a_line(run, monkeypatch):
    def warn():
        warnings.warn("odd\x1b", stacklevel=1)

    monkeypatch.setattr("dbdnet_jax.io.programs.keep_compiled_programs", warn)
    assert run("a.ply", "b.ply")[2] == "warning: odd\\x1b\na.ply -> b.ply ...\n"


def test_a_reader_that_is_gone_ends_it_quietly(run, reader_gone):
    status, _, err = run("a.ply", "b.ply")
    assert status == UNREAD and err == "a.ply -> b.ply ...\n"


@pytest.mark.parametrize(("where", "moment"), [(ALIGN, "align"), (os, "fsync")])
def test_an_interrupt_leaves_no_file(run, tmp_path, monkeypatch, where, moment):
    def interrupt(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr(where, moment, interrupt)
    status, _, err = run("a.ply", "b.ply", "-o", tmp_path / "t.txt")
    assert status == 130 and "no file was left half-written" in err
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("flag", "name"), [("-o", "t.txt"), pytest.param("--report", "r.html", marks=needs_report)]
)
def test_a_full_disk_leaves_no_file(run, tmp_path, monkeypatch, flag, name):
    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("os.fsync", full)
    status, _, err = run("a.ply", "b.ply", flag, tmp_path / name)
    assert status == UNUSABLE and "No space left" in err
    assert not list(tmp_path.iterdir())


def test_help_has_examples_and_the_exit_status_and_imports_nothing_heavy():
    code = (
        "import sys\nfrom dbdnet_jax import cli\n"
        "try: cli.main(['--help'])\n"
        "finally: print(sorted({'jax', 'numpy', 'trimesh'} & set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60)
    assert "examples:\n  dbdnet-register scan_a.ply scan_b.ply" in done.stdout
    assert "exit status: 0 aligned, 1 not aligned" in done.stdout
    assert done.stdout.splitlines()[-1] == "[]"


def test_python_m_is_the_same_command(tmp_path):
    done = subprocess.run(
        [sys.executable, "-m", "dbdnet_jax", "a.ply"], capture_output=True, text=True, timeout=60
    )
    assert done.returncode == UNUSABLE
    assert "give two clouds" in done.stderr and "Traceback" not in done.stderr


def test_the_examples_are_scans_of_one_shape():
    source, target = (read_points(EXAMPLES / f"scan_{x}.ply") for x in "ab")
    true = read_transform(EXAMPLES / "b_from_a.txt")
    assert len(source) == len(target) == 717
    found = tiny_align(source, target, initial=true)
    assert rotation_error_deg(found.transform, true) < 3
    assert found.inlier_ratio > 0.5


@needs_report
def test_a_page_and_a_picture_are_written(run, tmp_path):
    run("a.ply", "b.ply", "--report", tmp_path / "r.html", "--png", tmp_path / "r.png")
    page = (tmp_path / "r.html").read_bytes()
    assert page.startswith(HTML) and b"dbdnet-register a.ply b.ply --report" in page
    assert (tmp_path / "r.png").read_bytes().startswith(PNG)
    assert len(list(tmp_path.iterdir())) == 2


@needs_report
@pytest.mark.parametrize(
    ("flag", "output", "message"),
    [
        ("--report", "page.pdf", "must be one of .html; got page.pdf"),
        ("--png", "picture.jpg", "must be one of .png; got picture.jpg"),
        ("--report", "missing/page.html", "the folder of an output must exist"),
        ("--report", "a.ply/page.html", "the folder of an output must be a folder; a.ply is a"),
    ],
)
def test_an_output_that_cannot_be_is_refused_before_any_work(
    run, monkeypatch, flag, output, message
):
    monkeypatch.setattr(ALIGN, "align", lambda *_, **__: pytest.fail("worked"))
    status, _, err = run("a.ply", "b.ply", flag, output)
    assert status == UNUSABLE and message in err


@pytest.mark.parametrize("flag", ["--report=r.html", "--png=r.png"])
def test_a_missing_extra_is_said_before_any_work(run, monkeypatch, flag):
    monkeypatch.setitem(sys.modules, "plotly", None)
    monkeypatch.setattr(ALIGN, "align", lambda *_, **__: pytest.fail("worked"))
    status, _, err = run("a.ply", "b.ply", flag)
    assert status == UNUSABLE and 'pip install "dbdnet_jax[report]"' in err
