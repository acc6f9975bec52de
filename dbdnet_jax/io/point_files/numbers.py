"""Numbers as programs write them: strict, with every program's way to say "no number"."""

import math
import re

import numpy as np
from jaxtyping import Float

NUMBER = re.compile(r"[+-]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eEdD][+-]?[0-9]+)?")
COMMA_NUMBER = re.compile(r"[+-]?(?:[0-9]+(?:,[0-9]+)?|,[0-9]+)(?:[eEdD][+-]?[0-9]+)?")
# C's NaN, with its payload; Microsoft's (1.#QNAN, 1.#IND, 1.#INF); R's; databases'.
NO_NUMBER = re.compile(
    r"[+-]?(?:s?nan(?:\(.*\))?|inf(?:inity)?|1\.#\w+)|n/?a|null|none", re.IGNORECASE
)


def parse(cell: str, decimal: str = ".") -> float | None:
    """The number a cell holds, NaN where it says that there is none; None for anything else."""
    cell = cell.strip(" \t\"'\r\n")
    pattern = NUMBER if decimal == "." else COMMA_NUMBER
    if pattern.fullmatch(cell):
        return float(cell.replace(",", ".").replace("d", "e").replace("D", "e"))
    return math.nan if NO_NUMBER.fullmatch(cell) else None


def table(lines: list[str], width: int, separator: str | None) -> Float[np.ndarray, "n w"] | None:
    """Lines of exactly ``width`` plain numbers; None if one is not: then look at each alone."""
    if not any(line.strip() for line in lines):
        return np.empty((0, width))
    try:
        found = np.loadtxt(lines, comments=None, delimiter=separator, ndmin=2)
    except ValueError:
        return None
    return found if found.shape[1] == width else None
