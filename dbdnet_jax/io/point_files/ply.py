"""PLY: its head, which programs write with many liberties, its vertices and its faces."""

import re
from pathlib import Path
from typing import BinaryIO

import numpy as np
from jaxtyping import Int

from dbdnet_jax.io.point_files.columns import find_xyz
from dbdnet_jax.io.point_files.ply_rows import Columns, Element, read_rows
from dbdnet_jax.io.point_files.record import AGAIN, FileFault, PointFile
from dbdnet_jax.io.point_files.surface import sample, triangles

HEAD_BYTES = 1 << 20
END = re.compile(rb"(?i)(?:^|[\r\n])[ \t]*end_header[ \t]*(\r\n|\n|\r|$)")
FACES = ("vertex_indices", "vertex_index")
SPARE = 6  # bytes after all rows: of less no row is made


def read_ply(file: BinaryIO, path: Path, seed: int) -> PointFile:
    """Vertices of a cloud, or points on a mesh's polygons or strips of triangles."""
    data = file.read()
    kind, elements, body = _read_head(data)
    names = [element.name for element in elements]
    if "vertex" not in names:
        raise FileFault(f"it must have an element vertex; it has {names}. {AGAIN}")
    vertex = elements[names.index("vertex")]
    surface = next((n for n in ("face", "tristrips") if n in names), None)
    if surface and not elements[names.index(surface)].count:
        surface = None
    # What stands behind is not looked at: grids and cells are slow to read, and no points.
    needed = max(names.index(n) for n in ("vertex", surface) if n) + 1
    scalars = [x[-1] for x in vertex.properties if x[0] != "list"]
    xyz = find_xyz(scalars)
    if xyz is None:
        raise FileFault(f"its vertices must have x, y, z; they have {scalars}. {AGAIN}")
    found, rest = read_rows(kind, elements[:needed], body)
    rows = found[names.index("vertex")]
    vertices = np.stack([rows[scalars[i]].astype(np.float64) for i in xyz], axis=1)
    faces = np.empty((0, 3), np.int64)
    if surface:
        faces = _faces(found[names.index(surface)], elements[names.index(surface)])
    points, notes = sample(vertices, faces, seed)
    if needed == len(elements) and len(rest.strip(b"\0\r\n\t ")) >= SPARE:
        count = elements[-1].count
        notes = (f"{len(rest)} bytes after its {count} rows of {names[-1]} were not read", *notes)
    return PointFile(points, notes)


def _read_head(data: bytes) -> tuple[str, list[Element], bytes]:
    """The format, the elements and what follows; comments, blank lines and case do not matter."""
    start = data[:HEAD_BYTES].removeprefix(b"\xef\xbb\xbf")
    if start[:3].lower() != b"ply":
        raise FileFault(f"Not a ply file: it begins with {start[:12]!r}. Name it by its kind.")
    end = END.search(start)
    if end is None:
        raise FileFault(f"its head has no end_header. {AGAIN}")
    after = len(data) - len(data.removeprefix(b"\xef\xbb\xbf")) + end.end()
    kind, elements = "", []
    for line in re.split(r"[\r\n]+", start[3 : end.start()].decode("latin-1")):
        match line.lower().split():
            case ["format", kind, _]:
                pass
            case ["element", name, count] if count.isdecimal() and len(count) < 16:
                elements.append(Element(name, int(count), ()))
            case ["property", *words] if elements and len(words) in (2, 4):
                last = elements.pop()
                elements.append(last._replace(properties=(*last.properties, tuple(words))))
            case [] | ["comment", *_] | ["obj_info", *_]:
                pass
            case _:
                raise FileFault(f"its head has the line {line.strip()[:60]!r}. {AGAIN}")
    return kind, elements, data[after:]


def _faces(rows: Columns, element: Element) -> Int[np.ndarray, "f 3"]:
    lists = [words[-1] for words in element.properties if words[0] == "list"]
    name = next((x for x in FACES if x in lists), lists[0] if lists else None)
    if name is None:
        raise FileFault(f"its faces have no list of vertices. {AGAIN}")
    column = rows[name]
    if column.dtype != object:
        if (column % 1 != 0).any():  # of text
            raise FileFault(f"a corner of its faces is no whole number. {AGAIN}")
        column = column.astype(np.int64)
    if element.name == "face":
        return triangles(column)
    found = []
    for strip in column:  # -1 ends a strip; every further vertex makes a triangle
        for part in np.split(strip, np.flatnonzero(strip < 0)):
            part = part[part >= 0]
            found += [part[i : i + 3].tolist() for i in range(len(part) - 2)]
    return triangles(found)
