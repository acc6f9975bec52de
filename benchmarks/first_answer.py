"""What the first answer costs: import, compilation, and a second process that need not compile.

    python -m benchmarks.first_answer

Every figure is of a process of its own, "cold" with an empty folder for compiled programs, "warm"
with the folder that it left (the median of three). Seconds: ``jax`` to import JAX, ``package`` to
import this package after it, ``weights`` to load those of the CAD shapes, ``first`` and ``second``
for two calls on a pair of 717 points. "register" is ``jax.jit(register)``; "align" is the network's
program as `align` and the command line keep it, which need not be traced again either.
"""

import argparse
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from typing import Any

WARM_RUNS = 3


def child(way: str) -> None:
    """Measure in this process and print JSON; nothing is imported before it is timed."""
    start = time.perf_counter()
    import jax

    laps = {"jax": time.perf_counter() - start}

    def lap(name: str, run: Callable[[], Any]) -> Any:
        start = time.perf_counter()
        result = run()
        laps[name] = time.perf_counter() - start
        return result

    package = lap("package", lambda: __import__("dbdnet_jax"))
    import numpy as np

    from dbdnet_jax.alignment.pose_programs import predict_pose
    from dbdnet_jax.io.programs import keep_compiled_programs

    keep_compiled_programs()
    params = lap("weights", package.load_pretrained)
    points = np.random.default_rng(0).uniform(-0.6, 0.6, (2, 717, 3)).astype(np.float32)
    register = jax.jit(package.register) if way == "register" else predict_pose
    for name in ("first", "second"):
        lap(name, lambda: jax.block_until_ready(register(params, *points)))
    print(json.dumps({name: round(seconds, 3) for name, seconds in laps.items()}))


def run(way: str, folder: str) -> dict[str, float]:
    """One process that keeps its compiled programs in ``folder``."""
    environment = {k: v for k, v in os.environ.items() if not k.startswith("JAX_")}
    environment |= {"XDG_CACHE_HOME": folder, "JAX_PLATFORMS": "cpu"}
    code = f"from benchmarks.first_answer import child; child({way!r})"
    done = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True)
    if done.returncode:
        raise SystemExit(done.stderr.decode())
    return json.loads(done.stdout.splitlines()[-1])


def main() -> None:
    """Print one JSON object."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", help="file for the record, beside printing it")
    out = parser.parse_args().out
    from benchmarks.machine import publish, record

    figures = {}
    for way in ("register", "align"):
        with tempfile.TemporaryDirectory() as folder:
            cold, *warm = [run(way, folder) for _ in range(1 + WARM_RUNS)]
        median = {name: statistics.median(row[name] for row in warm) for name in cold}
        figures[way] = {"cold": cold, "warm": median}
    publish(record("benchmarks.first_answer", {"seconds": figures}), out)


if __name__ == "__main__":
    main()
