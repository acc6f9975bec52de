"""What the surface around each even point looks like, in numbers that no rigid motion changes.

Histograms of the angles between a point's normal, the normals of its neighbours and the lines to
them, as point feature histograms have them (Rusu et al. 2009), but over wide neighbourhoods: of
validation scans the widest radii told most. The side of a normal is arbitrary, so a point's own is
turned to the convex side of its neighbourhood, and its neighbours' to the side of that.
"""

import numpy as np
from jaxtyping import Bool, Float

from dbdnet_jax.alignment.surfaces import Surface

# Radius, in units of the shape's, and the most neighbours within it.
SCALES = ((0.25, 64), (0.5, 128))
BINS = 11  # of each angle's cosine: odd, so that the 0 of a plane is inside of one


def angle_histograms(side: Surface) -> Float[np.ndarray, "e f"]:
    """Roots of the parts of the neighbours in each bin, so that distances are Hellinger's."""
    from scipy.spatial import cKDTree

    points = side.points[side.even].astype(np.float32)
    normals = side.normals[side.even].astype(np.float32)
    tree = cKDTree(points)
    most = max(count for _, count in SCALES)
    distance, rows = tree.query(
        points, min(most, len(points)), distance_upper_bound=max(radius for radius, _ in SCALES)
    )
    rows = np.where(np.isfinite(distance), rows, 0)
    lines = points[rows] - points[:, None]
    lines /= np.maximum(np.linalg.norm(lines, axis=2, keepdims=True), 1e-12)
    others, parts = normals[rows], []
    for radius, count in SCALES:
        near = ((distance <= radius) & (distance > 0))[:, :count]
        cosines = _cosines(normals, lines[:, :count] * near[..., None], others[:, :count])
        parts += [_histogram(cosine, near) for cosine in cosines]
    return np.sqrt(np.concatenate(parts, axis=1))


def _cosines(
    normals: Float[np.ndarray, "e 3"],
    lines: Float[np.ndarray, "e k 3"],
    others: Float[np.ndarray, "e k 3"],
) -> list[Float[np.ndarray, "e k"]]:
    """Line to own normal, line to the other's, and the two normals (stretched to -1 to 1)."""
    convex = np.where((normals * lines.sum(axis=1)).sum(axis=1) > 0, -1.0, 1.0)
    normals = normals * convex[:, None]
    between = np.einsum("eki,ei->ek", others, normals)
    of_line = np.einsum("eki,eki->ek", lines, others) * np.where(between < 0, -1.0, 1.0)
    return [np.einsum("eki,ei->ek", lines, normals), of_line, 2 * np.abs(between) - 1]


def _histogram(
    values: Float[np.ndarray, "e k"], counted: Bool[np.ndarray, "e k"]
) -> Float[np.ndarray, "e b"]:
    """The part of the counted values from -1 to 1 in each bin, a row for each point."""
    place = np.clip(((values + 1) * (BINS / 2)).astype(np.intp), 0, BINS - 1)
    place += BINS * np.arange(len(values))[:, None]
    counts = np.bincount(place[counted], minlength=BINS * len(values)).reshape(-1, BINS)
    return counts / np.maximum(counted.sum(axis=1), 1)[:, None]
