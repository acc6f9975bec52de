"""Arrays in files: NPY, NPZ, and the bare float32 rows of KITTI; no pickles."""

from pathlib import Path
from typing import BinaryIO

import numpy as np

from dbdnet_jax.io.point_files.columns import find_xyz
from dbdnet_jax.io.point_files.record import FileFault, PointFile, drop_unmeasured

KITTI_ROW = 16  # bytes: x, y, z, reflectance as float32
LARGEST_KITTI = 1e5  # metres; another kind of file read as float32 goes far beyond


def read_npy(file: BinaryIO, path: Path, seed: int) -> PointFile:
    """An array (n, 3 or more), (h, w, 3 or more), or of records with x, y, z."""
    return as_points(np.lib.format.read_array(file, allow_pickle=False))


def read_npz(file: BinaryIO, path: Path, seed: int) -> PointFile:
    """The array ``points`` of an archive, or its only one."""
    with np.load(file, allow_pickle=False) as archive:
        names = archive.files
        name = "points" if "points" in names else names[0] if len(names) == 1 else None
        if name is None:
            raise FileFault(
                f"it must hold one array, or one named 'points'; it holds {names}. Rename one."
            )
        return as_points(archive[name])


def as_points(array: np.ndarray) -> PointFile:
    """An array read as a table of text is: named columns or the first three; NaN rows dropped."""
    if array.dtype.names:
        names = array.dtype.names
        xyz = find_xyz(names)
        if xyz is None and "xyz" in names:
            return as_points(array["xyz"])
        if xyz is None or any(array.dtype[names[i]].shape for i in xyz):
            raise FileFault(f"its records must have x, y, z; they have {names}. Name them so.")
        array = np.stack([np.asarray(array[names[i]], np.float64).ravel() for i in xyz], axis=1)
    if array.dtype.kind in "fiu" and array.ndim == 3 and array.shape[2] in (3, 4, 6):
        array = array.reshape(-1, array.shape[2])
    if array.dtype.kind in "fiu" and array.ndim == 2 and array.shape[1] > 3:
        # (3, n) and (4, n) are points in columns: left to the error that says so.
        if array.shape[0] > 4 or array.shape[1] <= 4:
            first = array[:, 0]
            if len(first) > 1 and np.array_equal(first, first[0] + np.arange(len(first))):
                raise FileFault("its first column counts the rows. Save points[:, 1:4] alone.")
            array = array[:, :3]
    return drop_unmeasured(array)


def read_kitti(file: BinaryIO, path: Path, seed: int) -> PointFile:
    """Rows of four float32, KITTI's velodyne scans; a .bin says nothing of what it holds."""
    data = file.read()
    if len(data) % KITTI_ROW:
        raise FileFault(
            f"a .bin must be rows of four float32 (x, y, z, reflectance), {KITTI_ROW} bytes each; "
            f"it has {len(data)} bytes. Save other kinds as .npy."
        )
    rows = np.frombuffer(data, "<f4").reshape(-1, 4)
    found = drop_unmeasured(rows[:, :3].astype(np.float64))
    size = np.abs(found.points).max(initial=0)
    if size > LARGEST_KITTI or len(found.points) < len(rows) / 2:
        raise FileFault(
            f"a .bin must be rows of four float32 in metres; read so, it has numbers up to "
            f"{size:g}. Save other kinds as .npy."
        )
    # Rows of three numbers or of five (nuScenes) put coordinates there, of which some are negative.
    if (rows[:, 3] < 0).any():
        raise FileFault(
            "a .bin must be rows of four float32, the last a reflectance from 0 up; it seems to "
            "have another number of columns. Save points[:, :3] as .npy."
        )
    return found
