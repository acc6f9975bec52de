"""The rows of a PLY's elements: all at once where they are alike, through plyfile where not."""

import io
import itertools
import re
from typing import NamedTuple

import numpy as np

from dbdnet_jax.io.point_files.numbers import table
from dbdnet_jax.io.point_files.record import AGAIN, CHUNK, FileFault

ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">"}
_NAMES = ("char i1", "uchar u1", "short i2", "ushort u2", "int i4", "uint u4")
_SIZED = ("int8 i1", "uint8 u1", "int16 i2", "uint16 u2", "int32 i4", "uint32 u4")
_WIDE = ("int64 i8", "uint64 u8", "float f4", "float32 f4", "double f8", "float64 f8")
TYPES = dict(entry.split() for entry in (*_NAMES, *_SIZED, *_WIDE))
TYPES |= {code: code for code in TYPES.values()}
TEXT = b"0123456789+-.eEnaNifI \t\r\n"
LOOKED_AT = 4096  # bytes of binary rows: of so many none but text is made of these alone

Columns = dict[str, np.ndarray]  # (n,) a property, (n, k) lists of one length, else n objects


class Element(NamedTuple):
    """One kind of row that a PLY holds; a property is its types and, last, its name."""

    name: str
    count: int  # type: ignore[assignment]  # not tuple.count
    properties: tuple[tuple[str, ...], ...]


def read_rows(kind: str, elements: list[Element], body: bytes) -> tuple[list[Columns], bytes]:
    """The columns of every element, and what follows their rows.

    Raises:
      FileFault: rows are missing, malformed or not of the kind that the head says.
    """
    if kind == "ascii":
        body = _tidy(body)
    elif kind in ORDERS and len(body) > 64 and not body[:LOOKED_AT].translate(None, TEXT):
        raise FileFault(f"its head says {kind}, and its rows are text. {AGAIN}")
    found, start = [], 0
    for element in elements:
        at_once = _alike_in_text if kind == "ascii" else _alike_in_bytes
        columns, end = at_once(element, body, start, ORDERS.get(kind, ""))
        if columns is None:
            columns, end = _each(kind, element, body, start)
        found.append(columns)
        start = end
    return found, body[start:]


def _tidy(text: bytes) -> bytes:
    """Without blank lines, line ends of one kind, and "no number" as C writes it."""
    if b"\n" not in text:
        text = text.replace(b"\r", b"\n")
    if b"(" in text or b"#" in text:
        text = re.sub(rb"(?i)\b(?:nan\(\w*\)|1\.#\w+)", b"nan", text)
    return re.sub(rb"(?m)^[ \t\r]*\n", b"", text)


def _alike_in_bytes(
    element: Element, body: bytes, start: int, order: str
) -> tuple[Columns | None, int]:
    """Columns of rows whose lists are as long as the first row's, and where they end."""
    fields: list[tuple] = []
    lengths: dict[str, int] = {}
    place = start
    for *types, name in element.properties:
        if not order or not set(types) - {"list"} <= set(TYPES):
            return None, start
        codes = [order + TYPES[x] for x in types if x != "list"]
        if len(codes) == 2:
            size = np.dtype(codes[0]).itemsize
            first = np.frombuffer(body[place : place + size], codes[0])
            if not len(first) or not 0 <= first[0] <= len(body):
                return None, start
            lengths[f"{name} length"] = int(first[0])
            fields.append((f"{name} length", codes[0]))
            fields.append((name, codes[1], (int(first[0]),)))
        else:
            fields.append((name, codes[0]))
        place = start + np.dtype(fields).itemsize
    end = start + element.count * np.dtype(fields).itemsize
    if end > len(body):
        return None, start
    rows = np.frombuffer(body, fields, element.count, start)
    if any((rows[name] != length).any() for name, length in lengths.items()):
        return None, start
    return {x[-1]: rows[x[-1]] for x in element.properties}, end


def _alike_in_text(
    element: Element, body: bytes, start: int, order: str
) -> tuple[Columns | None, int]:
    """Columns of lines whose lists are as long as the first line's, and where they end."""
    stream = io.BytesIO(body)
    stream.seek(start)
    words = stream.readline().split()
    stream.seek(start)
    places: dict[str, slice | int] = {}
    lengths: dict[int, int] = {}  # by column
    width = 0
    for *types, name in element.properties:
        if types[0] == "list":
            if not (len(words) > width and words[width].isdigit()):
                return None, start
            length = lengths[width] = int(words[width])
            places[name] = slice(width + 1, width + 1 + length)
            width += 1 + length
        else:
            places[name] = width
            width += 1
    parts, found = [np.empty((0, width))], 0
    while lines := list(itertools.islice(stream, min(CHUNK, element.count - found))):
        values = table([line.decode("latin-1") for line in lines], width, None)
        if values is None or len(values) != len(lines):
            return None, start
        if any((values[:, at] != length).any() for at, length in lengths.items()):
            return None, start
        parts.append(values)
        found += len(lines)
    if found < element.count:
        return None, start
    whole = np.concatenate(parts)
    return {name: whole[:, place] for name, place in places.items()}, stream.tell()


def _each(kind: str, element: Element, body: bytes, start: int) -> tuple[Columns, int]:
    """Columns of rows that vary in length, and where they end; or what is wrong with them."""
    from plyfile import PlyData, PlyElementParseError

    name, count, properties = element
    head = f"ply\nformat {kind} 1.0\nelement {name} {count}\n"
    head += "".join(f"property {' '.join(words)}\n" for words in properties) + "end_header\n"
    if kind == "ascii":  # plyfile reads further than it says
        stream = io.BytesIO(body)
        stream.seek(start)
        rows = b"".join(itertools.islice(stream, count))
        used = start + len(rows)
    else:
        rows, used = body[start:], None
    file = io.BytesIO(head.encode() + rows)
    try:
        data = PlyData.read(file)[name].data
    except PlyElementParseError as error:
        place = f", row {error.row}" if error.row is not None else ""
        raise FileFault(
            f"its {count} rows of {name} are not all there: {error.message}{place} of {count}. "
            f"{AGAIN}"
        ) from error
    if used is None:
        used = start + file.tell() - len(head)
    return {words[-1]: data[words[-1]] for words in properties}, used
