"""Points from files and arrays, checked at the door: (n, 3) float64, finite, or an error.

Nothing in a file is executed, and no other file is opened for it (materials, textures, links).
"""

import json
from pathlib import Path
from typing import Any

import numpy as np

from dbdnet_jax.io.point_files.check import LARGEST, MIN_POINTS, Points, check_points
from dbdnet_jax.io.point_files.read import read_file, read_point_file
from dbdnet_jax.io.point_files.record import PointFile
from dbdnet_jax.io.point_files.surface import MESH_SAMPLES

__all__ = [
    "LARGEST",
    "MESH_SAMPLES",
    "MIN_POINTS",
    "PointFile",
    "Points",
    "check_points",
    "read_file",
    "read_point_file",
    "read_points",
    "read_transform",
]


def read_points(source: Any, name: str = "source", *, seed: int = 0) -> Points:
    """The points of a file or array-like, in their order: `read_point_file` without its notes."""
    return read_point_file(source, name, seed=seed).points


def read_transform(path: Path) -> np.ndarray:
    """The numbers of a transform's file (.txt, .json with "transform", .npy), unchecked.

    Raises:
      ValueError: another or a damaged file.
      OSError: it cannot be opened.
    """
    try:
        if path.suffix.lower() == ".json":
            return np.array(json.loads(path.read_text())["transform"], np.float64)
        if path.suffix.lower() == ".npy":
            return np.load(path, allow_pickle=False)
        return np.array([line.split() for line in path.read_text().splitlines()], np.float64)
    except (ValueError, KeyError, TypeError, EOFError) as error:
        raise ValueError(f"a transform's file must hold 4x4 numbers; {path}: {error}.") from error
