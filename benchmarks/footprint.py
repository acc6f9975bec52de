"""The memory that programs ask for, by configuration, points and batch; nothing is run.

    python -m benchmarks.footprint --config=configs/cad.py --points=1024,2048 --batches=1,32

Compiles `register` of a batch of pairs, and loss and gradient of the overlap network for a batch,
as one program each, all pairs at once as on a GPU, and prints what the compiler says they need
beside their arguments and results. It is the compiler of this machine's devices: those of a GPU are
arranged by another one, and near to it. ``points`` are those before the protocol's crop.
"""

import dataclasses
import json
from typing import Any

import jax
import jax.numpy as jnp
from absl import app, flags
from ml_collections import config_flags

from benchmarks.machine import publish, record
from dbdnet_jax.data.pairs import Protocol, make_pair
from dbdnet_jax.networks.dbdnet.register import register
from dbdnet_jax.networks.initial import init_params
from dbdnet_jax.training.config import parse_flags, read_config
from dbdnet_jax.training.table import STAGES
from dbdnet_jax.training.task import RunConfig
from dbdnet_jax.types import Pair

CONFIG = config_flags.DEFINE_config_file("config", None, "Configuration file, configs/NAME.py.")
POINTS = flags.DEFINE_list("points", ["1024", "2048"], "Points of a cloud before the crop.")
BATCHES = flags.DEFINE_list("batches", ["1", "32"], "Pairs of a program.")
OUT = flags.DEFINE_string("out", None, "File for the record, beside printing it.")
SHAPE_POINTS = 2048


def pairs_like(protocol: Protocol, batch: int) -> Pair:
    """The shapes of a batch of pairs."""
    shape = jax.ShapeDtypeStruct((SHAPE_POINTS, 3), jnp.float32)
    pair = jax.eval_shape(
        lambda points, normals: make_pair(jax.random.key(0), points, normals, protocol),
        shape,
        shape,
    )
    return jax.tree.map(lambda x: jax.ShapeDtypeStruct((batch, *x.shape), x.dtype), pair)


def temporary_mib(function: Any, *arguments: Any) -> float:
    """What the compiled function needs beside arguments and results."""
    found = jax.jit(function).lower(*arguments).compile().memory_analysis()
    return round(found.temp_size_in_bytes / 2**20, 1)


def footprint(config: RunConfig, points: int, batch: int) -> dict[str, Any]:
    """Both programs."""
    protocol = dataclasses.replace(config.protocol, points=points)
    pairs, params = pairs_like(protocol, batch), init_params(jax.random.key(0), config.model)
    loss = STAGES[config.method]["overlap"].make_task(config, "").loss

    def gradient(trainable: Any, pairs: Pair, key: Any) -> Any:
        def mean(trainable: Any) -> Any:
            losses, _ = jax.vmap(lambda pair: loss(trainable, None, pair, key))(pairs)
            return jnp.mean(losses)

        return jax.value_and_grad(mean)(trainable)

    answers = jax.vmap(register, in_axes=(None, 0, 0))
    clouds = pairs.source.points, pairs.target.points
    return {
        "points": protocol.size,
        "pairs": batch,
        "register_mib": temporary_mib(answers, params, *clouds),
        "overlap_step_mib": temporary_mib(gradient, params.overlap, pairs, jax.random.key(0)),
    }


def main(argv: list[str]) -> None:
    """Print one JSON object, and each line of it as it is found."""
    config = read_config(CONFIG.value)
    found = []
    for points in POINTS.value:
        for batch in BATCHES.value:
            found.append(footprint(config, int(points), int(batch)))
            print(json.dumps(found[-1]), flush=True)
    publish(record("benchmarks.footprint", {"programs": found}), OUT.value)


if __name__ == "__main__":
    flags.mark_flag_as_required("config")
    app.run(main, flags_parser=parse_flags)
