"""How many devices share a batch changes its mean and a whole run by rounding only."""

import os
import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

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
train = dataclasses.replace(stand_in.TRAIN, **eval(sys.argv[3]))
stand_in.BATCH = 8
for folder, devices, epochs in eval(sys.argv[2]):
    stand_in.EPOCHS = epochs
    if sys.argv[1] != "cpu":
        jax.default_backend = lambda: sys.argv[1]
    stand_in.train(Path(folder), config=dataclasses.replace(train, devices=devices))
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
    with pytest.raises(ValueError, match="got 3 of 2. Use 0"):
        training_mesh(3, 3)
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    with pytest.raises(ValueError, match=r"a batch_size of 1\. Use a batch_size of 2 \(any"):
        training_mesh(1)  # seven of eight GPUs would idle


def trained(backend: str, runs: list[tuple[Path, int, float]], **changes) -> None:
    """Runs of the stand-in: folder, number of devices, epochs."""
    runs = [(str(folder), devices, epochs) for folder, devices, epochs in runs]
    subprocess.run(
        [sys.executable, "-c", RUN, backend, repr(runs), repr(changes)],
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
def test_one_two_and_eight_devices_give_the_same_curves_and_share_checkpoints(tmp_path, backend):
    whole = [(tmp_path / str(devices), devices, 12.0) for devices in (1, 2, 8)]
    moved = [
        (tmp_path / "moved", devices, epochs) for devices, epochs in ((8, 4.0), (2, 8.0), (1, 12.0))
    ]
    trained(backend, [*whole, *moved], schedule="constant")
    for name in ("train", "validation"):
        expected = curve(tmp_path / "1", name)
        for other in ("2", "8", "moved"):
            assert_close(curve(tmp_path / other, name), expected, FLOAT32)
