"""What there is to see of an alignment: the points that its pose was judged on."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from dbdnet_jax.alignment.align import Alignment
from dbdnet_jax.alignment.downsampling import downsample
from dbdnet_jax.ops.transforms import move

MATCHES_DRAWN = 60  # more lines hide each other
APART = 2.0  # clouds farther apart than this many of their sizes are small dots in one picture
THINNEST = 0.1  # side of the box around a flat cloud, per longest side

Corner = Float[np.ndarray, "3"]


class DrawnPair(NamedTuple):
    """Two clouds as drawn: about ``origin``, the target's middle, in their own unit.

    ``before`` (n, 3) and ``after`` are the source as given and moved. Where the clouds lie
    ``apart``, ``before`` is about its own middle instead. ``distance`` is that of each source
    point from the target; infinite where the pose is not finite. ``match`` (k, 2, 3) are the
    moved source point and the target point of the heaviest matches, ``agrees`` says which the
    pose brings together.
    """

    origin: Corner
    apart: bool
    before: Float[np.ndarray, "n 3"]
    after: Float[np.ndarray, "n 3"]
    target: Float[np.ndarray, "m 3"]
    source_overlap: Float[np.ndarray, " n"]
    target_overlap: Float[np.ndarray, " m"]
    distance: Float[np.ndarray, " n"]
    match: Float[np.ndarray, "k 2 3"]
    agrees: Bool[np.ndarray, " k"]


def select_points(
    alignment: Alignment, source: Float[np.ndarray, "n 3"], target: Float[np.ndarray, "m 3"]
) -> DrawnPair:
    """Choose what to draw of an alignment of these clouds: at most 10,000 points of each."""
    rows, columns = downsample(source, 1).dense, downsample(target, 1).dense
    origin = target[columns].mean(axis=0)
    start = source[rows].mean(axis=0)
    size = max(np.ptp(source[rows], axis=0).max(), np.ptp(target[columns], axis=0).max())
    apart = bool(np.linalg.norm(start - origin) > APART * size)
    moved = move(alignment.transform, source[rows]) - origin
    matches = alignment.matches
    drawn = slice(MATCHES_DRAWN)
    ends = np.stack(
        [
            move(alignment.transform, source[matches.source_rows[drawn]]) - origin,
            target[matches.target_rows[drawn]] - origin,
        ],
        axis=1,
    )
    return DrawnPair(
        origin=origin,
        apart=apart,
        before=source[rows] - (start if apart else origin),
        after=moved,
        target=target[columns] - origin,
        source_overlap=alignment.source_overlap[rows],
        target_overlap=alignment.target_overlap[columns],
        distance=_distance(moved, target[columns] - origin),
        match=ends,
        agrees=np.linalg.norm(ends[:, 0] - ends[:, 1], axis=1) <= alignment.inlier_distance,
    )


def box(points: Float[np.ndarray, "n 3"]) -> tuple[Corner, Corner]:
    """The lowest and the highest corner around all finite points, with some room."""
    points = points[np.isfinite(points).all(axis=1)]
    low, high = points.min(axis=0), points.max(axis=0)
    sides = high - low
    room = np.maximum(0.04 * sides, (THINNEST * sides.max() - sides) / 2)
    return low - room, high + room


def _distance(
    moved: Float[np.ndarray, "n 3"], target: Float[np.ndarray, "m 3"]
) -> Float[np.ndarray, " n"]:
    from scipy.spatial import cKDTree

    distance = np.full(len(moved), np.inf)
    finite = np.isfinite(moved).all(axis=1)
    distance[finite] = cKDTree(target).query(moved[finite])[0]
    return distance
