"""A scheduler and two workers of Dask, real processes on the loopback interface."""

import contextlib
import json
import os
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).parents[1]


class Cluster(NamedTuple):
    """``HOST:PORT`` of the scheduler, and the workers."""

    address: str
    workers: list[subprocess.Popen]


def square_slowly(item: int) -> tuple[int, int]:
    """The square, and the process that it was made in."""
    time.sleep(0.1)
    return item * item, os.getpid()


@contextlib.contextmanager
def cluster(folder: Path) -> Iterator[Cluster]:
    """A cluster that keeps its files in a folder; workers that are killed are not replaced."""
    file = folder / "scheduler.json"
    scheduler = ["scheduler", "--host=127.0.0.1", "--port=0", "--no-dashboard"]
    worker = ["worker", "--nthreads=1", "--no-nanny", "--no-dashboard", "--host=127.0.0.1"]
    worker += [f"--local-directory={folder}"]
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    started = []
    with (folder / "log").open("w") as log:
        try:
            for command in (scheduler, worker, worker):
                arguments = [sys.executable, "-m", "dask", *command, f"--scheduler-file={file}"]
                process = subprocess.Popen(arguments, env=environment, stdout=log, stderr=log)
                started.append(process)
            address = wait_for_address(file)
            yield Cluster(address, started[1:])
        finally:
            for process in started:
                process.kill()
                process.wait()


def wait_for_address(file: Path) -> str:
    """``HOST:PORT`` from the file that the scheduler writes."""
    end = time.monotonic() + 60
    while time.monotonic() < end:
        with contextlib.suppress(OSError, ValueError):
            return json.loads(file.read_text())["address"].removeprefix("tcp://")
        time.sleep(0.1)
    raise TimeoutError(f"no scheduler wrote {file}: {(file.parent / 'log').read_text()}")
