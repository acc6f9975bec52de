"""Rigid transforms from files: what trackers, viewers and people write for one 4x4 matrix."""

import io
import json
import re
from pathlib import Path
from typing import Any

import numpy as np

_LARGEST = 100_000  # bytes; sixteen numbers and what is said about them take less


def read_transform(path: Path) -> np.ndarray:
    """The numbers of a transform's file, unchecked: ``.npy``, ``.json`` or text.

    JSON holds a list, or an object with a list ``transform``. Text may have comments (``#`` or
    ``//``), empty lines, a byte order mark (UTF-8 or UTF-16), brackets, and commas, semicolons,
    tabs or spaces between numbers; sixteen in any lines are taken row by row. Commas are no decimal
    points.

    Raises:
      ValueError: another or a damaged file.
      OSError: it cannot be opened.
    """
    if path.is_dir():
        raise IsADirectoryError(f"a transform's file must be a file; {path} is a folder.")
    try:
        with open(path, "rb") as file:
            data = file.read(_LARGEST + 1)
        if len(data) > _LARGEST:
            raise ValueError(f"it has more than {_LARGEST} bytes")
        if data[:6] == b"\x93NUMPY":
            return np.load(io.BytesIO(data), allow_pickle=False)
        text = _decode(data)
        if path.suffix.lower() == ".json":
            held = json.loads(text)
            return np.array(held["transform"] if isinstance(held, dict) else held, np.float64)
        return _parse(text)
    except (ValueError, KeyError, TypeError, EOFError, RecursionError, MemoryError) as error:
        raise ValueError(
            f"a transform's file must hold 4x4 numbers; {path}: {error}. Write four rows of four."
        ) from error


def _decode(data: bytes) -> str:
    if data[:2] in (b"\xff\xfe", b"\xfe\xff"):
        return data.decode("utf-16").lstrip("\ufeff")
    return data.decode("utf-8", errors="replace").lstrip("\ufeff")


def _parse(text: str) -> np.ndarray:
    lines = [re.sub(r"(#|//).*", "", line).strip() for line in text.splitlines()]
    joined = "\n".join(line for line in lines if line)
    joined = re.sub(r"^\w+\s*=|(np\.|numpy\.)?(array|matrix)\s*\(|dtype=[\w.]+", " ", joined)
    cells: list[list[float]] = [
        [float(cell) for cell in re.split(r"[\s,;\[\]()]+", line) if cell]
        for line in joined.splitlines()
    ]
    rows: Any = [row for row in cells if row]
    if sum(map(len, rows)) == 16 and [len(row) for row in rows] != [4] * 4:
        rows = np.concatenate(rows).reshape(4, 4)
    return np.array(rows, np.float64)
