"""Work in processes that may die, and through executors: every item is answered once."""

import itertools
import multiprocessing
import os
import signal
import subprocess
import sys
import threading
import time
from concurrent.futures import Executor, Future, ProcessPoolExecutor, ThreadPoolExecutor
from pathlib import Path

import pytest

from dbdnet_jax.errors import Failure
from dbdnet_jax.io import workers
from dbdnet_jax.io.workers import default_jobs, run_in_processes, run_through

ROOT = Path(__file__).parents[2]


def ready() -> None:
    """Nothing to prepare."""


def square(item: int) -> int:
    return item * item


def trouble(item: int) -> int:
    """The square; 3 kills the process, 5 is refused, 7 is a bug, 9 is too large."""
    if item == 3:
        os.kill(os.getpid(), signal.SIGKILL)
    if item in (5, 7, 9):
        raise {5: ValueError("no fives"), 7: TypeError("a bug"), 9: MemoryError("9 GiB")}[item]
    return square(item)


def die_once(mark: Path) -> int:
    """Kill the process, the first time that this is called; the process's number then."""
    if not mark.exists():
        mark.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return os.getpid()


def cores(_: int) -> tuple[int, ...]:
    time.sleep(0.3)  # so that the other process gets an item too
    return tuple(sorted(os.sched_getaffinity(0)))


def threads(_: int) -> tuple[str | None, ...]:
    return tuple(os.environ.get(name) for name in workers.THREADS)


def refuse() -> None:
    raise FileNotFoundError("no weights there")


def die() -> None:
    os._exit(1)


def check(found: dict[int, object]) -> None:
    """What `trouble` makes of 0 to 11."""
    kinds = {i: x.kind for i, x in found.items() if isinstance(x, Failure)}
    assert kinds == {3: "crash", 5: "input", 7: "unexpected", 9: "memory"}
    assert {i: x for i, x in found.items() if i not in kinds} == {
        i: i * i for i in range(12) if i not in kinds
    }


def test_a_process_that_dies_costs_its_own_item_alone():
    found = list(run_in_processes(trouble, range(12), 2, ready))
    assert len(found) == 12
    check(dict(found))
    failures = dict(found)
    assert "died (BrokenProcessPool" in failures[3].message
    assert failures[5].message == "no fives" and "no fives" in failures[5].where
    assert failures[7].message == "unexpected TypeError: a bug."
    assert failures[9].message.startswith("out of memory: 9 GiB. Give fewer points")


def test_an_item_whose_process_was_killed_by_chance_is_tried_again(tmp_path):
    (found,) = run_in_processes(die_once, [tmp_path / "mark"], 1, ready)
    assert found[0] == 0 and isinstance(found[1], int)


def test_processes_of_a_whole_machine_have_a_core_each(monkeypatch):
    monkeypatch.setenv("JAX_PLATFORMS", "cpu")
    mine = os.sched_getaffinity(0)
    shares = {share for _, share in run_in_processes(cores, range(4), 2, ready)}
    if len(mine) <= 2:
        assert shares == {(core,) for core in mine}
    else:
        assert shares == {tuple(sorted(mine))}


def test_processes_compute_in_one_thread_unless_the_user_says_otherwise(monkeypatch):
    monkeypatch.setenv("JAX_PLATFORMS", "cpu")
    for name in workers.THREADS:
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("OMP_NUM_THREADS", "3")
    ((_, found),) = run_in_processes(threads, [0], 1, ready)
    assert found == ("1", "1", "3", "1")
    assert threads(0) == (None, None, "3", None)  # here nothing has changed


def test_items_are_taken_when_there_is_room_for_them():
    taken = []
    items = (taken.append(i) or i for i in itertools.count())
    found = run_in_processes(square, items, 1, ready)
    for count in range(3):
        assert next(found) == (count, count * count)
        assert len(taken) <= count + 2
    found.close()


def test_what_preparing_raises_is_raised():
    with pytest.raises(FileNotFoundError, match="no weights there"):
        list(run_in_processes(square, range(9), 2, refuse))


def test_processes_that_cannot_start_are_no_crash_of_each_item():
    with pytest.raises(RuntimeError, match="must be able to start.*__main__"):
        list(run_in_processes(square, range(9), 2, die))


def test_closing_ends_the_processes():
    found = run_in_processes(time.sleep, itertools.chain([0], itertools.repeat(60)), 2, ready)
    next(found)
    start = time.perf_counter()
    found.close()
    assert not multiprocessing.active_children()
    assert time.perf_counter() - start < 20


SCRIPT = """
import itertools, os, sys, time
from dbdnet_jax.io.workers import run_in_processes
from tests.io.test_workers import ready, say_who_and_sleep
if __name__ == "__main__":
    for _ in run_in_processes(say_who_and_sleep, itertools.repeat(sys.argv[1]), 2, ready):
        pass
"""


def say_who_and_sleep(folder: str) -> None:
    Path(folder, str(os.getpid())).touch()
    time.sleep(60)


def alive(pid: int) -> bool:
    """Whether there is such a process that is more than a line in the table."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


def wait_for(condition, seconds: float = 40.0) -> None:
    """Return as soon as ``condition()`` holds; fail if it does not in time."""
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "it took too long"
        time.sleep(0.05)


@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="asks Linux which processes live")
@pytest.mark.parametrize("how", [signal.SIGINT, signal.SIGKILL])
def test_no_process_outlives_the_one_that_started_it(tmp_path, how):
    (tmp_path / "script.py").write_text(SCRIPT)
    (tmp_path / "pids").mkdir()
    parent = subprocess.Popen(
        [sys.executable, tmp_path / "script.py", tmp_path / "pids"],
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    wait_for(lambda: len(list((tmp_path / "pids").iterdir())) == 2)
    pids = [int(path.name) for path in (tmp_path / "pids").iterdir()]
    if how == signal.SIGINT:
        os.killpg(parent.pid, how)  # as a terminal does
    else:
        parent.kill()
    _, err = parent.communicate(timeout=40)
    wait_for(lambda: not any(map(alive, pids)))
    assert err.count("Traceback") == (how == signal.SIGINT), err  # the parent's own


class OnlySubmit(Executor):
    """An executor of another make: futures, and nothing else of the standard library's."""

    def __init__(self):
        self.most, self.now, self.lock = 0, 0, threading.Lock()
        self.pool = ThreadPoolExecutor(4)

    def submit(self, function, /, *arguments):  # noqa: D102
        with self.lock:
            self.now += 1
            self.most = max(self.most, self.now)
        outer: Future = Future()

        def settle(inner):
            with self.lock:
                self.now -= 1
            outer.set_result(inner.result())

        self.pool.submit(function, *arguments).add_done_callback(settle)
        return outer


def test_an_executor_answers_every_item_and_holds_few():
    executor = OnlySubmit()
    found = list(run_through(executor, square, range(40), 3))
    assert sorted(found) == [(i, i * i) for i in range(40)]
    assert executor.most <= 3


def test_an_executor_that_breaks_answers_with_failures():
    spawn = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(1, mp_context=spawn) as pool:
        found = dict(run_through(pool, trouble, [0, 3, 1, 2], 1))
    assert found[0] == 0
    assert [found[i].kind for i in (1, 2, 3)] == ["crash"] * 3


def test_what_is_not_needed_any_more_is_cancelled():
    with ThreadPoolExecutor(1) as pool:
        found = run_through(pool, time.sleep, [0, 0.2, *[30] * 5], 6)
        next(found)
        found.close()
        start = time.perf_counter()
    assert time.perf_counter() - start < 10


def test_processes_that_would_share_an_accelerator_are_one(monkeypatch):
    monkeypatch.setattr(workers, "entry_points", lambda group: ["xla_cuda"])
    monkeypatch.setenv("JAX_PLATFORMS", "")
    assert default_jobs() == 1
    monkeypatch.setenv("JAX_PLATFORMS", "cpu")
    assert default_jobs() == len(os.sched_getaffinity(0))


def test_what_cannot_be_submitted_is_no_crash():
    executor = ThreadPoolExecutor(1)
    executor.shutdown()
    ((_, failure),) = run_through(executor, square, [1], 1)
    assert failure.kind == "unexpected" and "after shutdown" in failure.message
