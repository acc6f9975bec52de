"""How a table of text is written: its separator, decimal mark, head and columns, or a refusal."""

import itertools
import re
from typing import NamedTuple

from dbdnet_jax.io.point_files.heads import named_columns, promised, require_table
from dbdnet_jax.io.point_files.lines import cells, uncommented
from dbdnet_jax.io.point_files.numbers import parse
from dbdnet_jax.io.point_files.record import FileFault

THOUSANDS = re.compile(r"[+-]?[1-9][0-9]{0,2}(?:,[0-9]{3})+")
WAYS = tuple(itertools.product(";\t,|", ".,"))
WAYS_OF_BLANKS = ((None, "."), (None, ","))
FIXED = 16  # rows with decimal points after which a row without any is no point


class Dialect(NamedTuple):
    """How the rows of a file are read."""

    separator: str | None  # None: blanks
    decimal: str
    width: int
    columns: list[int]
    named: bool
    first: int  # line of the first row, from 0
    promised: int  # rows that a head of one whole number promises; 0: none
    whole_first: bool  # the first row is of whole numbers and three or more columns
    quoted: str  # the head, for errors

    @property
    def strip(self) -> str:
        """What a line may end with that is no column."""
        return " \t\r\n" + (self.separator or "")


def find_dialect(lines: list[str]) -> Dialect:
    """The one way to read a file's first lines.

    Raises:
      FileFault: there is none, or more than one.
    """
    quoted = "its first lines are " + repr("".join(lines[:3])[:160])
    require_table(lines)
    numbered = [i for i, line in enumerate(lines) if _numbers(uncommented(line)) >= 3]
    if not numbered:
        raise FileFault(f"no line has three numbers; {quoted}. Write a line for each point.")
    # The rows are what the sample ends with; what differs before them is head.
    rows = [uncommented(lines[i]) for i in numbered[len(numbered) // 2 :]]
    separator, decimal = _find_way(rows, quoted)
    width = max(_width(row, separator) for row in rows)
    first = _first_row(lines, numbered, rows, separator, decimal)
    head = [line for line in lines[:first] if line.strip()]
    _check_head(head, width, separator, decimal)
    named = named_columns(head, rows, separator, width, quoted)
    columns = named or [0, 1, 2]
    start = uncommented(next(lines[i] for i in numbered if i >= first))
    _check_columns(rows, columns, separator, decimal, quoted)
    whole = [_is_whole(cells(start, separator)[i]) for i in columns]
    _check_commas(rows, separator, named is not None, quoted)
    if all(whole) and named is None and _all_decimal(rows, columns, separator):
        raise FileFault(
            f"its first row of numbers may be a head or a point; {quoted}. Remove it, begin it "
            "with #, or write it as the other rows."
        )
    return Dialect(
        separator, decimal, width, columns, named is not None, first,
        promised(head), all(whole), quoted,
    )  # fmt: skip


def _numbers(line: str) -> int:
    """How many numbers stand in a line, whatever separates them."""
    found = [x for x in re.split(r"[;\t| ]+", line.strip()) if x]
    counts = [sum(parse(x, mark) is not None for x in found) for mark in ".,"]
    by_comma = sum(parse(x) is not None for x in line.split(","))
    return max(*counts, by_comma)


def _width(line: str, separator: str | None) -> int:
    found = cells(line, separator)
    while found and not found[-1].strip():
        found.pop()
    return len(found)


def _first_row(
    lines: list[str], numbered: list[int], rows: list[str], separator: str | None, decimal: str
) -> int:
    """The line that the rows begin with: what stands above has numbers of another kind."""
    width = max(_width(row, separator) for row in rows)
    worded = parse(cells(rows[-1], separator)[0], decimal) is None
    for i in numbered[: len(numbered) // 2]:
        text = uncommented(lines[i])
        numbers = _all_numbers(text, separator, decimal)
        whole = all(map(_is_whole, text.split()))
        if _width(text, separator) < width and (whole or numbers):
            if not whole:
                raise FileFault(
                    f"line {i + 1} has other columns than the rows below it: "
                    f"{text.strip()[:80]!r}. Begin it with # if it is a head; else give every row "
                    "the same columns."
                )
        elif worded or parse(cells(text, separator)[0], decimal) is not None:
            return i
    return numbered[len(numbered) // 2]


def _check_head(head: list[str], width: int, separator: str | None, decimal: str) -> None:
    """Refuse a row that would pass for a head, a letter among its numbers."""
    for line in head:
        found = cells(uncommented(line), separator)
        numbers = [x for x in found if parse(x, decimal) is not None]
        if len(found) == width and len(numbers) > 1 and not all(map(_is_whole, numbers)):
            raise FileFault(
                f"the line {line.strip()[:80]!r} above its rows is one but for a cell that is no "
                "number. Correct it, or begin it with #."
            )


def _all_numbers(line: str, separator: str | None, decimal: str) -> bool:
    return all(parse(x, decimal) is not None for x in cells(line, separator) if x.strip())


def _is_whole(cell: str) -> bool:
    return cell.strip(" \t\"'\r\n").lstrip("+-").isdecimal()


def _all_decimal(rows: list[str], columns: list[int], separator: str | None) -> bool:
    rows = rows[1:] if len(rows) > 1 else rows
    found = [cells(row, separator) for row in rows]
    return len(rows) >= FIXED and all(
        len(row) > i and not _is_whole(row[i]) for row in found for i in columns
    )


def _find_way(rows: list[str], quoted: str) -> tuple[str | None, str]:
    """Separator and decimal mark by which every row has three numbers or more."""
    counts: dict[tuple[str | None, str], int] = {way: _reads(rows, *way) for way in WAYS}
    if max(counts.values()) < 3:
        counts = {way: _reads(rows, *way) for way in WAYS_OF_BLANKS}
    ways = [way for way, count in counts.items() if count >= 3]
    ways = sorted(ways, key=lambda way: -counts[way])  # stable: points before commas
    if len({separator for separator, _ in ways}) != 1:
        what = "numbers of its rows cannot be told apart" if not ways else "rows read in two ways"
        raise FileFault(
            f"{what}: {rows[-1].strip()[:80]!r}; {quoted}. Separate columns by blanks, tabs, "
            "semicolons or commas, and write decimals with points, without marks for thousands."
        )
    separator, decimal = ways[0]
    found = [x.strip(" \"'\r\n") for row in rows for x in cells(row, separator)]
    with_comma = [x for x in found if "," in x and parse(x, ",") is not None]
    if decimal == "," and all(THOUSANDS.fullmatch(x) for x in with_comma):
        raise FileFault(
            f"the commas of its rows may be decimal or of thousands: {rows[-1].strip()[:80]!r}; "
            f"{quoted}. Write decimals with points."
        )
    return separator, decimal


def _reads(rows: list[str], separator: str | None, decimal: str) -> int:
    """How many columns are numbers in every row, empty cells aside."""
    columns: set[int] | None = None
    marked: set[int] = set()
    for row in rows:
        found = cells(row, separator)
        if separator == "\t" and any(_numbers(x) > 1 for x in found):
            return 0  # tabs mixed with blanks
        numeric = {i for i, x in enumerate(found) if parse(x, decimal) is not None}
        columns = numeric if columns is None else columns & numeric
        marked |= {i for i in numeric if "," in found[i]}
    columns = columns or set()
    if decimal == "," and separator is None and len(columns & marked) < 3:
        return 0  # 1 234,5 5 678,9: blanks between thousands
    if decimal == "," and not marked:
        return 0
    return len(columns)


def _check_commas(rows: list[str], separator: str | None, named: bool, quoted: str) -> None:
    """Refuse 1,25,2,50,3,75: whole numbers in pairs of which the second look like decimals."""
    found = [[x.strip() for x in cells(row, separator)] for row in rows]
    if named or separator != "," or len(found[0]) % 2 or len(found[0]) < 6:
        return
    if not all(_is_whole(x) for row in found for x in row):
        return
    seconds = [x for row in found for x in row[1::2]]
    zeros = any(re.fullmatch(r"0[0-9]+", x) for x in seconds) or any(
        x == "-0" for row in found for x in row
    )
    even = len(set(map(len, seconds))) == 1
    if all(x.isdecimal() for x in seconds) and (zeros or even):
        raise FileFault(
            f"the commas of its rows may be decimal or between columns: "
            f"{rows[-1].strip()[:80]!r}; {quoted}. Write decimals with points."
        )


def _check_columns(
    rows: list[str], columns: list[int], separator: str | None, decimal: str, quoted: str
) -> None:
    for row in rows:
        found = cells(row, separator)
        for i in columns:
            if i < len(found) and found[i].strip() and parse(found[i], decimal) is None:
                raise FileFault(
                    f"column {i + 1} must hold coordinates; got {found[i].strip()[:40]!r}; "
                    f"{quoted}. Name the columns in a head line (label,x,y,z)."
                )
