"""Many pairs: spread over processes, answered as they come, and gone on with where they stopped."""

import argparse
import contextlib
import functools
import sys
import warnings
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from dbdnet_jax.cli.answers import as_record, show, write_files
from dbdnet_jax.cli.jobs import Job
from dbdnet_jax.cli.one_pair import Answer, Settings, align_files, prepare
from dbdnet_jax.cli.results import append, find_done, finished, open_results
from dbdnet_jax.cli.statuses import ALIGNED, UNSURE
from dbdnet_jax.io.dask_executor import open_dask
from dbdnet_jax.io.terminal import say
from dbdnet_jax.io.workers import default_jobs, run_in_processes, run_through

if TYPE_CHECKING:
    from tqdm import tqdm

DASK = "dask://"


def run_batch(options: argparse.Namespace, settings: Settings, jobs: Sequence[Job]) -> int:
    """Align every pair that is not done yet; the largest exit status of all."""
    results, done = None, {}
    if options.results is not None:
        from dbdnet_jax.networks.weights import weights_digest

        network = {"params": settings.weights, "params_sha256": weights_digest(settings.weights)}
        results = open_results(options.results, settings.options | network)
        done = {job: valid for job in jobs if (valid := find_done(results, job)) is not None}
        if done:
            say(f"{len(done)} of {len(jobs)} pairs are done already", to_stderr=True)
    statuses = [ALIGNED if valid else UNSURE for valid in done.values()]
    left = [job for job in jobs if job not in done]
    answers = _answers(options, settings, left) if left else contextlib.nullcontext(())
    with (
        contextlib.nullcontext() if results is None else finished(results),
        answers as found,
        _progress(len(left)) as bar,
    ):
        for number, answer in found:
            answer = write_files(answer)
            if results is not None:
                append(results, as_record(left[number], answer))
            with bar.external_write_mode(file=sys.stderr):
                pair = left[number].pair
                if bar.disable:
                    count = f"{len(statuses) + 1}/{len(jobs)}"
                    say(f"{count} {pair.source} -> {pair.target}", to_stderr=True)
                statuses.append(show(left[number], answer, as_json=options.json))
            bar.update()
    return max(statuses)


@contextlib.contextmanager
def _answers(
    options: argparse.Namespace, settings: Settings, jobs: Sequence[Job]
) -> Iterator[Iterator[tuple[int, Any]]]:
    """Answers as they come, with the numbers of their jobs; on leaving, all workers are let go."""
    if options.executor is None:
        count = min(options.jobs or default_jobs(), len(jobs))
        work = functools.partial(align_files, settings)
        ready = functools.partial(_prepare_process, settings.weights)
        with contextlib.closing(run_in_processes(work, jobs, count, ready)) as found:
            yield found
    else:
        settings = settings._replace(folder=str(Path.cwd()))
        if settings.weights.endswith(".npz"):
            settings = settings._replace(weights=str(Path(settings.weights).absolute()))
        work = functools.partial(_align_elsewhere, settings)
        with open_dask(options.executor.removeprefix(DASK)) as (executor, room):
            with contextlib.closing(run_through(executor, work, jobs, room)) as found:
                yield found


def _prepare_process(weights: str) -> None:
    """`prepare` a process that says warnings as this one does."""
    warnings.showwarning = lambda message, *_, **__: say(f"warning: {message}", to_stderr=True)
    prepare(weights)


def _align_elsewhere(settings: Settings, job: Job) -> Answer:
    """`align_files` in a process that is not ours, and prepared by its first pair."""
    _prepare_once(settings.weights)
    return align_files(settings, job)


_prepare_once = functools.cache(prepare)


def _progress(count: int) -> "tqdm":
    """A bar with rate and remaining time, where somebody can see it."""
    from tqdm import tqdm

    terminal = sys.stderr is not None and sys.stderr.isatty()
    return tqdm(total=count, unit="pair", disable=not terminal, dynamic_ncols=True)
