"""A file's points by its ending; the reader is chosen before anything heavy is imported."""

from collections.abc import Callable
from pathlib import Path
from typing import Any, BinaryIO

from dbdnet_jax.errors import MissingExtraError
from dbdnet_jax.io.point_files.arrays import read_kitti, read_npy, read_npz
from dbdnet_jax.io.point_files.check import check_points
from dbdnet_jax.io.point_files.mesh import read_obj, read_stl, read_trimesh
from dbdnet_jax.io.point_files.pcd import read_pcd
from dbdnet_jax.io.point_files.ply import read_ply
from dbdnet_jax.io.point_files.record import FileFault, PointFile
from dbdnet_jax.io.point_files.scans import read_e57, read_las
from dbdnet_jax.io.point_files.text import read_text

READERS: dict[str, Callable[[BinaryIO, Path, int], PointFile]] = {
    ".ply": read_ply,
    ".obj": read_obj,
    ".stl": read_stl,
    **dict.fromkeys((".off", ".glb"), read_trimesh),
    **dict.fromkeys((".xyz", ".txt", ".csv", ".asc", ".pts", ".ptx"), read_text),
    ".pcd": read_pcd,
    ".npy": read_npy,
    ".npz": read_npz,
    ".bin": read_kitti,
    **dict.fromkeys((".las", ".laz"), read_las),
    ".e57": read_e57,
}


def read_point_file(source: Any, name: str = "source", *, seed: int = 0) -> PointFile:
    """The points of a file or array-like, in their order, as float64, with notes on the reading.

    Files: clouds (PLY, PCD, XYZ, ASC, PTS, PTX, TXT, CSV, NPY, NPZ, KITTI's BIN, and LAS, LAZ,
    E57 with the extra ``formats``) and meshes (PLY, OBJ, OFF, STL, GLB), which are sampled by
    area, with ``seed``. Rows of a file that hold NaN or infinity are left out, and a note counts
    them; arrays must have none. ``name`` is what errors and notes call the cloud. A `PointFile`
    is handed back as it is.

    Raises:
      ValueError: damaged or unknown file, or points that are not (n, 3), real and finite, with
        n >= 16 and not all the same.
      OSError: the file is missing, a folder, or not readable.
      MissingExtraError: LAS, LAZ or E57 without its library.
    """
    if isinstance(source, PointFile):
        return source
    if not isinstance(source, str | Path):
        return PointFile(check_points(source, name))
    path = Path(source)
    points, notes = read_file(path, seed)
    label = f"{name} ({path.name})"
    try:
        checked = check_points(points, label)
    except ValueError as error:
        raise ValueError(" ".join((str(error), *(f"({note}.)" for note in notes)))) from error
    return PointFile(checked, tuple(f"{label}: {note}" for note in notes))


def read_file(path: Path, seed: int = 0) -> PointFile:
    """What stands in a point file, unchecked; errors as in ``read_point_file``."""
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
    rule = f"a point file must be whole and of the kind its ending says; {path} is not"
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
    except MissingExtraError:
        raise
    except FileFault as error:
        raise ValueError(f"{rule}: {error}") from error
    except Exception as error:  # the readers answer damage with any type of error
        said = str(error).rstrip(".") or type(error).__name__
        raise ValueError(f"{rule}: {said}. Export it again.") from error
