"""A file of results, a line of JSON for each pair or Parquet, from which a batch goes on.

Nothing can be added to a Parquet file, and one that was cut short is lost. So lines are written
while a batch runs, into a file beside it, and put into the Parquet file when it ends.
"""

import contextlib
import json
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

from dbdnet_jax.cli.answers import as_line
from dbdnet_jax.cli.jobs import Job
from dbdnet_jax.cli.parquet import PARQUET, lines_file, load_pyarrow, read_lines, write_lines


class Results(NamedTuple):
    """A file to append to, the options that its answers have, and which pairs have one.

    ``table`` is the Parquet file that they go to in the end, if there is to be one.
    """

    path: Path
    options: dict[str, Any]
    valid: dict[tuple[str, str, str], bool]
    table: Path | None


def open_results(path: Path, options: dict[str, Any]) -> Results:
    """A new file of results, or what stands in the one that is there.

    A last line that was cut short is dropped: its pair is not done.

    Raises:
      ValueError: it is no file of results, or one of other options.
      OSError: it cannot be read or written.
      MissingExtraError: a library is missing for Parquet.
    """
    options = json.loads(json.dumps(options))
    table, valid = None, {}
    if path.suffix.lower() == PARQUET:
        load_pyarrow()
        table = path
        if path.exists():  # refused before there is a file beside it
            valid = _verdicts(path, read_lines(path), options)
    path = lines_file(path)
    valid |= _verdicts(path, _whole_lines(path), options)
    return Results(path, options, valid, table)


def _whole_lines(path: Path) -> list[bytes]:
    """The lines of a file that can be written; it is made, or a line that was cut short dropped."""
    with path.open("ab+") as file:
        file.seek(0)
        lines = file.read().splitlines(keepends=True)
        if lines and not lines[-1].endswith(b"\n"):
            cut = lines.pop()
            if lines or cut.startswith(b"{"):
                file.truncate(sum(map(len, lines)))
            else:
                lines.append(cut)
    return lines


def _verdicts(
    path: Path, lines: list[bytes], options: dict[str, Any]
) -> dict[tuple[str, str, str], bool]:
    """Whether the answer of each pair is valid, of those that have one."""
    valid = {}
    for number, line in enumerate(lines, 1):
        try:
            record = json.loads(line)
            held = record["options"]
            key = record["pair"], record["source"], record["target"]
        except (ValueError, TypeError, KeyError) as error:
            raise ValueError(
                f"results must be lines of JSON that an earlier run wrote; {path}:{number} is "
                f"{line[:60]!r}. Name another file."
            ) from error
        if held != options:
            other = next(x for x in options if held.get(x) != options[x])
            raise ValueError(
                f"all results of a file must have the same options; those in {path} have "
                f"{other} {held.get(other)!r}, not {options[other]!r}. Name another file."
            )
        if "failure" not in record:
            valid[key] = record["valid"]
    return valid


def find_done(results: Results, job: Job) -> bool | None:
    """Whether the answer of a pair is valid; None where there is none, or not all of its files."""
    key = job.pair.name, str(job.pair.source), str(job.pair.target)
    return results.valid.get(key) if all(path.exists() for path in job.outputs) else None


def append(results: Results, record: dict[str, Any]) -> None:
    """Write a record as a line that stays, whatever happens afterwards."""
    with results.path.open("a") as file:
        file.write(as_line(record | {"options": results.options}) + "\n")
        file.flush()
        os.fsync(file.fileno())


@contextlib.contextmanager
def finished(results: Results) -> Iterator[None]:
    """On leaving, Ctrl-C included, the lines go to the Parquet file, if there is to be one."""
    try:
        yield
    finally:
        if results.table is not None:
            _finish(results, results.table)


def _finish(results: Results, table: Path) -> None:
    new = results.path.read_bytes().splitlines(keepends=True)
    if new:
        before = read_lines(table) if table.exists() else []
        # The same ones twice, where a kill came before they were gone.
        write_lines(table, list(dict.fromkeys([*before, *new])))
    results.path.unlink()
