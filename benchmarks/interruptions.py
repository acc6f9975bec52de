"""Whether a training that is stopped again and again ends as one that nobody stopped.

    python -m benchmarks.interruptions --kills=20
    python -m benchmarks.interruptions --kills=5 -- python train.py --config=configs/cad_short.py \
        --stage=overlap --noevaluate --config.train.log_every=1

Trains once without a break and once with SIGKILL and SIGTERM in turn at random moments, half of
them within a tenth of a second after a row of the log, which is when checkpoints are written.
Prints a line for each kill and ends with status 1 where the two differ in any bit of the last
checkpoint (parameters, optimizer, averages), of the best weights or of the curves. Without a
command of one's own train.py trains a loss that compiles in a second; each kill then costs about
eight seconds of one core.
"""

from __future__ import annotations

import argparse
import json
import random
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

STAND_IN = (
    *(sys.executable, "-m", "tests.stand_in_train", "--config=configs/cad.py", "--noevaluate"),
    *("--stage=overlap", "--config.overlap.epochs=0.0625", "--config.protocol.points=24"),
    *("--config.model.overlap_channels=4", "--config.model.overlap_blocks=1"),
    *("--config.train.log_every=1", "--config.train.validate_every=8"),
    *("--config.train.checkpoint_every=2", "--config.train.validation_pairs=2"),
    *("--config.train.ema_decay=0.9", "--config.train.devices=1"),
)
PATIENCE_S = 600.0


def rows(run_dir: Path) -> int:
    """The rows of all stages' logs so far."""
    return sum(path.read_bytes().count(b"\n") - 1 for path in run_dir.glob("*/train.csv"))


def interrupt(
    command: Sequence[str], run_dir: Path, number: signal.Signals, at_row: int, delay_s: float
) -> str:
    """Start the training, send it a signal ``delay_s`` after a row; what came of it, in words.

    Raises:
        RuntimeError: it ended otherwise than such a signal lets it end.
    """
    child = subprocess.Popen(
        [*command, f"--run_dir={run_dir}"], stdout=subprocess.PIPE, stderr=subprocess.PIPE
    )
    deadline = time.monotonic() + PATIENCE_S
    while child.poll() is None and time.monotonic() < deadline:
        locks = [path.read_text() for path in run_dir.glob("*/training.lock")]
        if rows(run_dir) >= at_row and any(f"process {child.pid} " in lock for lock in locks):
            break  # it has started, and come so far
        time.sleep(0.005)
    time.sleep(delay_s)
    child.send_signal(number)
    said, errors = (text.decode() for text in child.communicate(timeout=PATIENCE_S))
    if child.returncode == 0 and "The best weights are in" in said:
        return "it had ended before"
    writing = any(run_dir.glob("*/checkpoints/*tmp*"))
    if number == signal.SIGTERM and (child.returncode or "same command goes on" not in said):
        raise RuntimeError(f"SIGTERM ended it with {child.returncode}: {said}{errors}")
    if number == signal.SIGKILL and child.returncode != -number:
        raise RuntimeError(f"it ended with {child.returncode} before SIGKILL: {said}{errors}")
    return f"{number.name} after {rows(run_dir)} rows" + (", while saving" if writing else "")


def outcome(run_dir: Path) -> dict[str, object]:
    """What must not depend on interruptions, by name: checksums, curves, weights."""
    found: dict[str, object] = {"weights": (run_dir / "params.npz").read_bytes()}
    for stage in sorted(path.parent for path in run_dir.glob("*/checkpoints")):
        last = max((stage / "checkpoints").glob("[0-9]*"), key=lambda path: int(path.name))
        metadata = json.loads((last / "_CHECKPOINT_METADATA").read_text())
        found[f"{stage.name}, step"] = last.name
        found[f"{stage.name}, state"] = metadata["custom_metadata"]["crc32"]
        for curve in ("train.csv", "validation.csv"):
            found[f"{stage.name}, {curve}"] = (stage / curve).read_bytes()
    return found


def differences(command: Sequence[str], folder: Path, kills: int, seed: int) -> list[str]:
    """Names of what an interrupted training ended with that an unbroken one did not."""
    unbroken, stopped = folder / "unbroken", folder / "stopped"
    subprocess.run([*command, f"--run_dir={unbroken}"], check=True, capture_output=True)
    total, draw = rows(unbroken), random.Random(seed)
    at_rows = sorted(draw.choices(range(1, total), k=kills))
    for i, at_row in enumerate(at_rows):
        number = (signal.SIGKILL, signal.SIGTERM)[i % 2]
        delay_s = draw.uniform(0.0, 0.1) if i % 4 < 2 else 0.0
        print(interrupt(command, stopped, number, at_row, delay_s), flush=True)
    subprocess.run([*command, f"--run_dir={stopped}"], check=True, capture_output=True)
    found, expected = outcome(stopped), outcome(unbroken)
    return sorted(name for name in expected | found if expected.get(name) != found.get(name))


def main() -> None:
    """Print a line for each kill, and whether anything differs."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--kills", type=int, default=20)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("command", nargs="*", help="a training, without --run_dir, after --")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        different = differences(
            arguments.command or STAND_IN, Path(folder), arguments.kills, arguments.seed
        )
    if different:
        sys.exit(f"error: an interrupted training must end as an unbroken one; not so: {different}")
    print("The interrupted training ended as the unbroken one, bit for bit.")


if __name__ == "__main__":
    main()
