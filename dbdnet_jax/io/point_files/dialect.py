"""How a table of text is written: its separator, decimal mark, head and columns, or a refusal."""

import csv
import re
from typing import NamedTuple

from dbdnet_jax.io.point_files.columns import find_xyz
from dbdnet_jax.io.point_files.numbers import parse
from dbdnet_jax.io.point_files.record import FileFault

COMMENTS = ("#", "//", "%", "!")
KEYWORD = re.compile(
    r"^\s*(?:file\s+)?(?:fields?|columns?|names?|header|format|variables|data)\b\s*[:=]?\s*", re.I
)
PROSE = set(
    """a an and are as at by column columns exported exporter follow follows for from here in is
    made now of on our per scanned the then these this to units was we were with written""".split()
)
THOUSANDS = re.compile(r"[+-]?[1-9][0-9]{0,2}(?:,[0-9]{3})+")
WAYS = ((";", "."), (";", ","), ("\t", "."), ("\t", ","), (",", "."), ("|", "."), ("|", ","))
WAYS_OF_BLANKS = ((None, "."), (None, ","))
FEWEST = 16  # points of a cloud
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


def uncommented(line: str) -> str:
    """A line without a comment at its end or its whole."""
    text = line.lstrip("\ufeff \t")
    if text.startswith(COMMENTS):
        return ""
    if "#" in line and '"' not in line:
        line = re.split(r"(?<!1\.)#", line, maxsplit=1)[0]  # 1.#QNAN is no comment
    if "//" in line and '"' not in line:
        line = line.split("//", 1)[0]
    return line


def cells(line: str, separator: str | None) -> list[str]:
    """The cells of a row; a separator in quotes separates nothing."""
    if separator is None:
        return line.split()
    if '"' in line:
        return next(csv.reader([line.strip("\r\n")], delimiter=separator, skipinitialspace=True))
    return line.strip("\r\n").split(separator)


def find_dialect(lines: list[str]) -> Dialect:
    """The one way to read a file's first lines.

    Raises:
      FileFault: there is none, or more than one.
    """
    quoted = "its first lines are " + repr("".join(lines[:3])[:160])
    numbered = [i for i, line in enumerate(lines) if _numbers(uncommented(line)) >= 3]
    if not numbered:
        raise FileFault(f"no line has three numbers; {quoted}. Write a line for each point.")
    # The rows are what the sample ends with; what differs before them is head.
    rows = [uncommented(lines[i]) for i in numbered[len(numbered) // 2 :]]
    separator, decimal = _find_way(rows, quoted)
    width = max(_width(row, separator) for row in rows)
    first = _first_row(lines, numbered, rows, separator, decimal)
    head = [line for line in lines[:first] if line.strip()]
    named = _named_columns(head, rows, separator, width, quoted)
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
        _promised(head), all(whole), quoted,
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
                    f"{text.strip()[:80]!r}. Remove it, or begin it with #."
                )
        elif worded or parse(cells(text, separator)[0], decimal) is not None:
            return i
    return numbered[len(numbered) // 2]


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


def _promised(head: list[str]) -> int:
    """The count in a head that is one whole number; others are comments, sizes, versions."""
    counts = [line.strip() for line in head if line.strip().isdecimal()]
    count = int(counts[0]) if len(counts) == 1 and len(counts[0]) < 16 else 0
    return count if count >= FEWEST else 0  # below: a version, a number of the scan


def _named_columns(
    head: list[str], rows: list[str], separator: str | None, width: int, quoted: str
) -> list[int] | None:
    """Where a head says that x, y and z stand; None if it does not say."""
    found: set[tuple[int, int, int]] = set()
    unknown = ""
    for line in head:
        comment = line.lstrip("\ufeff \t").startswith(COMMENTS)
        text = line.lstrip("\ufeff \t").lstrip("#/%! ").strip("\r\n")
        for names in _readings(text, separator, width):
            if (comment or separator is None) and _is_prose(names):
                continue
            try:
                xyz = find_xyz(names)
            except ValueError as error:
                raise FileFault(str(error)) from None
            if xyz is not None and len(names) == width:
                found.add(xyz)
            elif xyz is not None and not comment and (separator or xyz != (0, 1, 2)):
                raise FileFault(
                    f"its head names {len(names)} columns and its rows have {width}; {quoted}. "
                    "Name every column."
                )
            elif xyz is None and len(names) == width > 3 and (separator or not comment):
                unknown = unknown or line.strip()[:80]
            if xyz == (0, 1, 2) and width == len(names) + 1 and _counts(rows, separator):
                raise FileFault(
                    f"its head names {len(names)} columns, its rows have {width} and begin with "
                    f"their number; {quoted}. Name every column."
                )
    if len(found) > 1:
        raise FileFault(f"its heads name different columns; {quoted}. Keep one of them.")
    if not found and unknown and not _is_units(unknown):
        raise FileFault(
            f"none of its columns is named x, y, z: {unknown!r}. Name these three columns."
        )
    return list(found.pop()) if found else None


def _readings(text: str, separator: str | None, width: int) -> list[list[str]]:
    """A head's names, with and without a word before them (FIELDS, columns:)."""
    marks = [separator] if separator and separator in text else [None]
    if separator is None:
        marks = [mark for mark in (";", "\t", ",", "|") if mark in text] or [None]
    out = []
    for body in dict.fromkeys((KEYWORD.sub("", text), text)):
        names = [re.sub(r"^\d+\s*[:.)=]\s*", "", x.strip(" \"'")) for x in cells(body, marks[0])]
        while len(names) > width and not names[-1]:
            names.pop()
        if any(x.strip() for x in names):
            out.append(names)
    exact = [names for names in out if len(names) == width]
    return exact[:1] or out[:1]


def _is_prose(names: list[str]) -> bool:
    return bool(PROSE.intersection(x.lower().strip(".,:") for x in names))


def _is_units(line: str) -> bool:
    return not set(re.findall(r"[a-z]+", line.lower())) - {"m", "mm", "cm", "km", "ft", "in"}


def _counts(rows: list[str], separator: str | None) -> bool:
    """Whether the first column of all rows goes up by one."""
    first = [parse(cells(row, separator)[0]) for row in rows]
    steps = zip([None, *first], first, strict=False)
    return all(b is not None and (a is None or b - a == 1) for a, b in steps)
