"""The count of the network's arithmetic, and what a benchmark's record says."""

import dataclasses
import json
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.extend.core import jaxprs_in_params

from benchmarks import arithmetic, machine
from benchmarks.scaling import by_devices
from dbdnet_jax.networks.dbdnet.config import ModelConfig
from dbdnet_jax.networks.dbdnet.register import register
from dbdnet_jax.networks.initial import init_params
from tests.ladder import small_step
from tests.networks.dbdnet.small import SMALL

N = 64
LIMITED = dataclasses.replace(
    SMALL,
    overlap_matching=True,
    overlap_passes=2,
    overlap_points=32,
    registration_points=40,
    neighbour_space="coordinates",
)


def products(jaxpr) -> int:
    """Multiply-adds of all matrix products in a traced program, loops counted in full."""
    total = 0
    for equation in jaxpr.eqns:
        if equation.primitive.name == "dot_general":
            (contracted, _), _ = equation.params["dimension_numbers"]
            left, (out,) = equation.invars[0].aval, equation.outvars
            total += math.prod(out.aval.shape) * math.prod(left.shape[i] for i in contracted)
        times = equation.params.get("length", 1) if equation.primitive.name == "scan" else 1
        total += times * sum(map(products, jaxprs_in_params(equation.params)))
    return total


def test_the_product_walker_counts_loops():
    def thrice(x):
        return jax.lax.scan(lambda y, _: (jax.checkpoint(jnp.matmul)(y, y), None), x, length=3)

    assert products(jax.make_jaxpr(thrice)(jnp.ones((4, 4))).jaxpr) == 3 * 4**3


@pytest.mark.parametrize(
    "config",
    [SMALL, LIMITED, small_step("joint_overlap"), small_step("dgcnn")],
    ids=["plain", "limits", "joint", "dgcnn"],
)
def test_the_arithmetic_is_a_little_less_than_what_the_network_multiplies(config):
    params = init_params(jax.random.key(0), config)
    cloud = jnp.zeros((N, 3))
    traced = products(jax.make_jaxpr(register)(params, cloud, cloud).jaxpr)
    counted = sum(arithmetic.register(config, N).values())
    assert 0.8 < counted / traced < 1.0


def test_the_full_size_count_is_that_by_hand():
    # One cloud's first-stage layer, and one attention block of two clouds at 717 points.
    assert arithmetic.edge_conv(3, 64, 717, 20) == 717 * (2 * 3 * 64 + 20 * 64 * 64)
    block = 4 * (4 * 717 * 256 * 256 + 2 * 717 * 717 * 256)
    assert arithmetic.overlap(ModelConfig(), 717)["attention"] == 4 * block


def test_times_are_medians_and_ranges_after_a_run_that_does_not_count():
    runs = []
    found = machine.measure(lambda: runs.append(1), 4)
    assert len(runs) == 5
    assert 0 <= found["min_s"] <= found["median_s"] <= found["max_s"]


def test_a_part_of_the_rate_counts_two_operations_for_each_multiply_add():
    assert machine.against(1e9, 10**8, 0.5) == {"gflop": 0.2, "part_of_rate": 0.4}


def test_a_record_says_what_it_was_measured_on_and_goes_to_a_file(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("sys.argv", ["ops.py", "--config=configs/cad.py"])
    found = machine.record("benchmarks.ops", {"points": 7})
    assert found["command"] == "python -m benchmarks.ops --config=configs/cad.py"
    assert found["versions"]["jax"] == jax.__version__
    assert found["cores"] >= 1 and found["cpu"] and found["points"] == 7
    machine.publish(found, str(tmp_path / "record.json"))
    assert json.loads((tmp_path / "record.json").read_text()) == found
    assert json.loads(capsys.readouterr().out) == found
    assert np.isfinite(machine.peak_gib())


def test_a_training_on_more_devices_than_cores_is_not_measured():
    with pytest.raises(SystemExit, match=r"at most the \d+ cores there are; got 100000"):
        by_devices(4, [1, 100_000])
