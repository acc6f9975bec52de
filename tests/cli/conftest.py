"""The command in a folder with two clouds and the weights of a tiny network."""

import sys
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest

from dbdnet_jax import save_params
from dbdnet_jax.alignment.writing import write_ply
from dbdnet_jax.cli import main
from tests.aligning import POINTS, pair, tiny_params

needs_report = pytest.mark.skipif(
    not (find_spec("plotly") and find_spec("matplotlib")),
    reason="the report extra is not installed",
)
PNG, HTML = b"\x89PNG\r\n", b"<!DOCTYPE html>"


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """Weights, a guess, and two clouds that it fits."""
    folder = tmp_path_factory.mktemp("cli")
    source, target, transform = pair()
    write_ply(folder / "a.ply", source)
    write_ply(folder / "b.ply", target)
    np.savetxt(folder / "guess.txt", transform)
    save_params(folder / "tiny.npz", tiny_params())
    return folder


@pytest.fixture
def run(folder, capsys, monkeypatch):
    """Run the command in the folder; returns status, stdout and stderr."""
    monkeypatch.chdir(folder)

    def run(*arguments, batch=False):
        fixed = ["--params", "tiny.npz", "--max-points", str(POINTS)]
        fixed += [] if batch else ["--initial", "guess.txt"]
        status = main([*map(str, arguments), *fixed])
        return status, *capsys.readouterr()

    return run


@pytest.fixture
def reader_gone(monkeypatch):
    """Nobody reads standard output any more."""

    def gone(*words, file, show=print):
        if file is sys.stdout:
            raise BrokenPipeError(32, "Broken pipe")
        show(*words, file=file)

    monkeypatch.setattr("builtins.print", gone)
    monkeypatch.setattr("dbdnet_jax.io.terminal._mute_stdout", lambda: None)  # it is the tests' own
