"""PLY through plyfile, its head put in order first: programs write it with many liberties."""

import io
import re
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import numpy as np
from jaxtyping import Int

from dbdnet_jax.io.point_files.columns import find_xyz
from dbdnet_jax.io.point_files.record import FileFault, PointFile
from dbdnet_jax.io.point_files.surface import sample, triangles

HEAD_BYTES = 1 << 20
AGAIN = "Export it again."
END = re.compile(rb"(?i)(?:^|[\r\n])[ \t]*end_header[ \t]*(\r\n|\n|\r|$)")
FACES = ("vertex_indices", "vertex_index")


class Element(NamedTuple):
    """One kind of row that a PLY holds."""

    name: str
    count: int  # type: ignore[assignment]  # not tuple.count
    properties: tuple[tuple[str, ...], ...]


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
    found = _parse(kind, elements[:needed], body)
    rows = found["vertex"].data
    vertices = np.stack([rows[scalars[i]].astype(np.float64) for i in xyz], axis=1)
    faces = np.empty((0, 3), np.int64)
    if surface:
        faces = _faces(found[surface].data, elements[names.index(surface)])
    return sample(vertices, faces, seed)


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


def _parse(kind: str, elements: list[Element], body: bytes) -> Any:
    from plyfile import PlyData, PlyElementParseError

    head = f"ply\nformat {kind} 1.0\n"
    for name, count, properties in elements:
        head += f"element {name} {count}\n"
        head += "".join(f"property {' '.join(words)}\n" for words in properties)
    if kind == "ascii":
        if b"\n" not in body:
            body = body.replace(b"\r", b"\n")
        body = re.sub(rb"(?m)^[ \t\r]*\n", b"", body)
    whole = f"{head}end_header\n".encode() + body
    lists = [words[-1] for words in elements[-1].properties if words[0] == "list"]
    if elements[-1].name == "face" and len(lists) == 1:
        try:  # triangles alone, as most meshes have: a hundred times as fast
            return PlyData.read(io.BytesIO(whole), known_list_len={"face": {lists[0]: 3}})
        except PlyElementParseError:
            pass
    try:
        return PlyData.read(io.BytesIO(whole))
    except PlyElementParseError as error:
        place = f", row {error.row}" if error.row is not None else ""
        name = error.element.name if error.element is not None else "element"
        count = next((x.count for x in elements if x.name == name), 0)
        raise FileFault(
            f"its {count} rows of {name} are not all there: {error.message}{place} of {count}. "
            f"{AGAIN}"
        ) from error


def _faces(rows: np.ndarray, element: Element) -> Int[np.ndarray, "f 3"]:
    lists = [words[-1] for words in element.properties if words[0] == "list"]
    name = next((x for x in FACES if x in lists), lists[0] if lists else None)
    if name is None:
        raise FileFault(f"its faces have no list of vertices. {AGAIN}")
    column = rows[name]
    if column.dtype != object:
        return column.astype(np.int64).reshape(len(column), -1)
    if element.name == "face":
        return triangles([polygon.tolist() for polygon in column])
    found = []
    for strip in column:  # -1 ends a strip; every further vertex makes a triangle
        for part in np.split(strip, np.flatnonzero(strip < 0)):
            part = part[part >= 0]
            found += [part[i : i + 3].tolist() for i in range(len(part) - 2)]
    return triangles(found)
