"""Devices and processes that share the pairs of a table: each pair once, and the same figures."""

import json
import socket
import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dbdnet_jax.data.pairs import Protocol
from dbdnet_jax.data.training_pairs import pairs_of_shapes
from dbdnet_jax.errors import MissingExtraError
from dbdnet_jax.evaluation import run
from dbdnet_jax.evaluation.methods import Method, Network
from dbdnet_jax.networks.dbdnet.config import ModelConfig
from dbdnet_jax.networks.params import Params
from dbdnet_jax.training.parallel import AXIS, from_all_processes, local_mesh, map_over_pairs
from dbdnet_jax.types import Answer, Rigid
from tests import stand_in
from tests.conftest import EXACT, assert_close

ROOT = Path(__file__).parents[2]
PARAMS = Params({"overlap": jnp.float32(0.3)}, ModelConfig())
# What each of two processes has to say of seven pairs.
TOGETHER = """
import json, sys
import jax
jax.config.update("jax_num_cpu_devices", 2)
from dbdnet_jax.training.parallel import join_processes, local_mesh
join_processes("127.0.0.1:" + sys.argv[1], 2, int(sys.argv[2]))
from tests.evaluation import test_sharing
test_sharing.run.TIMED = 2
print(json.dumps(test_sharing.figures(local_mesh(), missing=jax.process_index() == 1)))
"""


def stacked(count):
    """Pairs that differ."""
    shapes = stand_in.shapes(count)
    protocol = Protocol(points=24, keep=0.5)
    found = pairs_of_shapes(shapes, shapes, protocol, seed=0, validation_pairs=count).validation
    return jax.tree.map(np.asarray, found)


@jax.jit
def centre(pair, params):
    """Moves by a part of the way between the centres."""
    way = jnp.mean(pair.target.points, axis=0) - jnp.mean(pair.source.points, axis=0)
    return Answer(Rigid(jnp.eye(3), params.networks["overlap"] * way), *(jnp.full(12, 0.7),) * 2)


def figures(mesh, missing=False):
    """Of a network, of a method on the host, and of one whose library may be missing."""
    calls = []

    def on_host(pair):
        calls.append(1)
        return centre(pair, PARAMS)

    def lacking(pair):
        if missing:
            raise MissingExtraError("not here")
        return centre(pair, PARAMS)

    methods = [Method("n", Network(centre, PARAMS)), Method("h", on_host), Method("l", lacking)]
    rows = run.evaluate_methods(methods, stacked(7), mesh=mesh)
    return {
        "errors": [None if r.errors is None else r.errors.translation.tolist() for r in rows],
        "overlap": [r.overlap for r in rows],
        "calls": len(calls),
        "notes": [r.note for r in rows],
    }


@pytest.mark.parametrize("count", [1, 2, 3, 7])
def test_a_row_is_the_same_on_any_number_of_devices(monkeypatch, count):
    monkeypatch.setattr(run, "TIMED", 2)
    pairs, method = stacked(count), Method("", Network(centre, PARAMS))
    alone, shared = (run.evaluate_method(method, pairs, mesh=local_mesh(n)) for n in (1, 2))
    assert shared.errors.translation.shape == (count,)
    assert len(set(shared.errors.translation.tolist())) == count
    jax.tree.map(
        lambda a, b: assert_close(a, b, EXACT),
        (alone.errors, alone.motions, alone.overlap, alone.point_distance),
        (shared.errors, shared.motions, shared.overlap, shared.point_distance),
    )


@pytest.mark.parametrize("backend", ["cpu", "gpu"])
def test_devices_share_any_number_of_pairs(monkeypatch, backend):
    monkeypatch.setattr(jax, "default_backend", lambda: backend)

    def square(x, offset):
        return x * x + offset, jax.lax.axis_index(AXIS)

    found, device = map_over_pairs(local_mesh(2), square, np.arange(7.0), jnp.float32(1.0))
    assert_close(found, np.arange(7.0) ** 2 + 1, EXACT)
    assert device.tolist() == [0, 0, 0, 0, 1, 1, 1]


def test_more_devices_than_there_are_is_refused():
    with pytest.raises(ValueError, match=r"at most the 2 devices .* got 3\. Use 0"):
        local_mesh(3)


def test_rows_of_processes_come_back_in_their_order(monkeypatch):
    """Three processes' parts of seven rows, of which two are fillings."""
    monkeypatch.setattr(jax, "process_count", lambda: 3)
    gathered = np.array([[0, 3, 6], [1, 4, 6], [2, 5, 6]])
    monkeypatch.setattr(
        "jax.experimental.multihost_utils.process_allgather",
        lambda tree: jax.tree.map(lambda _: gathered, tree),
    )
    assert from_all_processes(np.zeros(3), 7).tolist() == list(range(7))


@pytest.mark.slow
def test_two_processes_make_one_table():
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        port = str(listener.getsockname()[1])
    children = [
        subprocess.Popen(
            [sys.executable, "-c", TOGETHER, port, str(i)],
            cwd=ROOT,
            stdout=subprocess.PIPE,
            text=True,
        )
        for i in (0, 1)
    ]
    found = [json.loads(child.communicate(timeout=300)[0].splitlines()[-1]) for child in children]
    expected = json.loads(json.dumps(figures(local_mesh(1))))
    assert [one["calls"] for one in found] == [5, 5] and expected["calls"] == 8  # one to warm up
    for one in found:
        np.testing.assert_allclose(one["errors"][:2], expected["errors"][:2], rtol=1e-6)
        np.testing.assert_allclose(one["overlap"][:2], expected["overlap"][:2], rtol=1e-6)
        assert one["errors"][2] is None
    assert found[0]["notes"][2] == "process 1 lacks what it needs."
    assert found[1]["notes"][2] == "not here"
