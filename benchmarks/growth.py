"""How time grows with the number of points, and what memory the whole network takes.

    python -m benchmarks.growth --config=configs/modelnet.py
    python -m benchmarks.growth --config=configs/modelnet.py --parts= --forward=4096

Prints JSON: median seconds of each operation (`benchmarks.ops`) at every size of ``--parts``, and
the exponent of the power law through them, of all sizes and of the last two; which of them grow as
the square of the points (1.5 or more between the last two); and for each size of ``--forward`` the
time of one `register` of two clouds of so many points, the memory of its arrays, and the peak of a
process of its own that compiles and runs it.
"""

import dataclasses
import json
import subprocess
import sys
from typing import Any

import jax
import numpy as np
from absl import app, flags

from benchmarks.machine import compile_timed, measure, peak_gib, publish, record
from benchmarks.ops import CONFIG, OUT, RUNS, operations
from dbdnet_jax.networks.dbdnet.config import ModelConfig
from dbdnet_jax.networks.dbdnet.register import register
from dbdnet_jax.networks.initial import init_params
from dbdnet_jax.training.config import parse_flags, read_config

PARTS = flags.DEFINE_list("parts", ["256", "512", "1024", "2048", "4096"], "Sizes of the parts.")
FORWARD = flags.DEFINE_list("forward", ["1024", "2048", "4096"], "Sizes of the whole network.")
ALONE = flags.DEFINE_integer("alone", 0, "Measure the whole network here, at this size only.")
SQUARE = 1.5  # exponent from which on a part is said to grow as the square


def parts(config: ModelConfig, sizes: list[int], runs: int) -> dict[str, Any]:
    """Seconds of every operation at every size, and its exponents."""
    seconds: dict[str, list[float]] = {}
    for size in sizes:
        for name, (function, arguments, _) in operations(config, size).items():
            program, _ = compile_timed(function, *arguments)
            figures = measure(lambda program=program, x=arguments: program(*x), runs)
            seconds.setdefault(name, []).append(figures["median_s"])
    return {
        name: {
            "median_s": dict(zip(map(str, sizes), row, strict=True)),
            "exponent": exponent(sizes, row),
            "last_exponent": exponent(sizes[-2:], row[-2:]),
        }
        for name, row in seconds.items()
    }


def exponent(sizes: list[int], seconds: list[float]) -> float:
    """The slope of the logarithms: 1 where time is proportional to the size, 2 to its square."""
    return round(float(np.polyfit(np.log(sizes), np.log(seconds), 1)[0]), 2)


def whole_network(config: ModelConfig, size: int, runs: int) -> dict[str, float]:
    """`register` of two clouds of ``size`` points, all of this process's memory included."""
    params = init_params(jax.random.key(0), config)
    points = np.random.default_rng(0).uniform(-0.6, 0.6, (2, size, 3)).astype(np.float32)
    program, figures = compile_timed(register, params, *points)
    before = peak_gib()
    figures |= measure(lambda: program(params, *points), runs)
    sizes: Any = program.memory_analysis()
    arrays = sizes.temp_size_in_bytes + sizes.argument_size_in_bytes + sizes.output_size_in_bytes
    return figures | {
        "arrays_gib": round(arrays / 2**30, 3),
        "peak_compiling_gib": before,
        "peak_gib": peak_gib(),
    }


def in_own_process(size: int) -> dict[str, float]:
    """`whole_network` where nothing else has taken memory."""
    command = [sys.executable, "-m", "benchmarks.growth", *sys.argv[1:], f"--alone={size}"]
    done = subprocess.run(command, capture_output=True, text=True)
    if done.returncode:
        raise SystemExit(done.stderr)
    return json.loads(done.stdout)


def main(argv: list[str]) -> None:
    """Print one JSON object."""
    config = dataclasses.replace(
        read_config(CONFIG.value).model, overlap_points=0, registration_points=0
    )
    if ALONE.value:
        print(json.dumps(whole_network(config, ALONE.value, RUNS.value)))
        return
    # The whole network first: its processes should find the machine as they would alone.
    forward = {size: in_own_process(int(size)) for size in FORWARD.value}
    grown = parts(config, [int(size) for size in PARTS.value], RUNS.value) if PARTS.value else {}
    figures: dict[str, Any] = {
        "parts": grown,
        "as_the_square": [name for name, row in grown.items() if row["last_exponent"] >= SQUARE],
        "forward": forward,
    }
    if len(forward) > 1:
        seconds = [row["median_s"] for row in forward.values()]
        figures["forward_exponent"] = exponent([int(size) for size in forward], seconds)
    publish(record("benchmarks.growth", figures), OUT.value)


if __name__ == "__main__":
    flags.set_default(RUNS, 3)
    flags.mark_flag_as_required("config")
    app.run(main, flags_parser=parse_flags)
