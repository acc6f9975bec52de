"""What the lines above a table of text say: its columns' names, how many rows follow, or prose."""

import re

from dbdnet_jax.io.point_files.check import MIN_POINTS
from dbdnet_jax.io.point_files.columns import find_xyz
from dbdnet_jax.io.point_files.lines import COMMENTS, cells
from dbdnet_jax.io.point_files.numbers import parse
from dbdnet_jax.io.point_files.record import FileFault

KEYWORD = re.compile(
    r"^\s*(?:file\s+)?(?:fields?|columns?|names?|header|format|variables|data)\b\s*[:=]?\s*", re.I
)
PROSE = set(
    """a an and are as at by column columns exported exporter follow follows for from here in is
    made now of on our per scanned the then these this to units was we were with written""".split()
)

# First words of files whose rows are no points, though there may be three numbers in them.
NO_TABLES = {"ncols": "a raster of heights", "dsaa": "a raster of heights", "ply": "a PLY"}


def require_table(lines: list[str]) -> None:
    """Refuse what begins as files of other kinds do."""
    words = next((line.split() for line in lines if line.strip()), [""])
    kind = NO_TABLES.get(words[0].lower())
    if kind and len(words) < 3:
        raise FileFault(f"it is {kind}, by its first line. Export it as x y z, or name it so.")


def promised(head: list[str]) -> int:
    """The count in a head that is one whole number; others are comments, sizes, versions."""
    counts = [line.strip() for line in head if line.strip().isdecimal()]
    count = int(counts[0]) if len(counts) == 1 and len(counts[0]) < 16 else 0
    return count if count >= MIN_POINTS else 0  # below: a version, a number of the scan


def named_columns(
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
