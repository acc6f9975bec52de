"""Work on many items: in processes of our own, which may die, or through anyone's executor."""

import contextlib
import importlib.util
import itertools
import multiprocessing
import os
import queue
import signal
import threading
from collections.abc import Callable, Generator, Iterable, Iterator
from concurrent.futures import BrokenExecutor, Executor, Future, ProcessPoolExecutor
from importlib.metadata import entry_points
from typing import Any, NamedTuple

from dbdnet_jax.errors import Failure, failure_of

THREADS = ("NPROC", "OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS")  # NPROC: XLA's


class Worker(NamedTuple):
    """A pool of one process, and the process's number once it is prepared."""

    pool: ProcessPoolExecutor
    prepared: Future


def available_cores() -> list[int]:
    """The cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return sorted(os.sched_getaffinity(0))
    return list(range(os.cpu_count() or 1))


def default_jobs() -> int:
    """One for each core that this process may use; one where JAX may find an accelerator.

    Processes that share an accelerator would take its memory from one another.
    """
    return 1 if _may_accelerate() else len(available_cores())


def run_through(
    executor: Executor, work: Callable[[Any], Any], items: Iterable[Any], in_flight: int
) -> Generator[tuple[int, Any], None, None]:
    """The number of each item, and what ``work`` makes of it or a `Failure`, as they come.

    Only ``executor.submit`` and its futures' ``add_done_callback``, ``result`` and ``cancel`` are
    used. At most ``in_flight`` items are submitted and unanswered; the next is taken from ``items``
    when one is answered. What cannot be submitted any more, because the executor is broken or shut
    down, is a failure too.
    """
    done: queue.SimpleQueue[Future] = queue.SimpleQueue()
    numbered = enumerate(items)
    given: dict[Future, int] = {}

    def give() -> None:
        for index, item in itertools.islice(numbered, 1):
            try:
                future = executor.submit(_attempt, work, item)
            except Exception as error:
                future = Future()
                future.set_exception(error)
            given[future] = index
            future.add_done_callback(done.put)

    try:
        for _ in range(in_flight):
            give()
        while given:
            future = done.get()
            index = given.pop(future)
            give()
            yield index, _outcome(future)
    finally:
        for future in given:
            future.cancel()


def run_in_processes(
    work: Callable[[Any], Any],
    items: Iterable[Any],
    jobs: int,
    prepare: Callable[[], Any],
) -> Generator[tuple[int, Any], None, None]:
    """The same in ``jobs`` spawned processes of our own, each with one item at a time.

    Each calls ``prepare`` once, and works on one core. Where a process dies, another
    takes its place; the item in it is tried again at the end, alone, since memory may have been
    short, and is a `Failure` if that process dies too. All processes are killed when the iterator
    is closed, and end when this process does.

    Raises:
      RuntimeError: no process gets as far as its first item.
      Exception: of ``prepare``, as it was raised there.
    """
    died = []
    with contextlib.closing(_rounds(work, enumerate(items), jobs, prepare)) as found:
        for index, item, future in found:
            if isinstance(future.exception(), BrokenExecutor):
                died.append((index, item))
            else:
                yield index, _outcome(future)
    with contextlib.closing(_rounds(work, iter(died), 1, prepare)) as found:
        for index, _, future in found:
            yield index, _outcome(future)


def _rounds(
    work: Callable[[Any], Any],
    numbered: Iterator[tuple[int, Any]],
    jobs: int,
    prepare: Callable[[], Any],
) -> Generator[tuple[int, Any, Future], None, None]:
    """Every item with its future, done or broken."""
    done: queue.SimpleQueue[Future] = queue.SimpleQueue()
    workers: dict[int, Worker] = {}
    given: dict[Future, tuple[int, int, Any]] = {}

    def give(place: int) -> None:
        for index, item in itertools.islice(numbered, 1):
            try:
                future = workers[place].pool.submit(_work_on, item)
            except (KeyError, BrokenExecutor):  # none yet, or it died at rest
                workers[place] = _start(place, jobs, work, prepare)
                future = workers[place].pool.submit(_work_on, item)
            given[future] = place, index, item
            future.add_done_callback(done.put)

    able = False
    try:
        for place in range(jobs):
            give(place)
        while given:
            future = done.get()
            place, index, item = given.pop(future)
            _check_prepared(workers[place].prepared, able)
            able = True
            give(place)
            yield index, item, future
    except BaseException:
        for worker in workers.values():
            _kill(worker.pool)
        raise
    finally:
        for worker in workers.values():
            worker.pool.shutdown()


def _check_prepared(prepared: Future, able: bool) -> None:
    """Pass on what ``prepare`` raised, and refuse to go on where processes only die."""
    error = prepared.exception()
    if isinstance(error, BrokenExecutor):
        if not able:
            raise RuntimeError(
                "a worker process must be able to start; the first one died before its first "
                "pair. Where a script starts it, the script's own work must stand below "
                'if __name__ == "__main__":, since each process imports it.'
            ) from error
    elif error is not None:
        raise error


def _start(place: int, jobs: int, work: Callable[[Any], Any], prepare: Callable[[], Any]) -> Worker:
    """A new process that is getting ready."""
    pool = ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn"))
    with _interrupts_held(), _one_thread():
        return Worker(pool, pool.submit(_prepare, place, jobs, work, prepare))


@contextlib.contextmanager
def _interrupts_held() -> Iterator[None]:
    """Let a process that is started here never see Ctrl-C: it is ours to end."""
    if not hasattr(signal, "pthread_sigmask"):  # Windows
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


@contextlib.contextmanager
def _one_thread() -> Iterator[None]:
    """Let a process that is started here compute in one thread: a pair gains nothing from more.

    Threads of NumPy's BLAS would wait for one another on the core that they share. They are made
    when it is imported, before any function of ours is called there. A user's own numbers stay.
    """
    unset = [] if _may_accelerate() else [x for x in THREADS if x not in os.environ]
    os.environ.update(dict.fromkeys(unset, "1"))
    try:
        yield
    finally:
        for name in unset:
            os.environ.pop(name, None)


def _kill(pool: ProcessPoolExecutor) -> None:
    """End a pool's process at once."""
    # Python 3.14 has kill_workers; before it there is no public way.
    for process in list((pool._processes or {}).values()):
        process.kill()


def _may_accelerate() -> bool:
    """Whether JAX could find more than the CPU; asking JAX itself would start it."""
    platforms = os.environ.get("JAX_PLATFORMS", "").split(",")
    plugins = entry_points(group="jax_plugins") or importlib.util.find_spec("libtpu")
    return bool(plugins) and platforms != ["cpu"]


def _prepare(place: int, jobs: int, work: Callable[[Any], Any], prepare: Callable[[], Any]) -> None:
    """In a new process: keep to one core, end with the parent, get ready."""
    threading.Thread(target=_end_with_parent, daemon=True).start()
    if not _may_accelerate():
        cores = available_cores()
        if jobs >= len(cores) and hasattr(os, "sched_setaffinity"):  # else others may want them
            os.sched_setaffinity(0, [cores[place % len(cores)]])
    _HELD["work"] = work
    prepare()


def _end_with_parent() -> None:
    """Wait for the parent's end, which a process that waits for work would not notice."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
    os._exit(1)


def _work_on(item: Any) -> Any:
    """In a process of ours that is ready: the item's answer or `Failure`."""
    return _attempt(_HELD["work"], item)


def _attempt(work: Callable[[Any], Any], item: Any) -> Any:
    """What ``work`` makes of an item, or why it made nothing."""
    try:
        return work(item)
    except Exception as error:
        return failure_of(error)


def _outcome(future: Future) -> Any:
    """What `_attempt` returned, or a `Failure` that says that it did not return."""
    try:
        return future.result()
    except BrokenExecutor as error:
        return Failure(
            "crash", f"the process that worked on it died ({type(error).__name__}: {error})."
        )
    except Exception as error:  # it could not be sent, or nothing takes it any more
        return failure_of(error)


_HELD: dict[str, Callable[[Any], Any]] = {}
