"""Evenly spaced points on triangle meshes, spaced and normalised as the ModelNet40 clouds."""

from __future__ import annotations

from bisect import bisect_left, bisect_right

import numpy as np
from jaxtyping import Float, Int

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
    rows = np.sort(farthest_points(points, KEPT))
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


def farthest_points(points: Float[np.ndarray, "n 3"], count: int) -> Int[np.ndarray, " count"]:
    """Rows chosen by farthest-point sampling from row 0, in the order of choice.

    A choice changes the distances of points nearer than the largest distance left, so only a
    window of the points, sorted along their longest axis, is looked at: half the time.
    """
    axis = int(np.ptp(points, axis=0).argmax())
    order = np.argsort(points[:, axis], kind="stable")
    coordinates = np.ascontiguousarray(points[order].T)
    columns = points[order][:, :, None]
    along = coordinates[axis].tolist()
    nearest = np.full(len(points), np.inf)
    last, reach = int(np.flatnonzero(order == 0)[0]), np.inf
    chosen = np.empty(count, dtype=np.int64)
    for step in range(count):
        chosen[step] = last
        low = bisect_left(along, along[last] - reach)
        window = slice(low, bisect_right(along, along[last] + reach, lo=low))
        offset = coordinates[:, window] - columns[last]
        offset *= offset
        distance = offset[0] + offset[1] + offset[2]
        np.minimum(nearest[window], distance, out=nearest[window])
        last = int(nearest.argmax())
        reach = float(nearest[last]) ** 0.5
    return order[chosen]
