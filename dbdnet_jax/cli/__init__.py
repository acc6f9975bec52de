"""``dbdnet-register``: `align` for the command line."""

import argparse
import io
import shlex
import sys
import warnings
from collections.abc import Sequence

from dbdnet_jax.cli.answers import show, write_files
from dbdnet_jax.cli.arguments import read_arguments
from dbdnet_jax.cli.batch import run_batch
from dbdnet_jax.cli.jobs import read_jobs
from dbdnet_jax.cli.one_pair import Settings, align_files, prepare
from dbdnet_jax.cli.statuses import INTERRUPTED, UNREAD, say_failure
from dbdnet_jax.errors import failure_of
from dbdnet_jax.io.terminal import say


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line and return its exit status."""
    for stream in (sys.stdout, sys.stderr):  # a file's name need not be valid text
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")
    argv = sys.argv[1:] if argv is None else argv
    options = read_arguments(argv)
    with warnings.catch_warnings():
        warnings.showwarning = lambda message, *_, **__: say(f"warning: {message}", to_stderr=True)
        try:
            return _run(options, shlex.join(["dbdnet-register", *argv]))
        except BrokenPipeError:  # of standard output: `| head` has seen enough
            return UNREAD
        except KeyboardInterrupt:
            say("interrupted; no file was left half-written", to_stderr=True)
            return INTERRUPTED
        except Exception as error:
            return say_failure(failure_of(error))


def _run(options: argparse.Namespace, command: str) -> int:
    """One pair, or a batch; the exit status."""
    jobs = read_jobs(options)
    settings = _settings(options, command)
    if options.batch is not None:
        return run_batch(options, settings, jobs)
    (job,) = jobs
    prepare(options.params)
    say(f"{job.pair.source} -> {job.pair.target} ...", to_stderr=True)
    return show(job, write_files(align_files(settings, job)), as_json=options.json)


def _settings(options: argparse.Namespace, command: str) -> Settings:
    """What all pairs share."""
    names = ("refine", "search", "scale", "overlap_threshold", "max_points", "seed")
    chosen = {name: getattr(options, name) for name in names}
    initial = None
    if options.initial is not None:
        from dbdnet_jax.io.transform_files import read_transform

        initial = read_transform(options.initial).tolist()
    return Settings(options.params, {**chosen, "initial": initial}, command, "")
