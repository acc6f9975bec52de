"""Time and memory of one training step of each stage, and of one answer, for a configuration.

    python -m benchmarks.step --config=configs/modelnet.py
    python -m benchmarks.step --config=configs/cad.py
    python -m benchmarks.step --config=configs/modelnet.py --released=modelnet40_noise.pth

Pairs are drawn from the embedded CAD shapes under the configuration's protocol, whatever data set
it names, so that nothing needs to be downloaded. Prints JSON: seconds to compile, the median and
range of the steps' wall seconds, pairs per second, and the process's peak memory so far in GiB.
With a released checkpoint: seconds to convert it, and the time of an answer with its weights.
"""

import functools
import json
import os
import resource
import statistics
import sys
import time
from collections.abc import Callable
from typing import Any

import jax
import numpy as np
from absl import app, flags
from ml_collections import config_flags

from dbdnet_jax.data.cad import cad_split
from dbdnet_jax.model.dbdnet import register
from dbdnet_jax.model.params import init_params
from dbdnet_jax.parallel import on_all_devices
from dbdnet_jax.released import from_released
from dbdnet_jax.settings import Settings, parse_flags, read_settings
from dbdnet_jax.sources import Source, shape_source
from dbdnet_jax.stages import make_task
from dbdnet_jax.training import init_state, make_optimizer, train_step

CONFIG = config_flags.DEFINE_config_file("config", None, "Configuration file, configs/NAME.py.")
STEPS = flags.DEFINE_integer("steps", 5, "Timed steps of each stage.", lower_bound=1)
RELEASED = flags.DEFINE_string("released", None, "The authors' checkpoint, for answers only.")


def measure(run: Callable[[], Any], count: int) -> dict[str, float]:
    """Wall seconds of the first call, and median, minimum and maximum of the ``count`` after it."""
    seconds = []
    for _ in range(count + 1):
        start = time.perf_counter()
        jax.block_until_ready(run())
        seconds.append(time.perf_counter() - start)
    first, *rest = seconds
    return {
        "first_s": round(first, 3),
        "median_s": round(statistics.median(rest), 4),
        "min_s": round(min(rest), 4),
        "max_s": round(max(rest), 4),
        "peak_gib": round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20, 2),
    }


def training_step(settings: Settings, source: Source, stage: str, steps: int) -> dict[str, float]:
    """One stage's step on fresh parameters; registration learns from the true overlap."""
    task = make_task(settings, stage, "")
    part, train = getattr(settings, stage), settings.train
    optimizer = make_optimizer(
        lambda _: part.learning_rate, weight_decay=train.weight_decay, clip_norm=train.clip_norm
    )
    step = functools.partial(
        train_step,
        draw=source.draw,
        loss=task.loss,
        optimizer=optimizer,
        batch_size=part.batch_size,
        ema_decay=train.ema_decay,
    )
    state = on_all_devices(init_state(task.trainable, optimizer, ema_decay=train.ema_decay))
    arrays = on_all_devices(next(source.arrays(0)))
    compiled = jax.jit(step)
    figures = measure(
        lambda: compiled(state, task.frozen, jax.random.key(0), arrays)[1].loss, steps
    )
    return figures | {"pairs_per_s": round(part.batch_size / figures["median_s"], 2)}


def main(argv: list[str]) -> None:
    """Print one JSON object."""
    config = CONFIG.value
    # The benchmark reads no stage's results, so both stages can run on fresh parameters.
    config.registration.masks = "truth"
    settings = read_settings(config)
    jax.config.update("jax_num_cpu_devices", settings.train.devices or os.cpu_count() or 1)
    shapes = cad_split("val")
    source = shape_source(shapes, shapes, settings.protocol, seed=0, validation_pairs=1)
    pair = jax.tree.map(lambda leaf: np.asarray(leaf)[0], source.validation)
    start = time.perf_counter()
    if RELEASED.value:
        params = from_released(RELEASED.value, k=settings.model.neighbours)
    else:
        params = init_params(jax.random.key(0), settings.model)
    weights_s = round(time.perf_counter() - start, 3)
    answer = jax.jit(register)
    figures = {
        "command": " ".join(["python -m benchmarks.step", *sys.argv[1:]]),
        "jax": jax.__version__,
        "backend": jax.default_backend(),
        "devices": jax.device_count(),
        "points": settings.protocol.size,
        "weights_s": weights_s,
        "register_one_pair": measure(
            lambda: answer(params, pair.source.points, pair.target.points), STEPS.value
        ),
    }
    for stage in () if RELEASED.value else ("overlap", "registration"):
        figures[f"{stage}_step"] = training_step(settings, source, stage, STEPS.value)
    print(json.dumps(figures, indent=1))


if __name__ == "__main__":
    flags.mark_flag_as_required("config")
    app.run(main, flags_parser=parse_flags)
