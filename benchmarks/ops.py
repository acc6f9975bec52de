"""Time of single operations at a configuration's sizes, forward and with their derivatives.

    python -m benchmarks.ops --config=configs/modelnet.py
    python -m benchmarks.ops --config=configs/cad.py

On random points in a cube: as many as the protocol's for the farthest order and `refine`, as the
overlap network sees for its layers, as the registration matches for Sinkhorn and Procrustes. Prints
JSON: for each operation seconds to trace and to compile, median and range of the wall seconds, and
where its arithmetic is counted (`benchmarks.arithmetic`) what part it achieves of the rate at which
this machine multiplies matrices. "+ derivative" is value and gradient together.
"""

from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from absl import app, flags
from ml_collections import config_flags

from benchmarks import arithmetic
from benchmarks.machine import against, compile_timed, matrix_rate, measure, publish, record
from dbdnet_jax.classical.refine import refine
from dbdnet_jax.networks.dbdnet.config import ModelConfig
from dbdnet_jax.networks.dbdnet.encoder import GROUPS
from dbdnet_jax.networks.edgeconv import EdgeConv
from dbdnet_jax.networks.initial import init_params
from dbdnet_jax.ops import rigid
from dbdnet_jax.ops.attention import attention
from dbdnet_jax.ops.grouping import interpolate, interpolation_weights, knn
from dbdnet_jax.ops.pyramid import LEVELS
from dbdnet_jax.ops.sampling import farthest_order
from dbdnet_jax.ops.sinkhorn import sinkhorn
from dbdnet_jax.training.config import parse_flags, read_config
from dbdnet_jax.types import Cloud

CONFIG = config_flags.DEFINE_config_file("config", None, "Configuration file, configs/NAME.py.")
RUNS = flags.DEFINE_integer("runs", 20, "Timed runs of each operation.", lower_bound=1)
OUT = flags.DEFINE_string("out", None, "File for the record, beside printing it.")


class Operation(NamedTuple):
    """A function of arrays, and its multiply-adds where they are counted."""

    function: Callable
    arguments: tuple
    multiply_adds: int = 0


def operations(config: ModelConfig, size: int) -> dict[str, Operation]:
    """Every operation by name, at the sizes that clouds of ``size`` points have in the network."""
    seen, matched = config.overlap_points or size, config.registration_points or size
    seen, matched, width = min(seen, size), min(matched, size), 4 * config.overlap_channels
    cloud, other = _uniform(0, size, 3), _uniform(1, size, 3)
    near = 2 * jnp.tanh(_uniform(2, matched, matched))
    found = {
        "farthest order": Operation(
            lambda x: farthest_order(x, jnp.asarray(size), config.overlap_points), (cloud,)
        ),
        "neighbours in coordinates": _neighbours(cloud[:seen], config.neighbours),
        "neighbours in features": _neighbours(
            _uniform(3, seen, config.overlap_channels), config.neighbours
        ),
    }
    found |= _edge_convs(config, cloud[:seen])
    valid = jnp.ones(seen, bool)
    found |= {
        "attention": Operation(
            lambda q, k, v: attention(q, k, v, valid, config.heads),
            tuple(_uniform(i, seen, width) for i in (4, 5, 6)),
            2 * seen**2 * width,
        ),
        "interpolation": Operation(
            _interpolation(cloud[:seen]), (_uniform(7, seen // 2, 2 * config.overlap_channels),)
        ),
        "Sinkhorn": Operation(
            lambda x: sinkhorn(x, *[jnp.ones(matched, bool)] * 2, config.sinkhorn_iterations),
            (near,),
        ),
        "Procrustes": Operation(
            lambda x, y, w: jnp.concatenate([leaf.reshape(-1) for leaf in _motion(x, y, w)]),
            (cloud[:matched], other[:matched], jnp.ones(matched)),
        ),
        "refine": Operation(
            lambda x, y: refine(*_whole(x, y), rigid.identity()).target_from_source.rotation,
            (cloud, cloud + 0.01),
        ),
    }
    return found


def _uniform(seed: int, *shape: int) -> jax.Array:
    return jnp.asarray(np.random.default_rng(seed).uniform(-1, 1, shape), jnp.float32)


def _whole(*clouds: jax.Array) -> Iterator[Cloud]:
    return (Cloud(points, jnp.asarray(len(points))) for points in clouds)


def _motion(source: jax.Array, target: jax.Array, weights: jax.Array) -> tuple:
    return tuple(rigid.procrustes(source, target, weights)[0])


def _neighbours(x: jax.Array, k: int) -> Operation:
    n, width = x.shape
    return Operation(lambda x: knn(x, x, k, jnp.asarray(n)), (x,), n * n * width)


def _interpolation(points: jax.Array) -> Callable:
    half = len(points) // 2
    nearest = interpolation_weights(points, points[:half], jnp.asarray(half))
    return lambda x: interpolate(x, *nearest)


def _edge_convs(config: ModelConfig, points: jax.Array) -> Iterator[tuple[str, Operation]]:
    """The last stage's, of every level."""
    layers = init_params(jax.random.key(0), config).overlap["encoder"]
    for level in range(LEVELS):
        rows, width = len(points) >> level, config.overlap_channels << level
        index = knn(points[:rows], points[:rows], config.neighbours, jnp.asarray(rows))
        layer = EdgeConv(width, GROUPS[level])
        variables = {"params": layers[f"stage4_conv{level + 1}"]}

        def apply(x, variables=variables, layer=layer, index=index):
            return layer.apply(variables, x, index, jnp.ones(len(x), bool))

        count = arithmetic.edge_conv(width, width, rows, config.neighbours)
        yield f"EdgeConv, level {level + 1}", Operation(apply, (_uniform(8, rows, width),), count)


def with_derivative(operation: Operation) -> Operation:
    """Value and gradient of the sum over the operation's result; three times its arithmetic."""

    def total(*arguments):
        return jnp.sum(operation.function(*arguments))

    numbers = tuple(range(len(operation.arguments)))
    return Operation(
        jax.value_and_grad(total, numbers), operation.arguments, 3 * operation.multiply_adds
    )


def timed(operation: Operation, rate: float, runs: int) -> dict[str, Any]:
    """Seconds to make and to run an operation, and the part of the machine's rate."""
    program, figures = compile_timed(operation.function, *operation.arguments)
    figures |= measure(lambda: program(*operation.arguments), runs)
    if operation.multiply_adds:
        figures |= against(rate, operation.multiply_adds, figures["median_s"])
    return figures


DIFFERENTIATED = ("EdgeConv", "attention", "interpolation", "Sinkhorn", "Procrustes")


def main(argv: list[str]) -> None:
    """Print one JSON object."""
    config = read_config(CONFIG.value)
    rate = matrix_rate()
    figures: dict[str, Any] = {}
    for name, operation in operations(config.model, config.protocol.size).items():
        figures[name] = timed(operation, rate, RUNS.value)
        if name.startswith(DIFFERENTIATED):
            figures[f"{name} + derivative"] = timed(with_derivative(operation), rate, RUNS.value)
    found = {
        "matrix_gflop_per_s": round(rate / 1e9, 1),
        "points": config.protocol.size,
        "operations": figures,
    }
    publish(record("benchmarks.ops", found), OUT.value)


if __name__ == "__main__":
    flags.mark_flag_as_required("config")
    app.run(main, flags_parser=parse_flags)
