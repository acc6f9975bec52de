"""What can be known of a pose without the true one: residuals, information, free motions.

Everything here is NumPy in float64, at the network's scale (shapes in the unit sphere), with the
source already moved.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from dbdnet_jax.alignment.surfaces import Surface
from dbdnet_jax.types import Points

Direction = Float[np.ndarray, "3"]

# A motion is free when it changes the distances between the surfaces by less than this part of
# itself (root mean square); estimated normals of a noisy plane vary by about half of it.
DEGENERATE = 0.1
# Unless so many points change theirs by so much of what they move; near an axis nothing does.
STRONG, FEW, FEW_PART, STILL = 0.4, 20, 0.01, 0.02
# Of what stands off a plane: on 14 embedded shapes on wide floors, at the true pose, 4 to 33 % of
# it where the motion is held, and up to 11 % for a turn that nothing holds: rough normals.
RAISED_PART = {"translation": 0.03, "rotation": 0.15}
# Of `shared_point_score`: how near to 1 the ratio of distances is in 19 of 20 wrong poses of
# validation pairs (being an inlier favours the point's own distance), and points enough to tell.
CHANCE_RATIO = 0.95
ENOUGH_INLIERS = 1000


class Motion(NamedTuple):
    """A motion that the surfaces do not resist: along ``direction``, or about it."""

    kind: str  # "rotation" or "translation"
    direction: Direction


class PoseQuality(NamedTuple):
    """Source points (n) against the surface of the target.

    ``inlier[i]``: source point i has a target point within ``distance``. ``rmse`` is over these
    pairs, ``plane_rmse`` over their distances along the target's normals. ``information`` (6, 6)
    is that of the latter for a small rotation about ``pivot`` and a small translation, the
    noise's variance taken from the residuals; ``min_eigenvalue`` its smallest part per point,
    scaled to 0 (free) .. 1/3 (held the same from all sides).
    """

    inlier: Bool[np.ndarray, " n"]
    distance: float
    rmse: float
    plane_rmse: float
    information: Float[np.ndarray, "6 6"]
    pivot: Direction
    min_eigenvalue: float
    degenerate_motions: tuple[Motion, ...]


def assess_pose(moved: Points, target: Surface, distance: float) -> PoseQuality:
    """Compare a moved source with a target; fewer than six inliers leave every motion free."""
    found, rows = target.tree.query(moved, distance_upper_bound=distance)
    inlier = np.isfinite(found)
    if inlier.sum() < 6:
        axes = [Motion(kind, axis) for kind in ("rotation", "translation") for axis in np.eye(3)]
        nothing = np.zeros((6, 6)), moved.mean(axis=0), 0.0, tuple(axes)
        return PoseQuality(inlier, distance, np.inf, np.inf, *nothing)
    points, rows = moved[inlier], rows[inlier]
    normals = target.normals[rows]
    residual = ((points - target.points[rows]) * normals).sum(axis=1)
    plane_rmse = float(np.sqrt(np.mean(residual**2)))
    pivot = points.mean(axis=0)
    arm = points - pivot
    jacobian = np.hstack([np.cross(arm, normals), normals])
    held = jacobian.T @ jacobian
    length = max(float(np.sqrt((arm**2).sum(axis=1).mean())), 1e-12)
    unit = np.repeat([1 / length, 1.0], 3)
    min_eigenvalue, degenerate = _degenerate_motions(
        jacobian * unit, arm / length, distance / length
    )
    return PoseQuality(
        inlier,
        distance,
        float(np.sqrt(np.mean(found[inlier] ** 2))),
        plane_rmse,
        held / max(plane_rmse, 1e-6) ** 2,
        pivot,
        min_eigenvalue,
        degenerate,
    )


def shared_point_score(moved: Points, target: Surface, distance: float) -> float:
    """How much closer the inliers are to points of the target than a spacing beside them.

    From 0 to `CHANCE_RATIO`. Two drawings of one surface leave it at 0 in any pose; points that
    both clouds have in common show, and in the right pose only, even where the shape is symmetric.
    Not for clouds that a grid has downsampled: its cells may coincide.
    """
    found, rows = target.tree.query(moved, distance_upper_bound=distance)
    inliers = np.flatnonzero(np.isfinite(found))
    if len(inliers) < 6:
        return 0.0
    inliers = inliers[:: -(-len(inliers) // ENOUGH_INLIERS)]
    normals = target.normals[rows[inliers]]
    flattest = np.eye(3)[np.abs(normals).argmin(axis=1)]
    along = np.cross(normals, flattest)
    along *= target.spacing / np.linalg.norm(along, axis=1, keepdims=True)
    steps = np.stack([along, -along, np.cross(normals, along), np.cross(along, normals)])
    beside = np.minimum(target.tree.query(moved[inliers] + steps)[0], distance)
    usual = max(float(np.sqrt(np.mean(beside**2))), 1e-12)  # 0 where the target is one place
    return max(CHANCE_RATIO - float(np.sqrt(np.mean(found[inliers] ** 2))) / usual, 0.0)


def _degenerate_motions(
    jacobian: Float[np.ndarray, "n 6"], arm: Float[np.ndarray, "n 3"], distance: float
) -> tuple[float, tuple[Motion, ...]]:
    """The smallest eigenvalue of what the points hold, and the motions that nothing holds.

    Those are the ones whose eigenvalue is below DEGENERATE^2, but for those that a part of the
    points holds by themselves, as an object on a wide floor does. Translations first; rotations
    are then judged with the best translation beside each, so that a rotation about an axis
    elsewhere is found too.
    """
    held = jacobian.T @ jacobian / len(jacobian)
    values, axes = np.linalg.eigh(held[3:, 3:])
    slack = values < DEGENERATE**2
    raised = _off_the_plane(arm @ axes[:, -1], distance)
    motions = [
        Motion("translation", axis)
        for axis in axes.T[slack]
        if not _held_by_few(
            jacobian[:, 3:] @ axis, np.ones(len(arm)), raised, RAISED_PART["translation"]
        )
    ]
    stiff = axes[:, ~slack]
    coupling = held[:3, 3:] @ stiff
    about = held[:3, :3] - coupling @ np.diag(1 / values[~slack]) @ coupling.T
    turning, turns = np.linalg.eigh(about)
    for value, axis in zip(turning, turns.T, strict=True):
        shift = -stiff @ (coupling.T @ axis / values[~slack])
        change = jacobian @ np.concatenate([axis, shift])
        moved = np.linalg.norm(np.cross(axis, arm) + shift, axis=1)
        if value < DEGENERATE**2 and not _held_by_few(
            change, moved, raised, RAISED_PART["rotation"]
        ):
            motions.append(Motion("rotation", axis))
    return float(np.linalg.eigvalsh(held)[0]), tuple(motions)


def _off_the_plane(height: Float[np.ndarray, " n"], distance: float) -> Bool[np.ndarray, " n"]:
    """Which points stand off the plane that most lie on; all, where there is no such plane."""
    off = np.abs(height - np.median(height)) > distance
    return off if off.mean() < 0.5 else np.ones(len(off), bool)


def _held_by_few(
    change: Float[np.ndarray, " n"],
    moved: Float[np.ndarray, " n"],
    raised: Bool[np.ndarray, " n"],
    raised_part: float,
) -> bool:
    """Whether points enough change their distance from the surface by much of what they move.

    Enough of all points, or of those that stand off the plane: a wide floor makes these few.
    """
    strong = (np.abs(change) > STRONG * moved) & (moved > STILL)
    above = strong & raised
    return bool(
        (strong.sum() >= FEW and strong.mean() > FEW_PART)
        or (above.sum() >= FEW and above.sum() > raised_part * raised.sum())
    )


def in_words(motions: tuple[Motion, ...]) -> str:
    """For people: ``rotation about [0 0 1] and translation along [1 0 0]``."""
    phrases = []
    for kind, preposition in (("translation", "along"), ("rotation", "about")):
        axes = [motion.direction for motion in motions if motion.kind == kind]
        if len(axes) == 3:
            phrases.append(f"{kind} {preposition} every axis")
        elif len(axes) == 2:
            phrases.append(
                f"{kind} {preposition} every axis normal to {written(np.cross(axes[0], axes[1]))}"
            )
        elif axes:
            phrases.append(f"{kind} {preposition} {written(axes[0])}")
    return " and ".join(phrases)


def written(axis: Direction) -> str:
    """An axis by its upper end: ``[0 0.5 0.87]``."""
    upright = np.round(axis * np.sign(axis[np.abs(axis).argmax()]), 2) + 0.0  # no -0
    return f"[{' '.join(f'{x:.2g}' for x in upright)}]"
