"""Meshes: OBJ and STL read here, line by line and by their length; OFF and GLB by trimesh."""

import itertools
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from jaxtyping import Float

from dbdnet_jax.io.point_files.numbers import parse
from dbdnet_jax.io.point_files.record import AGAIN, FileFault, PointFile
from dbdnet_jax.io.point_files.surface import sample, triangles
from dbdnet_jax.io.point_files.text import find_encoding

FACET = np.dtype([("normal", "<3f4"), ("corners", "<3f4", (3,)), ("attribute", "<u2")])


def read_obj(file: BinaryIO, path: Path, seed: int) -> PointFile:
    """Vertices and polygons (indices from 1, or from the end); materials are not opened."""
    encoding = find_encoding(file.read(4096))
    file.seek(0)
    vertices: list[list[float]] = []
    polygons: list[list[int]] = []
    text = file.read().decode(encoding, errors="replace").replace("\\\r\n", " ")
    for number, line in enumerate(text.replace("\\\n", " ").splitlines(), 1):
        words = line.split("#", 1)[0].split()
        if not words:
            continue
        if words[0] == "v":
            vertices.append(_vertex(words[1:4], number, line))
        elif words[0] == "f":
            polygons.append([_index(word, len(vertices), number) for word in words[1:]])
    points = np.array(vertices, float).reshape(-1, 3)
    return sample(points, triangles(polygons), seed)


def _vertex(words: list[str], number: int, line: str) -> list[float]:
    found = [parse(word) for word in words]
    if len(found) < 3 or None in found:
        raise FileFault(f"line {number} must be v x y z; got {line.strip()[:60]!r}. {AGAIN}")
    return [x for x in found if x is not None]


def _index(word: str, count: int, number: int) -> int:
    text = word.split("/", 1)[0]
    if not text.removeprefix("-").isdecimal() or len(text) > 12 or int(text) == 0:
        raise FileFault(f"line {number} has the face's corner {word[:40]!r}. {AGAIN}")
    return count + int(text) if int(text) < 0 else int(text) - 1


def read_stl(file: BinaryIO, path: Path, seed: int) -> PointFile:
    """Facets of a binary or ASCII STL; a binary one is told by its length, not by its name."""
    data = file.read()
    count = int.from_bytes(data[80:84], "little") if len(data) >= 84 else -1
    room, spare = divmod(max(len(data) - 84, 0), FACET.itemsize)
    text = data.removeprefix(b"\xef\xbb\xbf").lstrip()[:5].lower() == b"solid"
    exact = count == room and not spare
    notes: tuple[str, ...] = ()
    if exact or not text:
        if count == 0 and room:  # written as a stream, the count never filled in
            count, notes = room, (f"its head counts 0 facets; the {room} that follow were read",)
        if count > room or count < 0:
            raise FileFault(f"its head promises {count} facets, its length is for {room}. {AGAIN}")
        tail = data[84 + count * FACET.itemsize :]
        if len(tail) >= FACET.itemsize and not notes:
            notes = (f"{len(tail)} bytes after its {count} facets were not read",)
        corners = np.frombuffer(data, FACET, count, 84)["corners"].astype(np.float64)
    else:
        corners = _ascii_facets(data.decode("latin-1"))
    found = sample(corners.reshape(-1, 3), np.arange(3 * len(corners)).reshape(-1, 3), seed)
    return PointFile(found.points, (*notes, *found.notes))


def _ascii_facets(text: str) -> Float[np.ndarray, "f 3 3"]:
    if not any(line.split()[:1] == ["endsolid"] for line in text.lower().splitlines()[-50:]):
        raise FileFault(f"it has no endsolid at its end. {AGAIN}")
    found: list[list[list[float]]] = []
    facet: list[list[float]] | None = None
    for number, line in enumerate(text.lower().splitlines(), 1):
        words = line.split()
        if words[:1] == ["facet"]:
            facet = []
        elif words[:1] == ["vertex"] and facet is not None:
            facet.append(_vertex(words[1:4], number, line))
        elif words[:1] == ["endfacet"]:
            if facet is None or len(facet) != 3:
                raise FileFault(f"the facet that ends at line {number} has not 3 corners. {AGAIN}")
            found.append(facet)
            facet = None
    return np.array(found, float).reshape(-1, 3, 3)


def read_trimesh(file: BinaryIO, path: Path, seed: int) -> PointFile:
    """OFF and GLB; no resolver is given, hence no link is followed."""
    import trimesh

    kind = path.suffix.lower()[1:]
    scene = trimesh.load_scene(file, file_type=kind, process=False, skip_materials=True)
    parts: list[Any] = [part for part in scene.dump() if hasattr(part, "vertices")]
    starts = [0, *itertools.accumulate(len(part.vertices) for part in parts)]
    vertices = [np.asarray(part.vertices, np.float64).reshape(-1, 3) for part in parts]
    faces = [
        np.asarray(part.faces) + start
        for part, start in zip(parts, starts, strict=False)
        if len(getattr(part, "faces", ()))
    ]
    none = np.empty((0, 3))
    return sample(
        np.concatenate([none, *vertices]),
        np.concatenate([none.astype(np.int64), *faces]).astype(np.int64),
        seed,
    )
