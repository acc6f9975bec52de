"""Scanners' and surveyors' files, each through its own library: LAS and LAZ, E57."""

import importlib
from pathlib import Path
from types import ModuleType
from typing import BinaryIO

import numpy as np

from dbdnet_jax.errors import MissingExtraError
from dbdnet_jax.io.point_files.record import AGAIN, FileFault, PointFile, drop_unmeasured


def _load(library: str, kind: str) -> ModuleType:
    try:
        return importlib.import_module(library)
    except (ImportError, OSError) as error:
        raise MissingExtraError(
            f"{kind} files need {library}; importing it failed ({error}). "
            'Run `pip install "dbdnet_jax[formats]"`.'
        ) from error


def read_las(file: BinaryIO, path: Path, seed: int) -> PointFile:
    """Scaled coordinates of LAS and LAZ; withheld points, deleted by their maker, left out."""
    laspy = _load("laspy", "LAS and LAZ")
    if path.suffix.lower() == ".laz":
        _load("lazrs", "LAZ")
    with laspy.open(file, closefd=False) as reader:
        header = reader.header
        room = path.stat().st_size - header.offset_to_point_data
        size = header.point_format.size
        if not header.are_points_compressed and room < header.point_count * size:
            raise FileFault(
                f"it promises {header.point_count} points and has bytes for "
                f"{max(room, 0) // size}. {AGAIN}"
            )
        found = reader.read()
    if len(found.points) != header.point_count:
        raise FileFault(f"it holds {len(found.points)} of {header.point_count} points. {AGAIN}")
    points = np.stack([np.asarray(found[axis], np.float64) for axis in "xyz"], axis=1)
    gone = np.asarray(found.withheld, bool) if hasattr(found, "withheld") else np.zeros(0, bool)
    if gone.any():
        kept = drop_unmeasured(points[~gone])
        note = f"{gone.sum()} of {len(gone)} points are marked as withheld and were left out"
        return PointFile(kept.points, (note, *kept.notes))
    return drop_unmeasured(points)


def read_e57(file: BinaryIO, path: Path, seed: int) -> PointFile:
    """All scans of an E57 in their common frame; points marked as invalid left out, counted."""
    pye57 = _load("pye57", "E57")
    archive = pye57.E57(str(path))
    scans, invalid = [], 0
    try:
        for i in range(archive.scan_count):
            scan = archive.read_scan(i, ignore_missing_fields=True)  # in the file's frame
            axes = [scan.get(f"cartesian{axis}") for axis in "XYZ"]
            if any(axis is None for axis in axes):
                raise FileFault(f"scan {i} has no Cartesian coordinates. {AGAIN}")
            scans.append(np.stack(axes, axis=1).astype(np.float64))
            # pye57 drops what the file marks as invalid.
            invalid += archive.get_header(i).point_count - len(scans[-1])
    finally:
        archive.close()
    found = drop_unmeasured(np.concatenate(scans) if scans else np.empty((0, 3)))
    notes = (f"{invalid} points are marked as invalid and were left out",) if invalid else ()
    return PointFile(found.points, (*notes, *found.notes))
