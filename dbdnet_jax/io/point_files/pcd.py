"""PCD, counted: what a file holds is what its head promises, or the file is refused.

Format: https://pointclouds.org/documentation/tutorials/pcd_file_format.html, with the liberties
that its writers take (no VIEWPOINT, no COUNT, COLUMNS for FIELDS, any case).
"""

import itertools
import struct
from pathlib import Path
from typing import BinaryIO, NamedTuple

import numpy as np
from jaxtyping import Float

from dbdnet_jax.io.point_files.columns import find_xyz
from dbdnet_jax.io.point_files.numbers import parse, table
from dbdnet_jax.io.point_files.record import AGAIN, CHUNK, FileFault, PointFile, drop_unmeasured

HEAD_BYTES = 65536
LZF_GROWTH = 132  # no LZF instruction of two bytes or more gives more bytes for each of its own


class Head(NamedTuple):
    """What a PCD promises: a record for each field, and how the rows are stored."""

    dtype: np.dtype
    points: int
    data: str
    xyz: tuple[str, str, str]


def read_pcd(file: BinaryIO, path: Path, seed: int) -> PointFile:
    """The coordinates of an ascii, binary or binary_compressed PCD; NaN rows dropped, counted."""
    head = _read_head(file)
    if head.data == "ascii":
        points = _read_ascii(file, head)
    elif head.data == "binary":
        points = _read_binary(file.read(), head)
    else:
        points = _read_compressed(file.read(), head)
    return drop_unmeasured(points)


def _read_head(file: BinaryIO) -> Head:
    entries: dict[str, list[str]] = {}
    while "DATA" not in entries:
        line = file.readline(HEAD_BYTES)
        if not line or file.tell() > HEAD_BYTES:
            raise FileFault(f"its head has no DATA line. {AGAIN}")
        key, *values = line.decode("latin-1").removeprefix("\xef\xbb\xbf").split() or ["#"]
        if not key.startswith("#"):
            entries[key.upper()] = values
    names = entries.get("FIELDS") or entries.get("COLUMNS")
    if not names:
        raise FileFault(f"its head has no FIELDS line. {AGAIN}")
    sizes, kinds = entries.get("SIZE", []), entries.get("TYPE", ["F"] * len(names))
    counts = entries.get("COUNT", ["1"] * len(names))
    if not len(names) == len(sizes) == len(kinds) == len(counts):
        raise FileFault(f"FIELDS, SIZE, TYPE and COUNT differ in length. {AGAIN}")
    width, height = _whole(entries, "WIDTH"), _whole(entries, "HEIGHT")
    points = _whole(entries, "POINTS")
    if points is None and width is not None:
        points = width * (1 if height is None else height)
    if points is None:
        raise FileFault(f"its head says neither POINTS nor WIDTH. {AGAIN}")
    if width is not None and width * (1 if height is None else height) != points:
        raise FileFault(f"WIDTH x HEIGHT is {width} x {height}, POINTS {points}. {AGAIN}")
    data = " ".join(entries["DATA"]).lower()
    if data not in ("ascii", "binary", "binary_compressed"):
        raise FileFault(f"DATA must be ascii, binary or binary_compressed; got {data!r}. {AGAIN}")
    chosen = find_xyz(names)
    if chosen is None or any(counts[i] != "1" for i in chosen):
        raise FileFault(f"it must have the fields x, y, z; it has {' '.join(names)!r}. {AGAIN}")
    fields = zip(kinds, sizes, counts, strict=True)
    dtype = np.dtype([(str(i), *_field(*field)) for i, field in enumerate(fields)])
    if dtype.itemsize > HEAD_BYTES:
        raise FileFault(f"a point of it has {dtype.itemsize} bytes. {AGAIN}")
    x, y, z = map(str, chosen)
    return Head(dtype, points, data, (x, y, z))


def _whole(entries: dict[str, list[str]], key: str) -> int | None:
    if key not in entries:
        return None
    text = " ".join(entries[key])
    if not (text.isascii() and text.isdigit() and len(text) < 16):
        raise FileFault(f"{key} must be a whole number; got {text[:40]!r}. {AGAIN}")
    return int(text)


def _field(kind: str, size: str, count: str) -> tuple[str, tuple[int]]:
    known = {"F": "248", "I": "1248", "U": "1248"}
    if size not in tuple(known.get(kind.upper(), "")) or not (count.isdigit() and len(count) < 6):
        raise FileFault(f"a field of TYPE {kind}, SIZE {size}, COUNT {count} is unknown. {AGAIN}")
    return f"<{kind.lower()}{size}", (int(count),)


def _read_ascii(file: BinaryIO, head: Head) -> Float[np.ndarray, "n 3"]:
    counts = [head.dtype[name].shape[0] for name in head.dtype.names or ()]
    width, offsets = sum(counts), np.cumsum([0, *counts])
    columns = [int(offsets[int(name)]) for name in head.xyz]
    parts, found = [np.empty((0, 3))], 0
    lines = (line.decode("latin-1") for line in file)
    lines = (line for line in lines if line.strip() and not line.lstrip().startswith("#"))
    while chunk := list(itertools.islice(lines, CHUNK)):
        values = table(chunk, width, None)
        if values is None:
            rows = (_row(line, width, found + i) for i, line in enumerate(chunk))
            values = np.array(list(rows))
        parts.append(values[:, columns])
        found += len(values)
        if found > head.points:
            break
    if found != head.points:
        more = "more than " if found > head.points else f"{found} of "
        raise FileFault(f"it holds {more}{head.points} rows. {AGAIN}")
    return np.concatenate(parts)


def _row(line: str, width: int, row: int) -> list[float]:
    numbers = [parse(cell) for cell in line.split()]
    if len(numbers) != width or None in numbers:
        raise FileFault(
            f"row {row} must have {width} numbers separated by blanks; got {line.strip()[:80]!r}. "
            "Write points for decimals and blanks between numbers."
        )
    return [number for number in numbers if number is not None]


def _read_binary(body: bytes, head: Head) -> Float[np.ndarray, "n 3"]:
    expected = head.points * head.dtype.itemsize
    tail = body[expected:]
    # Less than a point, and blank: the line end that some writers put there.
    if len(body) < expected or len(tail) >= head.dtype.itemsize or tail.strip(b"\0\r\n "):
        raise FileFault(
            f"its {head.points} points need {expected} bytes, and {len(body)} follow its head; "
            f"it is cut short or of other fields. {AGAIN}"
        )
    rows = np.frombuffer(body, head.dtype, head.points)
    return np.stack([rows[name][:, 0].astype(np.float64) for name in head.xyz], axis=1)


def _read_compressed(body: bytes, head: Head) -> Float[np.ndarray, "n 3"]:
    """Field after field (all x, then all y), the whole packed as LZF."""
    expected = head.points * head.dtype.itemsize
    packed, whole = struct.unpack_from("<II", body) if len(body) >= 8 else (0, 0)
    if whole != expected or len(body) < 8 + packed or body[8 + packed :].strip(b"\0\r\n "):
        raise FileFault(
            f"its {head.points} points need {expected} bytes; it promises {whole}, packed in "
            f"{packed}, and {max(len(body) - 8, 0)} follow. {AGAIN}"
        )
    if whole > LZF_GROWTH * packed:
        raise FileFault(f"{packed} bytes cannot unpack to {whole}. {AGAIN}")
    raw = unpack_lzf(memoryview(body)[8 : 8 + packed], whole)
    axes, start = {}, 0
    for name in head.dtype.names or ():
        base, (count,) = head.dtype[name].base, head.dtype[name].shape
        if name in head.xyz:
            axes[name] = np.frombuffer(raw, base, head.points, start).astype(np.float64)
        start += base.itemsize * count * head.points
    return np.stack([axes[name] for name in head.xyz], axis=1)


def unpack_lzf(packed: bytes | memoryview, size: int) -> bytes:
    """LZF (Lehmann): runs of up to 32 bytes as they are, or copies of up to 264 earlier ones.

    Raises:
      FileFault: damaged, or not of ``size`` bytes.
    """
    data, out, i = bytes(packed), bytearray(), 0
    try:
        while i < len(data):
            control = data[i]
            i += 1
            if control < 32:
                run = data[i : i + control + 1]
                if len(run) != control + 1:
                    raise IndexError
                out += run
                i += control + 1
            else:
                length = control >> 5
                if length == 7:
                    length += data[i]
                    i += 1
                start = len(out) - ((control & 31) << 8) - data[i] - 1
                i += 1
                length += 2
                if start < 0 or len(out) + length > size:
                    raise IndexError
                # A copy may reach into itself: then it repeats what it has just written.
                piece = out[start : start + length]
                out += (piece * (length // len(piece) + 1))[:length]
    except IndexError:
        raise FileFault(f"its compressed rows are damaged. {AGAIN}") from None
    if len(out) != size:
        raise FileFault(f"its compressed rows hold {len(out)} of {size} bytes. {AGAIN}")
    return bytes(out)
