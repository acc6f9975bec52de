"""How many devices share a batch changes its mean and a whole run by rounding only."""

import os
import re
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks.interruptions import STAND_IN, rows
from dbdnet_jax.training.parallel import mean_over_pairs, training_mesh
from tests.conftest import EXACT, FLOAT32, assert_close

ROOT = Path(__file__).parents[2]
# A training on the number of XLA devices given, from wherever its folder is.
RUN = """
import dataclasses, sys
from pathlib import Path
import jax
jax.config.update("jax_num_cpu_devices", 8)
from tests import stand_in
train = dataclasses.replace(stand_in.TRAIN, schedule="constant")
stand_in.BATCH = 8
for folder, epochs, changes in eval(sys.argv[2]):
    stand_in.EPOCHS = epochs
    if sys.argv[1] != "cpu":
        jax.default_backend = lambda: sys.argv[1]
    stand_in.train(Path(folder), config=dataclasses.replace(train, **changes))
"""


@pytest.mark.parametrize("backend", ["cpu", "gpu"])
@pytest.mark.parametrize(
    ("count", "devices", "rounds"), [(1, 1, 1), (3, 2, 1), (8, 2, 2), (9, 2, 3)]
)
def test_mean_over_pairs_is_the_mean_on_any_hardware(monkeypatch, backend, count, devices, rounds):
    monkeypatch.setattr(jax, "default_backend", lambda: backend)
    offset, mesh = jnp.asarray([0.5, -1.0]), training_mesh(devices, devices)

    def function(i, offset):
        return {"a": jnp.sin(i.astype(float)) + offset, "b": jnp.where(i < count, 1.0, jnp.nan)}

    @jax.jit
    def mean(offset):
        return mean_over_pairs(mesh, function, count, offset, rounds=rounds)

    found = mean(offset)
    expected = np.mean([np.sin(i) + np.asarray(offset) for i in range(count)], axis=0)
    assert_close(found["a"], expected, FLOAT32)
    assert_close(found["b"], 1.0, EXACT)


def test_a_round_holds_its_part_of_the_pairs_at_once(monkeypatch):
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    mesh = training_mesh(2, 2)

    def width(rounds):
        def mean(weights):
            return mean_over_pairs(
                mesh, lambda i, w: w * i.astype(float), 24, weights, rounds=rounds
            )

        text = str(jax.make_jaxpr(mean)(jnp.ones((5, 7))))
        return max(n for n in range(1, 25) if f"f32[{n},5,7]" in text)

    assert [width(rounds) for rounds in (1, 3, 12)] == [12, 4, 1]


def test_the_mesh_is_what_is_asked_for_or_an_error_that_says_what_fits(monkeypatch):
    assert training_mesh(8).size == training_mesh(8, 2).size == 2
    assert training_mesh(3).size == training_mesh(3, 1).size == 1  # a CPU's devices cost nothing
    with pytest.raises(ValueError, match=r"by the 2 devices .* of 3\. .*of 2 or 4 .*=1"):
        training_mesh(3, 2)
    with pytest.raises(ValueError, match=r"at most the 2 devices .* got 3\. Use 0"):
        training_mesh(3, 3)
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    with pytest.raises(ValueError, match=r"a batch_size of 1\. Use a batch_size of 2 \(any"):
        training_mesh(1)  # seven of eight GPUs would idle


def trained(backend: str, runs: list[tuple[Path, float, dict]]) -> None:
    """Runs of the stand-in: folder, epochs, changes of its configuration."""
    runs = [(str(folder), epochs, changes) for folder, epochs, changes in runs]
    subprocess.run(
        [sys.executable, "-c", RUN, backend, repr(runs)],
        cwd=ROOT,
        env={**os.environ, "JAX_PLATFORMS": "cpu"},
        check=True,
        timeout=600,
    )


def curve(folder: Path, name: str = "train") -> np.ndarray:
    rows = np.genfromtxt(folder / f"{name}.csv", delimiter=",", skip_header=1)
    assert len(rows)
    return rows


@pytest.mark.parametrize("backend", ["cpu", "gpu"])
def test_devices_parts_and_recomputation_change_rounding_only(tmp_path, backend):
    """One run is moved from 8 devices to 2 and to 1, each of which goes on from the checkpoints."""
    runs = [(tmp_path / "1", 12.0, {"devices": 1})]
    moves = ((8, 4.0), (2, 8.0), (1, 12.0))
    runs += [(tmp_path / "moved", epochs, {"devices": devices}) for devices, epochs in moves]
    runs += [(tmp_path / "parts", 12.0, {"devices": 2, "accumulate": 4, "remat": True})]
    trained(backend, runs)
    for name in ("train", "validation"):
        expected = curve(tmp_path / "1", name)
        for other in ("moved", "parts"):
            assert_close(curve(tmp_path / other, name), expected, FLOAT32)


def free_port() -> int:
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        return listener.getsockname()[1]


@pytest.mark.slow
def test_two_processes_train_as_one_stop_together_and_one_goes_on(tmp_path):
    command = [*STAND_IN, "--config.overlap.batch_size=4", "--config.overlap.epochs=0.25"]
    whole, shared = (f"--run_dir={tmp_path / name}" for name in ("whole", "shared"))
    subprocess.run([*command, whole], cwd=ROOT, check=True, capture_output=True, timeout=300)
    together = [*command, shared, f"--coordinator=127.0.0.1:{free_port()}"]
    together += ["--config.train.devices=2"]
    children = [
        subprocess.Popen(
            [*together, "--processes=2", f"--process_id={i}"], cwd=ROOT, stdout=subprocess.PIPE
        )
        for i in range(2)
    ]
    deadline = time.monotonic() + 300
    while rows(tmp_path / "shared") < 5:
        assert all(child.poll() is None for child in children) and time.monotonic() < deadline
        time.sleep(0.01)
    children[1].send_signal(signal.SIGTERM)  # not the one that writes
    said = [child.communicate(timeout=120)[0].decode() for child in children]
    assert [child.returncode for child in children] == [0, 0]
    (step,) = {re.search("SIGTERM; the state after step ([0-9]+) of 40 ", text)[1] for text in said}
    assert 5 <= int(step) < 40 and len(curve(tmp_path / "shared" / "overlap")) == int(step)
    subprocess.run([*command, shared], cwd=ROOT, check=True, capture_output=True, timeout=300)
    for name in ("train", "validation"):
        found, expected = (curve(tmp_path / run / "overlap", name) for run in ("shared", "whole"))
        assert_close(found, expected, FLOAT32)
