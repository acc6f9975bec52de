"""PTX (Leica Cyclone): scans one after another, each with its size and its pose."""

import itertools
from collections.abc import Iterator

import numpy as np
from jaxtyping import Float

from dbdnet_jax.io.point_files.numbers import parse, table
from dbdnet_jax.io.point_files.record import AGAIN, CHUNK, FileFault, PointFile, drop_unmeasured

HEAD = (1, 1, 3, 3, 3, 3, 4, 4, 4, 4)  # numbers in the lines before a scan's rows


def is_ptx(lines: list[str]) -> bool:
    """Whether lines begin as PTX does, whatever the file is called."""
    rows = [line.split() for line in lines[: len(HEAD)]]
    return tuple(map(len, rows)) == HEAD and all(parse(x) is not None for row in rows for x in row)


def read_ptx(lines: Iterator[str]) -> PointFile:
    """All scans of a file in their common frame; rows at 0 0 0, no returns, left out, counted."""
    scans, empty = [], 0
    while head := list(itertools.islice(lines, len(HEAD))):
        if not any(line.strip() for line in head):
            break
        if not is_ptx(head):
            raise FileFault(f"a scan begins with {head[0].strip()[:60]!r}, not its size. {AGAIN}")
        columns, rows = (parse(line) or 0 for line in head[:2])
        if not (columns % 1 == rows % 1 == 0 <= columns * rows < 1e12):
            raise FileFault(f"a scan's size is {columns:g} x {rows:g}. {AGAIN}")
        points = _rows(lines, int(columns * rows))
        seen = points.any(axis=1)
        empty += len(points) - int(seen.sum())
        # Row vectors, translation in the last row: world = [point 1] @ matrix.
        matrix = np.array([[parse(x) for x in line.split()] for line in head[6:]], float)
        scans.append(points[seen] @ matrix[:3, :3] + matrix[3, :3])
    found = drop_unmeasured(np.concatenate(scans) if scans else np.empty((0, 3)))
    notes = (f"{empty} rows at 0 0 0 are no returns and were left out",) if empty else ()
    return PointFile(found.points, (*notes, *found.notes))


def _rows(lines: Iterator[str], count: int) -> Float[np.ndarray, "n 3"]:
    parts, found = [np.empty((0, 3))], 0
    while found < count:
        chunk = list(itertools.islice(lines, min(CHUNK, count - found)))
        if not chunk:
            raise FileFault(f"a scan holds {found} of {count} rows. {AGAIN}")
        values = table(chunk, len(chunk[0].split()), None)
        if values is None or len(values) != len(chunk) or values.shape[1] < 3:
            values = np.array([_row(line) for line in chunk])
        parts.append(values[:, :3])
        found += len(values)
    return np.concatenate(parts)


def _row(line: str) -> list[float]:
    numbers = [parse(cell) for cell in line.split()[:3]]
    if len(numbers) < 3 or None in numbers:
        raise FileFault(f"a row must begin with x y z; got {line.strip()[:60]!r}. {AGAIN}")
    return [number for number in numbers if number is not None]
