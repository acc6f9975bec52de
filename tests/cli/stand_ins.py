"""What stands in for `align_files` in processes: without JAX, and able to die."""

import os
import signal

from dbdnet_jax.cli.jobs import Job
from dbdnet_jax.cli.one_pair import Answer, Settings


def prepare_nothing(weights: str) -> None:
    """No weights and no programs are needed to stand in for `align_files`."""


def stand_in(settings: Settings, job: Job) -> Answer:
    """An answer by the source's first letter: k kills the process, b is bad, u is unsure."""
    kind = job.pair.source.name[0]
    if kind == "k":
        os.kill(os.getpid(), signal.SIGKILL)
    if kind == "b":
        raise ValueError("a bad cloud")
    files = () if job.transform is None else ((job.transform, b"T"),)
    return Answer(kind != "u", files, {"valid": kind != "u", "process": os.getpid()}, ["found"])
