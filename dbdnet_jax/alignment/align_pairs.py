"""Many pairs of one's own: each aligned on its own, in many processes, as they come."""

import functools
import inspect
import os
from collections.abc import Iterable, Iterator
from concurrent.futures import Executor
from pathlib import Path
from typing import Any, NamedTuple

from dbdnet_jax.alignment.align import Alignment, align
from dbdnet_jax.alignment.arguments import check_options
from dbdnet_jax.errors import Failure
from dbdnet_jax.io.programs import keep_compiled_programs, require_device
from dbdnet_jax.io.workers import available_cores, default_jobs, run_in_processes, run_through
from dbdnet_jax.networks.params import Params
from dbdnet_jax.networks.weights import load_once

IN_FLIGHT = 2  # pairs for each core of this machine, of an executor that is given


class PairResult(NamedTuple):
    """What became of pair ``number``, counted from 0: an ``alignment``, or a ``failure``."""

    number: int
    alignment: Alignment | None
    failure: Failure | None


def align_pairs(
    pairs: Iterable[tuple[Any, Any]],
    params: Params | str | Path | None = None,
    *,
    executor: Executor | None = None,
    jobs: int | None = None,
    in_flight: int | None = None,
    **options: Any,
) -> Iterator[PairResult]:
    """Align many pairs; gives each one's result once, as they come, not in their order.

    Whatever is the matter with a pair costs that pair alone: its result has a `Failure`. Pairs are
    taken one by one, so ``pairs`` may be a generator of any length, and only those that are being
    worked on are held::

        for number, alignment, failure in dbdnet_jax.align_pairs([("a.ply", "b.ply"), ...]):
            print(number, failure.message if failure else alignment.transform)

    Without an executor it starts processes of its own, which load weights and programs once each
    and work on one core each. They import the script that starts them, so its own work
    must stand below ``if __name__ == "__main__":``. A process that dies (a crash, a kill, memory)
    is replaced, and its pair tried once more, alone, at the end. They end when the iterator is
    closed or this process ends.

    Args:
      pairs: (source, target), each an (n, 3) array or a file as for `align`.
      params: the network, or the name or ``.npz`` file of one, which each process loads once; the
        weights in the package, if None.
      executor: anything with the ``submit`` of `concurrent.futures.Executor`: Dask's
        ``client.get_executor()``, Ray's, MPI's, a pool of threads. Paths must be good where it
        works. It is neither changed nor shut down.
      jobs: processes of its own; one for each core, or one where there may be an accelerator, if
        None.
      in_flight: pairs that an executor has at most; twice the cores of this machine, if None. Give
        twice the workers of a larger one.
      **options: those of every `align`: ``refine``, ``search``, ``scale``, ``overlap_threshold``,
        ``max_points``, ``seed``, ``initial`` and ``proposals``.

    Raises:
      TypeError: an option that `align` does not have.
      ValueError: options of no use, numbers below 1, or both an executor and jobs.
      RuntimeError: no process of its own can start.
    """
    inspect.signature(align).bind(None, None, None, **options)
    check_options(**{name: value for name, value in options.items() if name != "seed"})
    for name, value in (("jobs", jobs), ("in_flight", in_flight)):
        if value is not None and value < 1:
            raise ValueError(f"{name} must be at least 1; got {value}. Leave it out for a default.")
    if executor is not None and jobs is not None:
        raise ValueError("jobs must not be given with an executor; it has workers of its own.")
    weights = params if isinstance(params, Params) else str(params or "cad")
    if executor is None:
        prepare = functools.partial(_prepare, weights)
        work = functools.partial(_align, weights, options)
        found = run_in_processes(work, pairs, jobs or default_jobs(), prepare)
    else:
        work = functools.partial(_align_there, os.getpid(), weights, options)
        found = run_through(executor, work, pairs, in_flight or IN_FLIGHT * len(available_cores()))
    return _results(found)


def _results(found: Iterator[tuple[int, Any]]) -> Iterator[PairResult]:
    """Answers and failures in a record of their own."""
    for number, answer in found:
        failed = isinstance(answer, Failure)
        yield PairResult(number, None if failed else answer, answer if failed else None)


def _prepare(weights: Params | str) -> None:
    """What a process of our own needs once."""
    keep_compiled_programs()
    require_device()
    _load(weights)


def _align(weights: Params | str, options: dict[str, Any], pair: tuple[Any, Any]) -> Alignment:
    """One pair, in whatever process this is."""
    source, target = pair
    return align(source, target, _load(weights), **options)


def _align_there(
    home: int, weights: Params | str, options: dict[str, Any], pair: tuple[Any, Any]
) -> Alignment:
    """One pair in an executor; where that is a process but ``home``, programs are kept in it."""
    if os.getpid() != home:
        _keep_once()
    return _align(weights, options, pair)


_keep_once = functools.cache(keep_compiled_programs)


def _load(weights: Params | str) -> Params:
    """The network that is given, or the one that is named."""
    return load_once(weights) if isinstance(weights, str) else weights
