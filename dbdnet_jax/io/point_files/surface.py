"""Points on a mesh, drawn by area, and what to do with points that no face joins."""

import numpy as np
from jaxtyping import Float, Int

from dbdnet_jax.io.point_files.record import FileFault, PointFile, drop_unmeasured

MESH_SAMPLES = 20_000  # a voxel grid thins them evenly later
LOOSE = 0.5  # share of vertices without a face from which a file is a cloud


def sample(
    vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"], seed: int
) -> PointFile:
    """A mesh as a cloud; a cloud with a few faces as it stands; a mesh beside points as both.

    Faces that are damaged, with vertices that are not finite, are left out and counted.

    Raises:
      FileFault: no vertices, faces of vertices that are not there, or without area.
    """
    if not len(vertices):
        raise FileFault("it holds 0 vertices of at least 1. Export it again.")
    if not len(faces):
        return drop_unmeasured(vertices)
    if faces.min() < 0 or faces.max() >= len(vertices):
        raise FileFault(
            f"a face joins vertex {faces.max() if faces.min() >= 0 else faces.min()} of "
            f"{len(vertices)}. Export it again."
        )
    loose = np.ones(len(vertices), bool)
    loose[faces] = False
    count = int(loose.sum())
    if count > LOOSE * len(vertices):
        found = drop_unmeasured(vertices)
        note = (
            f"{len(faces)} faces join {len(vertices) - count} of {len(vertices)} vertices; it was "
            "read as a cloud of all vertices"
        )
        return PointFile(found.points, (note, *found.notes))
    notes = []
    corners = vertices[faces]
    with np.errstate(all="ignore"):  # damaged vertices; what comes of them is left out
        cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        area = np.sqrt(np.sum(cross**2, axis=1)) / 2
    good = np.isfinite(area) & np.isfinite(corners).all(axis=(1, 2))
    if not good.all():
        lost = len(good) - int(good.sum())
        notes.append(f"{lost} of {len(good)} faces have NaN or infinity and were left out")
        corners, area = corners[good], area[good]
    if not area.sum() > 0:
        raise FileFault("its faces have no area, or a vertex is not finite. Export it again.")
    points = _draw(corners, area, seed)
    if count:
        # Many exporters leave a few vertices behind; they are part of what was measured.
        rest = drop_unmeasured(vertices[loose])
        points = np.concatenate([points, rest.points])
        notes += [f"{count} vertices that no face joins were read as points", *rest.notes]
    return PointFile(points, tuple(notes))


def _draw(corners: np.ndarray, area: np.ndarray, seed: int) -> Float[np.ndarray, "n 3"]:
    generator = np.random.default_rng(seed)
    up_to = np.cumsum(area / area.max())
    chosen = np.searchsorted(up_to, generator.random(MESH_SAMPLES) * up_to[-1], side="right")
    a, b, c = np.moveaxis(corners[np.minimum(chosen, len(area) - 1)], 1, 0)
    u, v = generator.random((2, MESH_SAMPLES, 1))
    outside = u + v > 1
    u, v = np.where(outside, 1 - u, u), np.where(outside, 1 - v, v)
    return a + u * (b - a) + v * (c - a)


def triangles(polygons: np.ndarray | list[list[int]]) -> Int[np.ndarray, "f 3"]:
    """Fans of the polygons' first corners; what has fewer than three corners has no area."""
    if isinstance(polygons, np.ndarray) and polygons.ndim == 2:
        first = np.repeat(polygons[:, :1], max(polygons.shape[1] - 2, 0), axis=1)
        return np.stack([first, polygons[:, 1:-1], polygons[:, 2:]], axis=2).reshape(-1, 3)
    found = [
        (polygon[0], second, third)
        for polygon in polygons
        for second, third in zip(polygon[1:-1], polygon[2:], strict=True)
    ]
    return np.array(found, np.int64).reshape(-1, 3)
