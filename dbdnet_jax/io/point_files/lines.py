"""A line of text without its comment, and its cells."""

import csv
import re

COMMENTS = ("#", "//", "%", "!", "\x1a")  # the last: how DOS ends a file


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
