"""Points in rows of text: XYZ, ASC, PTS, PTX, TXT, CSV. What is ambiguous is refused, quoted."""

import codecs
import io
import itertools
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

import numpy as np
from jaxtyping import Float

from dbdnet_jax.io.point_files import ptx
from dbdnet_jax.io.point_files.dialect import Dialect, find_dialect
from dbdnet_jax.io.point_files.lines import cells, uncommented
from dbdnet_jax.io.point_files.numbers import parse, table
from dbdnet_jax.io.point_files.record import CHUNK, FileFault, PointFile, drop_unmeasured

SAMPLE = 400  # lines that decide how the rest is read
SAMPLE_BYTES = 1 << 20


def read_text(file: BinaryIO, path: Path, seed: int) -> PointFile:
    """Named columns, or the first three; heads and comments skipped; rows with NaN dropped."""
    encoding = find_encoding(file.read(4096))
    file.seek(0)
    stream = io.TextIOWrapper(file, encoding=encoding, errors="replace", newline=None)
    try:
        head = list(itertools.islice(_lines(stream), SAMPLE))
        lines = itertools.chain(head, _lines(stream))
        if ptx.is_ptx(head):
            return ptx.read_ptx(lines)
        dialect = find_dialect(head)
        points, rows = _read_rows(itertools.islice(lines, dialect.first, None), dialect)
    finally:
        stream.detach()
    promised = dialect.promised + rows.promised
    if dialect.promised and promised != rows.found:
        raise FileFault(
            f"its head promises {promised} rows, and it holds {rows.found}: "
            f"{dialect.quoted}. Correct that line, or export it again."
        )
    _check_first_column(points, dialect)
    return drop_unmeasured(points)


def find_encoding(start: bytes) -> str:
    """By the byte order mark, by zeros in every other byte, else UTF-8 or Latin-1."""
    for mark, name in (
        (b"\xef\xbb\xbf", "utf-8-sig"),
        (b"\xff\xfe\0\0", "utf-32"),
        (b"\0\0\xfe\xff", "utf-32"),
        (b"\xff\xfe", "utf-16"),
        (b"\xfe\xff", "utf-16"),
    ):
        if start.startswith(mark):
            return name
    if b"\0" in start:
        even, odd = start[::2].count(0), start[1::2].count(0)
        if len(start) > 8 and max(even, odd) > 0.4 * len(start) and min(even, odd) == 0:
            return "utf-16-le" if odd else "utf-16-be"
        raise FileFault(
            "it is no text, no line has three numbers. Name it by its kind, or export it as text."
        )
    try:
        codecs.getincrementaldecoder("utf-8")().decode(start)
    except UnicodeDecodeError:
        return "latin-1"
    return "utf-8"


def _lines(stream: io.TextIOWrapper) -> Iterator[str]:
    """Lines of bounded length: a file without line ends is no table."""
    while line := stream.readline(SAMPLE_BYTES):
        if len(line) == SAMPLE_BYTES:
            raise FileFault("a line is longer than a megabyte. Write a line for each point.")
        yield line if line.isascii() else line.replace("\u2212", "-")  # typographers' minus


class _Rows:
    """What is counted on the way through a file."""

    def __init__(self, dialect: Dialect):
        self.dialect = dialect
        self.line = dialect.first
        self.found = 0
        self.promised = 0

    def parse(self, lines: list[str]) -> Float[np.ndarray, "n 3"]:
        """The coordinates of some lines: all at once where they are plain, else one by one."""
        dialect = self.dialect
        plain = [uncommented(line).rstrip(dialect.strip) for line in lines]
        if dialect.decimal == "," and not any("." in line for line in plain):
            plain = [line.replace(",", ".") for line in plain]
        values = table(plain, dialect.width, dialect.separator)
        if values is not None:
            self.line += len(lines)
            self.found += len(values)
            return values[:, dialect.columns]
        rows = []
        for line in lines:
            self.line += 1
            row = self._row(uncommented(line))
            if row is not None:
                rows.append(row)
        self.found += len(rows)
        return np.array(rows).reshape(-1, 3)

    def _row(self, line: str) -> list[float] | None:
        dialect = self.dialect
        found = cells(line, dialect.separator)
        while found and not found[-1].strip():
            found.pop()
        if not found:
            return None
        if dialect.promised and len(found) == 1 and found[0].isdecimal():
            self.promised += int(found[0])  # the next scan's count, in PTS
            return None
        # Only rows with marks between columns show that a column is there and empty.
        short = len(found) < dialect.width and (
            dialect.separator is None
            or line.count(dialect.separator) < dialect.width - 1
            and '"' not in line
        )
        extra = found[dialect.width :]
        words = any(parse(x, dialect.decimal) is None for x in found[3:])
        if short and not (words and len(found) > max(dialect.columns)) or (extra and not words):
            raise self._fault(f"{dialect.width} columns, as the rows before; it has {len(found)}")
        found += [""] * (dialect.width - len(found))
        row = []
        for i in dialect.columns:
            empty = dialect.separator is not None and not found[i].strip()
            number = np.nan if empty else parse(found[i], dialect.decimal)
            if number is None:
                raise self._fault(f"numbers as coordinates; got {found[i].strip()[:40]!r}")
            row.append(number)
        return row

    def _fault(self, rule: str) -> FileFault:
        return FileFault(
            f"line {self.line} must have {rule} ({self.dialect.quoted}). "
            "Correct or remove that line."
        )


def _read_rows(lines: Iterator[str], dialect: Dialect) -> tuple[Float[np.ndarray, "n 3"], _Rows]:
    rows, parts = _Rows(dialect), [np.empty((0, 3))]
    while chunk := list(itertools.islice(lines, CHUNK)):
        parts.append(rows.parse(chunk))
    return np.concatenate(parts), rows


def _check_first_column(points: Float[np.ndarray, "n 3"], dialect: Dialect) -> None:
    """Numbers of rows, and a head that looks like a point, are no coordinates."""
    first = points[:, 0]
    if dialect.named or len(first) < 2:
        return
    if dialect.width > 3 and np.array_equal(first, first[0] + np.arange(len(first))):
        raise FileFault(
            f"its first column counts the rows and no head names the columns: {dialect.quoted}. "
            "Name the columns (id,x,y,z), or remove that one."
        )
    if len(first) - 1 in points[0] and dialect.whole_first:
        raise FileFault(
            f"its first row may be a head that counts the {len(first) - 1} others: "
            f"{dialect.quoted}. Remove it, or begin it with #."
        )
