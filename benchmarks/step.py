"""Time and memory of one answer, and of one training step of either network, for a configuration.

    python -m benchmarks.step --config=configs/modelnet.py
    python -m benchmarks.step --config=configs/cad.py
    python -m benchmarks.step --config=configs/modelnet.py --released=modelnet40_noise.pth

Pairs are drawn from the embedded CAD shapes under the configuration's protocol, whatever data set
it names, so that nothing needs to be downloaded. Prints JSON: seconds to trace and to compile, the
median and range of the wall seconds, the arithmetic (`benchmarks.arithmetic`; a training step
counts as three forward passes of what it trains) and what part it achieves of the rate at which
this machine multiplies matrices, pairs per second, and the process's peak memory so far in GiB.
With a released checkpoint: seconds to convert it, and the time of an answer with its weights.
"""

import functools
import time

import jax
import numpy as np
from absl import app, flags
from ml_collections import config_flags

from benchmarks import arithmetic
from benchmarks.machine import (
    against,
    compile_timed,
    matrix_rate,
    measure,
    peak_gib,
    publish,
    record,
)
from dbdnet_jax.data.cad import cad_split
from dbdnet_jax.data.training_pairs import PairStream, pairs_of_shapes
from dbdnet_jax.io.workers import available_cores
from dbdnet_jax.networks.dbdnet.register import register
from dbdnet_jax.networks.dbdnet.released import from_released
from dbdnet_jax.networks.initial import init_params
from dbdnet_jax.networks.params import Params
from dbdnet_jax.training.config import parse_flags, read_config
from dbdnet_jax.training.optimizer import make_optimizer
from dbdnet_jax.training.parallel import on_all_devices, training_mesh
from dbdnet_jax.training.step import init_state, train_step
from dbdnet_jax.training.table import STAGES
from dbdnet_jax.training.task import RunConfig
from dbdnet_jax.types import Pair

CONFIG = config_flags.DEFINE_config_file("config", None, "Configuration file, configs/NAME.py.")
STEPS = flags.DEFINE_integer("steps", 5, "Timed steps of each stage.", lower_bound=1)
RELEASED = flags.DEFINE_string("released", None, "The authors' checkpoint, for answers only.")
OUT = flags.DEFINE_string("out", None, "File for the record, beside printing it.")


def answer(config: RunConfig, params: Params, pair: Pair, rate: float) -> dict[str, float]:
    """`register` of one pair."""
    arguments = params, pair.source.points, pair.target.points
    program, figures = compile_timed(register, *arguments)
    figures |= measure(lambda: program(*arguments), STEPS.value)
    count = sum(arithmetic.register(config.model, config.protocol.size).values())
    return figures | against(rate, count, figures["median_s"]) | {"peak_gib": peak_gib()}


def training_step(
    config: RunConfig, stream: PairStream, stage: str, rate: float, steps: int
) -> dict[str, float]:
    """One stage's step on fresh parameters; registration learns from the true overlap."""
    task = STAGES[config.method][stage].make_task(config, "")
    part, train = config.stages[stage], config.train
    optimizer = make_optimizer(
        lambda _: part.learning_rate, weight_decay=train.weight_decay, clip_norm=train.clip_norm
    )
    mesh = training_mesh(part.batch_size, train.devices)
    step = functools.partial(
        train_step,
        draw=stream.draw,
        loss=task.loss,
        optimizer=optimizer,
        batch_size=part.batch_size,
        mesh=mesh,
        ema_decay=train.ema_decay,
        accumulate=train.accumulate,
        remat=train.remat,
        precision=train.precision,
    )
    state = on_all_devices(mesh, init_state(task.trainable, optimizer, ema_decay=train.ema_decay))
    # All four, so that the program may be called with what it was compiled for.
    rest = on_all_devices(mesh, (task.frozen, jax.random.key(0), next(stream.arrays(0))))
    program, figures = compile_timed(step, state, *rest)
    figures |= measure(lambda: program(state, *rest)[1].loss, steps)
    seconds = figures["median_s"]
    # Each pass and each iteration is trained for itself.
    forward = sum(getattr(arithmetic, stage)(config.model, config.protocol.size).values())
    figures |= against(rate, 3 * part.batch_size * forward, seconds)
    return figures | {
        "pairs_per_s": round(part.batch_size / seconds, 2),
        "peak_gib": peak_gib(),
    }


def main(argv: list[str]) -> None:
    """Print one JSON object."""
    overrides = CONFIG.value
    # The benchmark reads no stage's results, so both stages can run on fresh parameters.
    overrides.registration.masks = "truth"
    config = read_config(overrides)
    jax.config.update("jax_num_cpu_devices", config.train.devices or len(available_cores()))
    shapes = cad_split("val")
    stream = pairs_of_shapes(shapes, shapes, config.protocol, seed=0, validation_pairs=1)
    pair = jax.tree.map(lambda leaf: np.asarray(leaf)[0], stream.validation)
    start = time.perf_counter()
    if RELEASED.value:
        params = from_released(RELEASED.value, k=config.model.neighbours)
    else:
        params = init_params(jax.random.key(0), config.model)
    weights_s = round(time.perf_counter() - start, 3)
    rate = matrix_rate()
    figures = {
        "matrix_gflop_per_s": round(rate / 1e9, 1),
        "points": config.protocol.size,
        "weights_s": weights_s,
        "register_one_pair": answer(config, params, pair, rate),
    }
    for stage in () if RELEASED.value else ("overlap", "registration"):
        figures[f"{stage}_step"] = training_step(config, stream, stage, rate, STEPS.value)
    publish(record("benchmarks.step", figures), OUT.value)


if __name__ == "__main__":
    flags.mark_flag_as_required("config")
    app.run(main, flags_parser=parse_flags)
