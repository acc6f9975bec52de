"""What the benchmarks share: times, the machine's own rate to hold them against, and records."""

import json
import os
import platform
import resource
import shlex
import statistics
import sys
import time
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp

from dbdnet_jax.io.files import write_atomic
from dbdnet_jax.io.workers import available_cores

SIZE = 2048  # of the product that measures the machine
LIBRARIES = ("jax", "jaxlib", "flax", "optax", "numpy")


def compile_timed(function: Callable, *arguments: Any) -> tuple[Callable, dict[str, float]]:
    """``function`` compiled for these arguments, and the seconds to trace and to compile it.

    Where JAX is told to keep compiled programs (``JAX_COMPILATION_CACHE_DIR``), only the first
    run measures compilation; records say whether it was.
    """
    start = time.perf_counter()
    lowered = jax.jit(function).lower(*arguments)
    traced = time.perf_counter()
    program = lowered.compile()
    compiled = time.perf_counter()
    return program, {
        "trace_s": round(traced - start, 3),
        "compile_s": round(compiled - traced, 3),
    }


def measure(run: Callable[[], Any], count: int) -> dict[str, float]:
    """Median, minimum and maximum wall seconds of ``count`` runs, after one that is not timed."""
    jax.block_until_ready(run())
    seconds = []
    for _ in range(count):
        start = time.perf_counter()
        jax.block_until_ready(run())
        seconds.append(time.perf_counter() - start)
    summary = {
        "median_s": statistics.median(seconds),
        "min_s": min(seconds),
        "max_s": max(seconds),
    }
    return {name: float(f"{value:.3g}") for name, value in summary.items()}


def matrix_rate(runs: int = 5) -> float:
    """Operations per second of a 2048 x 2048 x 2048 product in float32 on the default device."""
    a = jnp.ones((SIZE, SIZE), jnp.float32)
    program, _ = compile_timed(jnp.matmul, a, a)
    return 2 * SIZE**3 / measure(lambda: program(a, a), runs)["median_s"]


def against(rate: float, multiply_adds: int, seconds: float) -> dict[str, float]:
    """Arithmetic and what part of the machine's rate it ran at."""
    operations = 2 * multiply_adds
    return {
        "gflop": float(f"{operations / 1e9:.3g}"),
        "part_of_rate": float(f"{operations / seconds / rate:.3g}"),
    }


def peak_gib() -> float:
    """The most memory that this process has held so far."""
    kib = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return round(kib / 2 ** (30 if sys.platform == "darwin" else 20), 2)


def record(module: str, figures: dict[str, Any]) -> dict[str, Any]:
    """Figures with what they were measured on and by which command."""
    return {
        "command": shlex.join(["python", "-m", module, *sys.argv[1:]]),
        "date": time.strftime("%Y-%m-%d"),
        "python": platform.python_version(),
        "versions": {library: version(library) for library in LIBRARIES},
        "cpu": processor(),
        "cores": len(available_cores()),
        "backend": jax.default_backend(),
        "devices": jax.device_count(),
        "xla_flags": os.environ.get("XLA_FLAGS", ""),
        "compiled_programs_kept": jax.config.values["jax_compilation_cache_dir"] is not None,
        **figures,
    }


def publish(found: dict[str, Any], out: str | None) -> None:
    """Print a record as JSON, and write it to the file ``out`` if there is one."""
    text = json.dumps(found, indent=1)
    print(text)
    if out:
        write_atomic(Path(out), (text + "\n").encode())


def processor() -> str:
    """The processor's name, as the system gives it."""
    info = Path("/proc/cpuinfo")
    lines = info.read_text().splitlines() if info.exists() else []
    names = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor()
