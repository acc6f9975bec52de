"""A cloud as a surface: normals once, neighbours fast, and how one surface lies on another.

All in NumPy and float64, at the network's scale (shapes in the unit sphere).
"""

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from dbdnet_jax.types import Points, Transform

NEAREST_INLIER = 0.03  # of the unit: noise and the last error of a pose, for dense clouds
NORMAL_NEIGHBOURS = 16  # at least; of dense clouds a 500th part, to reach beyond their noise
TIGHT = 0.25  # of the inlier distance: along the normals, within what a matched point lies
SAME_SIDE = 0.8  # cosine between normals of one surface, either way up


class Surface(NamedTuple):
    """Points, unit normals (their side is arbitrary), and a tree of the points.

    ``even`` are rows that cover the surface evenly; ``spacing`` is the median distance from a
    point to the nearest other one.
    """

    points: Float[np.ndarray, "n 3"]
    normals: Float[np.ndarray, "n 3"]
    even: Int[np.ndarray, " e"]
    tree: Any
    spacing: float


class PoseFit(NamedTuple):
    """How a moved surface lies on another one; every entry free of units.

    Inliers have a point of the other cloud within the inlier distance. ``tight`` is the part of
    each cloud that lies on the other's surface, the normals agreeing.
    """

    source_inliers: float
    target_inliers: float
    source_tight: float
    target_tight: float
    normal_agreement: float  # mean cosine of the inliers' normals
    plane_rmse: float  # of the inliers, along the normals, per inlier distance


def surface(points: Points, even: Int[np.ndarray, " e"] | None = None) -> Surface:
    """Normals by the flattest direction of the nearest neighbours."""
    from scipy.spatial import cKDTree

    tree = cKDTree(points)
    count = min(len(points), max(NORMAL_NEIGHBOURS, len(points) // 500))
    distance, near = tree.query(points, k=count)
    offsets = points[near]
    offsets -= offsets.mean(axis=1, keepdims=True)
    normals = np.linalg.eigh(np.matmul(offsets.transpose(0, 2, 1), offsets))[1][:, :, 0]
    rows = np.arange(len(points)) if even is None else even
    return Surface(points, normals, rows, tree, float(np.median(distance[:, 1])))


def mapped(side: Surface, points: Points, turn: Float[np.ndarray, "3 3"]) -> Surface:
    """The surface of the same points moved by a rotation or reflection, and a shift."""
    from scipy.spatial import cKDTree

    return Surface(points, side.normals @ turn.T, side.even, cKDTree(points), side.spacing)


def inlier_distance(source: Surface, target: Surface) -> float:
    """How far apart two points of one surface may stand: twice the wider spacing of the two."""
    return max(NEAREST_INLIER, 2 * source.spacing, 2 * target.spacing)


def measure_fit(pose: Transform, source: Surface, target: Surface, distance: float) -> PoseFit:
    """Both clouds' even points against the other's surface."""
    forth = _against(pose, source, target, distance)
    back = _against(np.linalg.inv(pose), target, source, distance)
    near = np.concatenate([way[0] for way in (forth, back)])
    if not near.any():
        return PoseFit(0.0, 0.0, 0.0, 0.0, 0.5, 1.0)
    cosine = np.concatenate([way[1] for way in (forth, back)])[near]
    plane = np.concatenate([way[2] for way in (forth, back)])[near]
    return PoseFit(
        source_inliers=float(forth[0].mean()),
        target_inliers=float(back[0].mean()),
        source_tight=float(_tight(*forth, distance).mean()),
        target_tight=float(_tight(*back, distance).mean()),
        normal_agreement=float(cosine.mean()),
        plane_rmse=float(np.sqrt(np.mean(plane**2))) / distance,
    )


def _tight(
    near: Bool[np.ndarray, " e"],
    cosine: Float[np.ndarray, " e"],
    plane: Float[np.ndarray, " e"],
    distance: float,
) -> Float[np.ndarray, " e"]:
    """Weight of every point as one that lies on the other surface."""
    weight = np.exp(-0.5 * (plane / (TIGHT * distance)) ** 2)
    return np.where(near & (cosine > SAME_SIDE), weight, 0.0)


def _against(
    pose: Transform, source: Surface, target: Surface, distance: float
) -> tuple[Bool[np.ndarray, " e"], Float[np.ndarray, " e"], Float[np.ndarray, " e"]]:
    """Inliers, cosines between normals, and distances along the target's normals."""
    moved = source.points[source.even] @ pose[:3, :3].T + pose[:3, 3]
    found, rows = target.tree.query(moved, distance_upper_bound=distance)
    near = np.isfinite(found)
    rows = np.where(near, rows, 0)
    normals = target.normals[rows]
    own = source.normals[source.even] @ pose[:3, :3].T
    plane = ((moved - target.points[rows]) * normals).sum(axis=1)
    return near, np.abs((own * normals).sum(axis=1)), plane
