"""Batches that come from outside, as scans do: each process brings its own rows of them."""

import dataclasses
import itertools
import socket
import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from dbdnet_jax.training.checkpoint import Checkpoints
from dbdnet_jax.training.parallel import training_mesh
from dbdnet_jax.training.step import init_state, train_step
from tests import stand_in
from tests.conftest import FLOAT32, assert_close

ROOT = Path(__file__).parents[2]
TOGETHER = """
import sys
from pathlib import Path
import jax
jax.config.update("jax_num_cpu_devices", 2)
from dbdnet_jax.training.parallel import join_processes
join_processes("127.0.0.1:" + sys.argv[1], 2, int(sys.argv[2]))
from tests.training.test_batched import train
train(Path(sys.argv[3]), 4)
"""


def train(folder, devices, batched=True, *, log_every=1, bad_step=None):
    """The stand-in's run; where it is batched, of the same pairs, drawn before each step.

    The batch of ``bad_step`` is NaN.
    """
    source = stream = stand_in.source()
    held = jnp.asarray(next(source.arrays(0)))

    @jax.jit
    def drawn(step):
        def one(i):
            key = jax.random.fold_in(jax.random.fold_in(jax.random.key(5), step), i)
            return source.draw(jax.random.split(key)[0], step * stand_in.BATCH + i, held)

        return jax.vmap(one)(jnp.arange(stand_in.BATCH))

    def arrays(start):
        own = stand_in.BATCH // jax.process_count()
        rows = slice(jax.process_index() * own, (jax.process_index() + 1) * own)
        for step in itertools.count(start):
            batch = jax.tree.map(lambda leaf: np.array(leaf)[rows], drawn(step))
            if step == bad_step:
                batch.target.points[:] = np.nan
            yield batch

    if batched:
        stream = source._replace(arrays=arrays, draw=lambda key, number, pair: pair, batched=True)
    config = dataclasses.replace(
        stand_in.TRAIN, devices=devices, log_every=log_every, checkpoint_every=4
    )
    stand_in.train(folder, stream, config)


def curve(folder):
    return np.genfromtxt(folder / "train.csv", delimiter=",", skip_header=1)


@pytest.fixture(scope="module")
def expected(tmp_path_factory):
    """The curve of pairs that the step draws itself."""
    folder = tmp_path_factory.mktemp("drawn")
    train(folder, 1, batched=False)
    assert len(curve(folder)) == 12
    return curve(folder)


@pytest.mark.parametrize(("devices", "backend"), [(1, "cpu"), (2, "cpu"), (2, "gpu")])
def test_devices_take_their_rows_of_a_batch(tmp_path, monkeypatch, expected, devices, backend):
    monkeypatch.setattr(jax, "default_backend", lambda: backend)
    train(tmp_path, devices)
    assert_close(curve(tmp_path), expected, FLOAT32)


@pytest.mark.parametrize("bad_step", [0, 5])
def test_a_bad_batch_is_named_and_nothing_is_taken_after_it(tmp_path, expected, bad_step):
    with pytest.raises(FloatingPointError, match=f"is nan in the step after step {bad_step} of"):
        train(tmp_path, 1, log_every=4, bad_step=bad_step)
    with Checkpoints(tmp_path) as checkpoints:
        assert (checkpoints.latest_step() or 0) == bad_step
    train(tmp_path, 1, log_every=4)  # the data mended, the run goes on as if nothing had been
    losses = expected[:, 3].reshape(3, 4).mean(axis=1)
    assert_close(curve(tmp_path)[:, 3], losses, FLOAT32)


@pytest.mark.slow
def test_processes_bring_their_own_rows(tmp_path, expected):
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        port = str(listener.getsockname()[1])
    command = [sys.executable, "-c", TOGETHER, port]
    children = [
        subprocess.Popen([*command, str(i), str(tmp_path)], cwd=ROOT, stdout=subprocess.DEVNULL)
        for i in (0, 1)
    ]
    assert [child.wait(timeout=300) for child in children] == [0, 0]
    assert_close(curve(tmp_path), expected, FLOAT32)


def test_a_loss_of_the_whole_batch_gets_its_rows():
    pairs = stand_in.source().validation  # three
    optimizer, mesh = optax.sgd(1.0), training_mesh(3)

    def loss(trainable, frozen, stacked, key, batch_stats):
        value = jnp.sum(jnp.mean(stacked.target.points, axis=1) * trainable["weight"])
        return value, (stand_in.Terms(value, value), batch_stats)

    weight = jnp.arange(9.0).reshape(3, 3)
    state = init_state({"weight": weight}, optimizer, batch_stats={"mean": jnp.zeros(3)})
    options = {"draw": lambda key, number, pair: pair, "loss": loss, "optimizer": optimizer}
    _, metrics = train_step(
        state, None, jax.random.key(0), pairs, batch_size=3, mesh=mesh, batched=True, **options
    )
    centres = np.mean(pairs.target.points, axis=1)
    assert_close(metrics.loss, np.sum(centres * np.asarray(weight)), FLOAT32)
