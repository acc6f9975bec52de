"""How processes share thousands of pairs and devices a training, and what a kill costs.

    python -m benchmarks.scaling --part=pairs --count=300 --jobs=1,2
    python -m benchmarks.scaling --part=memory --count=2000
    python -m benchmarks.scaling --part=dask --count=1000
    python -m benchmarks.scaling --part=training --count=200 --jobs=1,2

``pairs`` aligns noisy test pairs of CAD shapes with `align_pairs`, every tenth damaged, on one
process that has one core and on more with a core each: seconds with the start, and from the first
answer to the last, so that starting counts for none. ``memory`` aligns in this process and gives
its resident memory at 100 alignments and at the end. ``dask`` aligns on two workers of Dask, of
which one is killed half-way. Each fails if a pair has no answer, or two, or if one that is not
damaged fails. ``training`` takes steps of the CAD configuration's overlap stage, of batches of four
pairs: on one XLA device that has one core, and on more with a core each; its efficiency is the
speed against that many times the first.
"""

import argparse
import multiprocessing
import os
import signal
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from typing import Any

import numpy as np
from tqdm import tqdm

from benchmarks.machine import publish, record
from dbdnet_jax.alignment.align import align
from dbdnet_jax.alignment.align_pairs import align_pairs
from dbdnet_jax.data.frozen import cad_test_pairs
from dbdnet_jax.io.programs import keep_compiled_programs
from dbdnet_jax.io.workers import available_cores

BATCH = 4  # pairs of a training step
EVERY = 10  # of so many pairs one is damaged
WARM = 100  # alignments after which memory is held against that of all


def some_pairs(count: int, damaged: bool) -> Iterator[tuple[Any, Any]]:
    """(source, target) of test pairs, over and over; every tenth may have something wrong."""
    pairs, _ = cad_test_pairs("noise")
    sources, targets = np.asarray(pairs.source.points), np.asarray(pairs.target.points)
    for i in range(count):
        source, target = sources[i % len(sources)], targets[i % len(targets)]
        if damaged and i % EVERY == EVERY - 1:  # not the first, whose answer ends the start
            nan = np.where(np.arange(source.size).reshape(source.shape) == i, np.nan, source)
            source = ("missing.ply", source[:3], nan)[i // EVERY % 3]
        yield source, target


def answer(found: Iterator[Any], count: int, damaged: bool, at_half: Callable) -> dict[str, Any]:
    """Take all answers; seconds and what failed.

    Raises:
      SystemExit: answers are missing or too many, or of what should not have failed.
    """
    begin, numbers, failed, times = time.perf_counter(), [], [], []
    for number, _, failure in tqdm(found, total=count):
        times.append(time.perf_counter() - begin)
        numbers.append(number)
        failed += [number] if failure else []
        if len(numbers) == count // 2:
            at_half()
    expected = list(range(EVERY - 1, count, EVERY)) if damaged else []
    if sorted(numbers) != list(range(count)) or sorted(failed) != expected:
        raise SystemExit(f"{len(numbers)} answers to {count} pairs; failed: {sorted(failed)}")
    sound = times[-1] - times[0]
    return {
        "seconds": round(times[-1], 1),
        "first_to_last_s": round(sound, 1),
        "pairs_per_s": round((count - 1) / sound, 3),
        "failed": len(failed),
    }


def by_processes(count: int, jobs: list[int]) -> dict[str, Any]:
    """The same pairs on each number of processes; the speed against that of the first."""
    list(align_pairs(some_pairs(2, False), jobs=1))  # makes the programs that are kept
    cores, found = enough_cores(max(jobs)), {}
    for number in jobs:
        os.sched_setaffinity(0, cores[:number])  # which the processes inherit
        results = align_pairs(some_pairs(count, True), jobs=number)
        found[str(number)] = answer(results, count, True, lambda: None)
    first = found[str(jobs[0])]["pairs_per_s"]
    speedup = {x: round(figures["pairs_per_s"] / first, 2) for x, figures in found.items()}
    return {"processes": found, "speedup": speedup}


def memory(count: int) -> dict[str, Any]:
    """Resident memory in MiB of a process that aligns again and again."""
    keep_compiled_programs()
    held = {}
    for number, pair in enumerate(tqdm(some_pairs(count, False), total=count), 1):
        align(*pair)
        if number in (min(WARM, count // 2), count):
            held[str(number)] = resident_mib()
    return {"resident_mib": held}


def resident_mib() -> float:
    """What this process holds in memory now (Linux)."""
    with open("/proc/self/statm") as file:
        return round(int(file.read().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 2**20, 1)


def by_dask(count: int) -> dict[str, Any]:
    """All pairs on two workers; half-way one of them is killed, and Dask starts another."""
    from dask.distributed import Client, LocalCluster

    with (
        LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None) as cluster,
        Client(cluster) as client,
    ):
        processes = list(client.run(os.getpid).values())
        executor = client.get_executor(pure=False)
        results = align_pairs(some_pairs(count, True), executor=executor, in_flight=8)
        return answer(results, count, True, lambda: os.kill(processes[0], signal.SIGKILL))


def by_devices(count: int, numbers: list[int]) -> dict[str, Any]:
    """Median pairs a second of training steps on each number of devices, in processes of their own.

    Raises:
      SystemExit: there are not so many cores.
    """
    enough_cores(max(numbers))
    found = {}
    for number in numbers:
        with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as executor:
            found[number] = executor.submit(train_on, number, count).result()
    first = found[numbers[0]]["pairs_per_s"] / numbers[0]
    efficiency = {str(x): round(y["pairs_per_s"] / x / first, 2) for x, y in found.items()}
    return {"training": {str(x): y for x, y in found.items()}, "efficiency": efficiency}


def enough_cores(needed: int) -> list[int]:
    """Cores of this process, as many as are needed.

    Raises:
      SystemExit: there are fewer.
    """
    cores = available_cores()
    if needed > len(cores):
        raise SystemExit(f"--jobs must be at most the {len(cores)} cores there are; got {needed}.")
    return cores[:needed]


def train_on(devices: int, count: int) -> dict[str, float]:
    """Steps on so many devices and cores, in a process that has used none yet."""
    # Here, for the other parts' processes import this file and need none of it.
    import jax

    from benchmarks.machine import matrix_rate
    from benchmarks.step import training_step
    from configs import cad
    from dbdnet_jax.data.cad import cad_split
    from dbdnet_jax.data.training_pairs import pairs_of_shapes
    from dbdnet_jax.training.config import read_config

    os.sched_setaffinity(0, enough_cores(devices))
    jax.config.update("jax_num_cpu_devices", devices)
    config = cad.get_config()
    config.train.batch_size, config.train.devices = BATCH, devices
    read, shapes = read_config(config), cad_split("val")
    stream = pairs_of_shapes(shapes, shapes, read.protocol, seed=0, validation_pairs=1)
    steps = max(1, count // BATCH)
    return training_step(read, stream, "overlap", matrix_rate(), steps)


def main() -> None:
    """Print one JSON object."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--part", choices=("pairs", "memory", "dask", "training"), required=True)
    parser.add_argument("--count", type=int, default=300, help="pairs, or alignments")
    parser.add_argument("--jobs", default="1,2", help="numbers of processes, or devices")
    parser.add_argument("--out", help="file for the record, beside printing it")
    options = parser.parse_args()
    jobs = [int(x) for x in options.jobs.split(",")]
    parts = {
        "pairs": lambda: by_processes(options.count, jobs),
        "memory": lambda: memory(options.count),
        "dask": lambda: by_dask(options.count),
        "training": lambda: by_devices(options.count, jobs),
    }
    publish(record("benchmarks.scaling", parts[options.part]()), options.out)


if __name__ == "__main__":
    main()
