"""Points from files and arrays, checked at the door: (n, 3) float64, finite, or an error.

Nothing in a file is executed, and no other file is opened for it (materials, textures, links).
"""

from typing import Any

from dbdnet_jax.io.point_files.check import LARGEST, MIN_POINTS, check_points
from dbdnet_jax.io.point_files.read import read_file, read_point_file
from dbdnet_jax.io.point_files.record import PointFile
from dbdnet_jax.io.point_files.surface import MESH_SAMPLES
from dbdnet_jax.types import Points

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
]


def read_points(source: Any, name: str = "source", *, seed: int = 0) -> Points:
    """The points of a file or array-like, in their order: `read_point_file` without its notes."""
    return read_point_file(source, name, seed=seed).points
