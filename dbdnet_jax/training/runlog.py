"""The curves of a run: one CSV file for each kind of row, and TensorBoard events beside them."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from dbdnet_jax.io.files import write_atomic


class RunLog:
    """Rows of scalars by step, in ``folder/NAME.csv`` and ``folder/tensorboard``.

    Opened at the step a run goes on from, it drops the rows after it: those steps are done again,
    and the files end up as those of an unbroken run.
    """

    def __init__(self, folder: Path, start: int):
        from tensorboardX import SummaryWriter

        self._folder = folder
        for path in folder.glob("*.csv"):
            _truncate(path, start)
        self._events = SummaryWriter(str(folder / "tensorboard"), purge_step=start + 1)

    def __enter__(self) -> RunLog:
        return self

    def __exit__(self, *_: object) -> None:
        self._events.close()

    def write(self, name: str, step: int, values: Mapping[str, float]) -> None:
        """Append one row, written out at once; all rows of a name have the same columns."""
        path = self._folder / f"{name}.csv"
        head = "" if path.exists() else ",".join(["step", *values]) + "\n"
        row = ",".join([str(step), *map(repr, values.values())]) + "\n"
        with path.open("a") as file:
            file.write(head + row)
        for key, value in values.items():
            self._events.add_scalar(f"{name}/{key}", value, step)
        self._events.flush()


def _truncate(path: Path, last: int) -> None:
    """Drop the rows after step ``last``, and a row torn by a kill."""
    head, *rows = path.read_text().splitlines(keepends=True)
    kept = [row for row in rows if row.endswith("\n") and int(row.split(",")[0]) <= last]
    if kept:
        write_atomic(path, "".join([head, *kept]).encode())
    else:
        path.unlink()
