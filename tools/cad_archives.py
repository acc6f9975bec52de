"""Reading Sweet Home 3D's furniture archives: catalogue, licences and OBJ meshes."""

import re
import zipfile
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

CATALOGUE = "PluginFurnitureCatalog.properties"
ATTRIBUTION_LICENCE = "Creative Commons Attribution 3.0 license"


class Model(NamedTuple):
    """One catalogue entry, as text; ``rotation`` is the catalogue's matrix or None."""

    library: str
    path: str
    name: str
    category: str
    creator: str
    licence: str
    source_url: str
    rotation: Float[np.ndarray, "3 3"] | None

    @property
    def key(self) -> str:
        """The name of the model in splits, classes and seeds."""
        return f"{self.library}|{self.path}"


class Library(NamedTuple):
    """One archive: what its catalogue and LICENSE.TXT say of it, and its models."""

    name: str
    licence: str
    licence_url: str
    notices: list[str]
    provider: str
    models: list[Model]


def parse_properties(data: bytes) -> dict[str, str]:
    r"""Read a Java properties file: Latin-1, ``\uXXXX`` and ``\:`` escapes, continued lines.

    A key that stands twice keeps its last value, as in Java.
    """
    entries: dict[str, str] = {}
    pending = ""
    for line in re.split(r"\r\n|\r|\n", data.decode("latin-1")):
        text = pending + line.lstrip(" \t\f")
        if not pending and (not text or text[0] in "#!"):
            continue
        if (len(text) - len(text.rstrip("\\"))) % 2:  # an odd number: the line goes on
            pending = text[:-1]
            continue
        pending = ""
        match = re.match(r"((?:\\.|[^\\=: \t\f])*)[ \t\f]*[=:]?[ \t\f]*(.*)", text, re.S)
        if match and text:
            entries[_unescape(match[1])] = _unescape(match[2])
    return entries


def _unescape(text: str) -> str:
    controls = {"t": "\t", "n": "\n", "r": "\r", "f": "\f"}

    def replace(match: re.Match[str]) -> str:
        if match[1]:
            return chr(int(match[1], 16))
        return controls.get(match[2], match[2])

    return re.sub(r"\\(?:u([0-9a-fA-F]{4})|(.))", replace, text)


def parse_obj(text: str) -> tuple[Float[np.ndarray, "v 3"], Int[np.ndarray, "t 3"]]:
    """Read the ``v`` and ``f`` lines of a Wavefront OBJ; polygons become triangle fans.

    Indices may be ``a``, ``a/b``, ``a//c`` or ``a/b/c``, counted from 1 or, if negative, back from
    the last vertex so far.

    Raises:
        ValueError: an index names no vertex.
    """
    vertices: list[list[float]] = []
    triangles: list[tuple[int, int, int]] = []
    for line in text.splitlines():
        fields = line.split()
        if not fields:
            continue
        if fields[0] == "v":
            vertices.append([float(value) for value in fields[1:4]])
        elif fields[0] == "f":
            corners = [int(field.split("/", 1)[0]) for field in fields[1:]]
            corners = [c - 1 if c > 0 else len(vertices) + c for c in corners]
            triangles += [
                (corners[0], b, c) for b, c in zip(corners[1:-1], corners[2:], strict=True)
            ]
    faces = np.array(triangles, dtype=np.int64).reshape(-1, 3)
    if faces.size and not (0 <= faces.min() and faces.max() < len(vertices)):
        raise ValueError(
            f"face indices must name one of the {len(vertices)} vertices; got rows "
            f"{faces.min()} to {faces.max()}. The OBJ file is damaged: install the archive again."
        )
    return np.array(vertices, dtype=np.float64).reshape(-1, 3), faces


def read_library(archive: zipfile.ZipFile, name: str) -> Library:
    """The catalogue of one archive, models with a path that stood before left out."""
    catalogue = parse_properties(archive.read(CATALOGUE))
    text = archive.read("LICENSE.TXT").decode("latin-1")
    url = re.search(r"https?://creativecommons\.org/\S+", text)
    licence = " ".join(catalogue["license"].split())
    models: dict[str, Model] = {}
    numbers = sorted(int(key[6:]) for key in catalogue if re.fullmatch(r"model#\d+", key))
    for number in numbers:
        path = catalogue[f"model#{number}"].strip()
        own_licence, source_url = _own_licence(archive, path)
        rotation = catalogue.get(f"modelRotation#{number}")
        models.setdefault(
            path,
            Model(
                library=name,
                path=path,
                name=catalogue[f"name#{number}"].strip(),
                category=catalogue[f"category#{number}"].strip(),
                creator=catalogue[f"creator#{number}"].strip(),
                licence=own_licence if licence == "Public domain" and own_licence else licence,
                source_url=source_url,
                rotation=np.array(rotation.split(), dtype=float).reshape(3, 3)
                if rotation
                else None,
            ),
        )
    notices = [" ".join(line.split()) for line in text.splitlines() if "(C) Copyright" in line]
    return Library(
        name,
        licence,
        url[0] if url else "",
        notices,
        catalogue["provider"].strip(),
        list(models.values()),
    )


def _own_licence(archive: zipfile.ZipFile, path: str) -> tuple[str, str]:
    """What the licence file in a model's folder asks for ("" if nothing), and its address.

    Two models of the public-domain library come with an attribution licence of their own.
    """
    folder = path.lstrip("/").rpartition("/")[0] + "/"
    for member in sorted(archive.namelist()):
        if member.startswith(folder) and "licen" in member.lower():
            text = archive.read(member).decode("latin-1")
            url = re.search(r"http://www\.blendswap\.com/blends/view/\d+", text)
            asks = "Creative Commons Attribution" in text
            return ATTRIBUTION_LICENCE if asks else "", url[0] if url else ""
    return "", ""
