"""Points from files and arrays, checked at the door: (n, 3) float64, finite, or an error.

Nothing in a file is executed, and no other file is opened for it (materials, textures, links).
"""

import re
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from jaxtyping import Float

from dbdnet_jax.errors import load_open3d

Points = Float[np.ndarray, "n 3"]

MIN_POINTS = 16
MESH_SAMPLES = 20_000  # a voxel grid thins them evenly later
LARGEST = 1e100  # of a coordinate: squares and their sums must stay finite


def read_points(source: Any, name: str = "source", *, seed: int = 0) -> Points:
    """The points of a file or array-like, in their order, as float64.

    Files: PLY, OBJ, OFF, STL, GLB (a mesh is sampled by area, with ``seed``), XYZ, TXT and CSV
    (columns named x, y, z, else the first three), NPY, NPZ (an array ``points``, or the only
    one), and PCD where Open3D is installed. ``name`` is what errors call the cloud.

    Raises:
      ValueError: damaged or unknown file, or points that are not (n, 3), real and finite, with
        n >= 16 and at least three different ones.
      OSError: the file is missing, a folder, or not readable.
      ImportError: PCD without Open3D.
    """
    if isinstance(source, str | Path):
        path = Path(source)
        return check_points(read_file(path, seed), f"{name} ({path.name})")
    return check_points(source, name)


def read_file(path: Path, seed: int = 0) -> np.ndarray:
    """What stands in a point file, unchecked; errors as in ``read_points``."""
    reader = READERS.get(path.suffix.lower())
    if path.is_dir():
        raise IsADirectoryError(f"a point file must be a file; {path} is a folder. Name one in it.")
    if not path.exists():
        raise FileNotFoundError(f"a point file must exist; {path} does not. Check the path.")
    if reader is None:
        raise ValueError(
            f"the ending of a point file must be one of {' '.join(READERS)}; got "
            f"{path.suffix or 'none'!r} ({path}). Convert the file, or pass an array."
        )
    try:
        with open(path, "rb") as file:
            if not file.read(1):
                raise ValueError("it is empty (0 bytes)")
            file.seek(0)
            return reader(file, path, seed)
    except PermissionError as error:
        raise PermissionError(
            f"a point file must be readable; {path} is not for this user. Change its mode."
        ) from error
    except ImportError:
        raise
    except Exception as error:  # the readers answer damage with any type of error
        raise ValueError(
            f"a point file must be whole and of the kind its ending says; {path} is not: "
            f"{str(error).rstrip('.') or type(error).__name__}. Export it again."
        ) from error


def check_points(values: Any, name: str = "points") -> Points:
    """``values`` as (n, 3) float64, or a ValueError that says rule, value and fix."""
    if np.ma.is_masked(values):
        raise ValueError(
            f"{name} must have no masked entries. Give values[~values.mask.any(1)].data."
        )
    try:
        array = np.asarray(values)
    except Exception as error:  # ragged lists, tensors on another device, odd objects
        raise ValueError(
            f"{name} must be an (n, 3) array of numbers; got {type(values).__name__}: {error}. "
            "Convert it with numpy first."
        ) from error
    if array.dtype.kind not in "fiu":
        raise ValueError(
            f"{name} must hold real numbers; got dtype {array.dtype} ({type(values).__name__}). "
            "Give float or int coordinates."
        )
    if array.ndim != 2 or array.shape[1] != 3:
        raise ValueError(f"{name} must be (n, 3); got {array.shape}. {_shape_advice(array.shape)}")
    if len(array) < MIN_POINTS:
        raise ValueError(
            f"{name} must have at least {MIN_POINTS} points; got {len(array)}. Give more points."
        )
    bad = ~np.isfinite(array).all(axis=1)
    if bad.any():
        raise ValueError(
            f"{name} must be finite; {bad.sum()} of {len(array)} points have NaN or infinity, "
            f"the first at row {bad.argmax()}. Give points[np.isfinite(points).all(1)]."
        )
    points = np.asarray(array, np.float64)
    low, high = points.min(axis=0), points.max(axis=0)
    size = max(float(abs(low).max()), float(abs(high).max()))
    if not size < LARGEST:
        raise ValueError(
            f"{name} must have coordinates below {LARGEST:g}; got {size:g}. Change the unit."
        )
    if not (high - low).max() > 1e-12 * size:
        raise ValueError(f"{name} must hold different points; all {len(points)} are {low}.")
    return points


def _shape_advice(shape: tuple[int, ...]) -> str:
    if len(shape) == 2 and shape[0] == 3:
        return "Rows are points: give points.T."
    if len(shape) == 2 and shape[1] == 2:
        return "For points in a plane add a column of zeros."
    if len(shape) == 2 and shape[1] > 3:
        return "Give the coordinates alone: points[:, :3]."
    if len(shape) == 3:
        return "Give one cloud at a time."
    return "Rows are points, columns x, y, z."


def _read_geometry(file: BinaryIO, path: Path, seed: int) -> np.ndarray:
    """Vertices of a cloud, or points on a mesh, through trimesh; no resolver, hence no links."""
    import trimesh

    kind = path.suffix.lower()[1:]
    declared = _declared_vertices(file) if kind == "ply" else 0
    scene = trimesh.load_scene(file, file_type=kind, process=False, skip_materials=True)
    parts: list[Any] = [part for part in scene.dump() if hasattr(part, "vertices")]
    found = sum(len(part.vertices) for part in parts)
    if found < max(declared, 1):
        raise ValueError(f"it holds {found} vertices of {declared or 'at least 1'}")
    meshes = [part for part in parts if len(getattr(part, "faces", ()))]
    if not meshes:
        return np.concatenate([part.vertices for part in parts])
    mesh: Any = trimesh.util.concatenate(meshes)
    if not np.isfinite(mesh.vertices).all() or not mesh.area > 0:
        raise ValueError("its faces have no area, or a vertex is not finite")
    return np.asarray(trimesh.sample.sample_surface(mesh, MESH_SAMPLES, seed=seed)[0])


def _declared_vertices(file: BinaryIO) -> int:
    """How many vertices a PLY's header promises: trimesh does not notice a short ASCII file."""
    head = file.read(65536).split(b"end_header")[0]
    file.seek(0)
    match = re.search(rb"element\s+vertex\s+(\d+)", head)
    return int(match[1]) if match else 0


def _read_text(file: BinaryIO, path: Path, seed: int) -> np.ndarray:
    """Three columns of text, after any lines of head; separated by ``; tab ,`` or spaces."""
    columns: list[int] = [0, 1, 2]
    offset = 0
    for raw in file:
        line = raw.decode("utf-8-sig", errors="replace").strip("#/ \r\n")
        separator = next((mark for mark in ";\t," if mark in line), None)
        cells = [cell.strip(" \"'").lower() for cell in line.split(separator)]
        if {"x", "y", "z"} <= set(cells):
            columns = [cells.index(axis) for axis in "xyz"]
        elif len(cells) >= 3 and _are_numbers(cells[i] for i in columns if i < len(cells)):
            break
        offset = file.tell()
    else:
        raise ValueError("no line has three numbers")
    file.seek(offset)
    if offset == 0 and file.read(3) != b"\xef\xbb\xbf":  # a byte order mark is no digit
        file.seek(0)
    return np.loadtxt(
        file, delimiter=separator, usecols=columns, comments=("#", "//"), encoding="utf-8", ndmin=2
    )


def _are_numbers(cells: Iterable[str]) -> bool:
    try:
        return bool([float(cell) for cell in cells])
    except ValueError:
        return False


def _read_npy(file: BinaryIO, path: Path, seed: int) -> np.ndarray:
    return np.lib.format.read_array(file, allow_pickle=False)


def _read_npz(file: BinaryIO, path: Path, seed: int) -> np.ndarray:
    with np.load(file, allow_pickle=False) as archive:
        names = archive.files
        name = "points" if "points" in names else names[0] if len(names) == 1 else None
        if name is None:
            raise ValueError(f"it must hold one array, or one named 'points'; it holds {names}")
        return archive[name]


def _read_pcd(file: BinaryIO, path: Path, seed: int) -> np.ndarray:
    open3d = load_open3d("a PCD file")
    with open3d.utility.VerbosityContextManager(open3d.utility.VerbosityLevel.Error):
        points = np.asarray(open3d.io.read_point_cloud(path).points)
    if not len(points):
        raise ValueError("no points could be read")
    return points


READERS: dict[str, Callable[[BinaryIO, Path, int], np.ndarray]] = {
    **dict.fromkeys((".ply", ".obj", ".off", ".stl", ".glb"), _read_geometry),
    **dict.fromkeys((".xyz", ".txt", ".csv"), _read_text),
    ".npy": _read_npy,
    ".npz": _read_npz,
    ".pcd": _read_pcd,
}
