"""One method trained by `train.py`: for a number of pairs, and on to a time of one core.

Each stage has an equal part of either budget. The time is what the child processes used of the CPU,
compilation and validation included. The rate is constant, so that what is trained on is the same
run: its parameters after the pairs are kept as ``pairs.npz``, after the minutes as ``minutes.npz``,
and a point that is there is not trained again.
"""

import json
import resource
import shutil
import subprocess
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from benchmarks.paper.recipes import Recipe, Training, configuration, stages
from dbdnet_jax.data.cad import cad_split
from dbdnet_jax.io.files import write_atomic
from dbdnet_jax.training.preemption import Interrupted, interrupt_on_signals

POINTS = ("pairs", "minutes")
CADENCE = 400  # pairs from one validation, and checkpoint, to the next
GROWTH = 3  # of the pairs, at most, from one call that measures the rate to the next
LOGGED = 200  # pairs from one row of the log to the next
STARTING_S = 40  # of a first call that are no training
STARTING_AGAIN_S = 15  # of a later one, whose programs are compiled already

Run = Callable[[Sequence[str]], float]  # a command line's CPU seconds


class Stopped(SystemExit):
    """A training was asked to stop with this process; ``seconds`` of the CPU it had used."""

    def __init__(self, seconds: float) -> None:
        super().__init__("stopped; the same command goes on from here")
        self.seconds = seconds


def train(
    recipe: Recipe,
    training: Training,
    folder: Path,
    *,
    pairs: int,
    minutes: float,
    points: Sequence[str] = POINTS,
    run: Run | None = None,
) -> None:
    """Train to the points, in their order, whatever is not there yet.

    What a training that is stopped half-way has used counts, and it goes on from there.

    Raises:
        ValueError: minutes without the pairs that they go on from.
        Stopped: this process was asked to stop.
    """
    config = configuration(recipe)
    names = stages(config)
    seen, seconds = _read(folder)

    def advance(stage: str, budget: int) -> None:
        batch = config.stages[stage].batch_size
        line = command(recipe, training, folder, stage, batch, budget)
        before = seconds.get(stage, 0.0)
        try:
            seconds[stage] = before + (run or _cpu_seconds)(line)
            seen[stage] = budget
        except Stopped as stopped:
            seconds[stage] = before + stopped.seconds
            seen[stage] = batch * _saved_steps(folder / stage)
            raise
        finally:
            _write(folder, seen, seconds)

    for point in POINTS:
        if point not in points or (folder / f"{point}.npz").exists():
            continue
        if point == "minutes" and not (folder / "pairs.npz").exists():
            raise ValueError(
                f"the minutes go on from the pairs, and {folder} has none; train those first."
            )
        for stage in names:
            if point == "pairs" and seen.get(stage, 0) < pairs // len(names):
                advance(stage, pairs // len(names))
            if point == "minutes":
                rate = seen[stage] / max(seconds[stage] - STARTING_S, 1)
                limit = 60 * minutes / len(names)
                while budget := affordable(seen[stage], rate, limit - seconds[stage]):
                    before = seen[stage], seconds[stage]
                    advance(stage, budget)
                    took = seconds[stage] - before[1] - STARTING_AGAIN_S
                    rate = (seen[stage] - before[0]) / max(took, 1)
        shutil.copyfile(folder / "params.npz", folder / f"{point}.npz")
        write_atomic(folder / f"{point}.json", json.dumps(spent(folder)).encode())


def affordable(pairs: int, rate: float, left_s: float) -> int:
    """How many pairs a stage can have seen when its time is up; 0 if no more than it has.

    At most `GROWTH` times as many as now: its rate is known of those it has seen.
    """
    more = min(rate * (left_s - STARTING_AGAIN_S), max((GROWTH - 1) * pairs, CADENCE))
    whole = int(more / CADENCE) * CADENCE
    return pairs + whole if whole > 0 else 0


def command(
    recipe: Recipe, training: Training, folder: Path, stage: str, batch: int, pairs: int
) -> list[str]:
    """The command line that trains a stage until it has seen so many pairs."""
    half = "seen" if training.half else None
    epoch = len(cad_split("train", half))
    changes: dict[str, Any] = {
        "data.categories": half or "all",
        "train.devices": 1,
        "train.schedule": "constant",
        "train.milestones": "()",
        "train.seed": training.seed,
        "train.log_every": LOGGED // batch,
        "train.validate_every": CADENCE // batch,
        "train.checkpoint_every": CADENCE // batch,
        f"{stage}.epochs": pairs / epoch,
    }
    fields = [f"--config.{name}={value}" for name, value in changes.items()]
    head = [sys.executable, "train.py", f"--config={recipe.config}.py", f"--run_dir={folder}"]
    return [*head, f"--stage={stage}", "--noevaluate", *fields]


def spent(folder: Path) -> dict[str, Any] | None:
    """Pairs and CPU seconds of each stage so far; None of a run that came from elsewhere."""
    seen, seconds = _read(folder)
    return {"pairs": seen, "cpu_seconds": seconds} if seen else None


def _cpu_seconds(line: Sequence[str]) -> float:
    before = _used_seconds()
    with interrupt_on_signals(), subprocess.Popen(line) as child:
        try:
            status = child.wait()
        except Interrupted:
            child.terminate()  # it saves its state
            child.wait()
            raise Stopped(_used_seconds() - before) from None
    if status:
        raise SystemExit(f"error: training ended with status {status}: {' '.join(line)}")
    return _used_seconds() - before


def _used_seconds() -> float:
    """Of the CPU, by the processes that this one has started and that have ended."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def _saved_steps(stage: Path) -> int:
    return max((int(path.name) for path in (stage / "checkpoints").glob("[0-9]*")), default=0)


def _read(folder: Path) -> tuple[dict[str, int], dict[str, float]]:
    path = folder / "spent.json"
    if not path.exists():
        return {}, {}
    found = json.loads(path.read_text())
    return found["pairs"], found["cpu_seconds"]


def _write(folder: Path, seen: dict[str, int], seconds: dict[str, float]) -> None:
    text = json.dumps({"pairs": seen, "cpu_seconds": seconds})
    write_atomic(folder / "spent.json", text.encode())
