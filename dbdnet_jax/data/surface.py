"""Evenly spaced points on triangle meshes, spaced and normalised as the ModelNet40 clouds."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int

from dbdnet_jax.ops.sampling import farthest_rows

CANDIDATES = 3072  # drawn by area; farthest-point sampling then keeps KEPT of them
KEPT = 2048


def even_points(
    vertices: Float[np.ndarray, "v 3"],
    triangles: Int[np.ndarray, "t 3"],
    rng: np.random.Generator,
) -> tuple[Float[np.ndarray, "2048 3"], Float[np.ndarray, "2048 3"]]:
    """2048 evenly spaced points of a mesh and their unit face normals.

    The points' centroid is the origin and the largest norm 1. The rows keep the order they were
    drawn in, so that the first 1024 are a fair half of the shape.

    Raises:
        ValueError: no triangle has an area.
    """
    points, normals = sample_surface(vertices, triangles, CANDIDATES, rng)
    rows = np.sort(farthest_rows(points, KEPT))
    points, normals = points[rows], normals[rows]
    points = points - points.mean(0)
    return points / np.sqrt((points**2).sum(-1).max()), normals


def sample_surface(
    vertices: Float[np.ndarray, "v 3"],
    triangles: Int[np.ndarray, "t 3"],
    count: int,
    rng: np.random.Generator,
) -> tuple[Float[np.ndarray, "count 3"], Float[np.ndarray, "count 3"]]:
    """Independent points on the surface, uniform by area, and their unit face normals.

    Degenerate triangles are skipped. The side a normal points to is the winding of the mesh.

    Raises:
        ValueError: no triangle has an area.
    """
    first, second, third = (vertices[triangles[:, corner]] for corner in range(3))
    normals = np.cross(second - first, third - first)
    areas = np.sqrt((normals**2).sum(-1))
    extent = np.ptp(vertices, axis=0).max() if len(vertices) else 0.0
    proper = areas > 1e-12 * extent**2
    if not proper.any():
        raise ValueError(
            f"a model must have a triangle with an area; got {len(triangles)} triangles, all "
            "degenerate. The mesh is damaged: read or build it again."
        )
    first, second, third = first[proper], second[proper], third[proper]
    normals = normals[proper] / areas[proper, None]
    edges = np.cumsum(areas[proper])
    face = np.searchsorted(edges, rng.random(count) * edges[-1], side="right")
    face = np.minimum(face, len(edges) - 1)
    root = np.sqrt(rng.random(count))[:, None]
    along = rng.random(count)[:, None]
    points = (
        (1 - root) * first[face] + root * (1 - along) * second[face] + root * along * third[face]
    )
    return points, normals[face]
