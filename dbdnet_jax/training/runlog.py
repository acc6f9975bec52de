"""The curves of a run: one CSV file for each kind of row, and TensorBoard events beside them."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from pathlib import Path

import jax

from dbdnet_jax.io.files import write_atomic

KINDS = ("train", "validation")


class RunLog:
    """Rows of scalars by step, in ``folder/KIND.csv`` and ``folder/tensorboard``.

    Opened at the step a run goes on from, it drops the rows after it: those steps are done again,
    and the files end up as those of an unbroken run. Other files of the folder are left alone.
    Of several processes only the first writes.
    """

    def __init__(self, folder: Path, start: int):
        from tensorboardX import SummaryWriter

        self._folder, self._events = folder, None
        if jax.process_index():
            return
        for kind in KINDS:
            _truncate(folder / f"{kind}.csv", start)
        self._events = SummaryWriter(str(folder / "tensorboard"), purge_step=start + 1)

    def __enter__(self) -> RunLog:
        return self

    def __exit__(self, *_: object) -> None:
        if self._events:
            self._events.close()

    def write(self, kind: str, step: int, values: Mapping[str, float]) -> None:
        """Append one row, written out at once; all rows of a kind have the same columns."""
        if not self._events:
            return
        path = self._folder / f"{kind}.csv"
        head = "" if path.exists() else ",".join(["step", *values]) + "\n"
        row = ",".join([str(step), *map(repr, values.values())]) + "\n"
        with path.open("a") as file:
            file.write(head + row)
        for key, value in values.items():
            self._events.add_scalar(f"{kind}/{key}", value, step)
        self._events.flush()


def _truncate(path: Path, last: int) -> None:
    """Drop the rows after step ``last``, a row torn by a kill, and what a full disk left.

    What is neither costs a warning, since a part of the curve is gone for good.
    """
    if not path.exists():
        return
    text = path.read_bytes().decode(errors="replace")
    head, *rows = text.split("\n")[:-1] or [""]  # after the last line break: nothing, or a torn row
    steps = [_step_of(row, head) for row in rows]
    kept = [row for row, step in zip(rows, steps, strict=True) if step is not None and step <= last]
    if text.strip() and (None in steps or not head.startswith("step,")):
        warnings.warn(
            f"each row of a curve must be a step and its numbers; {path} has others, which are "
            "dropped. The disk may have been full; the training itself is as it was.",
            RuntimeWarning,
            stacklevel=4,
        )
    if kept:
        write_atomic(path, "".join(row + "\n" for row in [head, *kept]).encode())
    else:
        path.unlink()


def _step_of(row: str, head: str) -> int | None:
    """The step of a row; None where it has not a number for each name of ``head``."""
    try:
        step, *numbers = row.split(",")
        [float(number) for number in numbers]
        same = head.startswith("step,") and row.count(",") == head.count(",")
        return int(step) if same else None
    except ValueError:
        return None
