"""Poses that may be the right one: from proposals through refinement to a ranked list."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from dbdnet_jax.alignment import pose_programs
from dbdnet_jax.alignment.point_to_plane import refine_point_to_plane
from dbdnet_jax.alignment.success import Coefficients, fit_score
from dbdnet_jax.alignment.surfaces import PoseFit, Surface, inlier_distance, measure_fit
from dbdnet_jax.ops.transforms import (
    angle_between,
    as_transform,
    cube_rotations,
    move,
    turn_deg,
)
from dbdnet_jax.types import Transform

RESTART_DEG = (-30.0, 30.0)  # turns about the principal axes: they lead out of local minima
KEPT = 12  # of the coarsely refined poses; the right one is not always among the first six
# Of those that are ranked: of 237 searches of synthetic scans two had their best pose further down.
REFINED_AGAIN = 4
DIFFERENT_DEG, DIFFERENT = 15.0, 0.2  # degrees, and length: what counts as another pose
# Of the score, a logarithm of odds: less is no difference. With a guess, it takes more to leave it.
ALIKE, CLEARLY = 0.5, 3.0
NEAR_GUESS_DEG, NEAR_GUESS = 30.0, 0.4


class Candidate(NamedTuple):
    """A refined pose, how it fits, and the score that ranks it."""

    pose: Transform
    fit: PoseFit
    score: float


def near_starts(pose: Transform, source: Surface) -> list[Transform]:
    """A pose and its turns about the principal axes through the moved source's middle."""
    moved = move(pose, source.points)
    middle = moved.mean(axis=0)
    axes = np.linalg.svd(moved - middle, full_matrices=False)[2]
    return [pose, *(_turned(pose, middle, x, a) for a in RESTART_DEG for x in axes)]


def far_starts(
    source: Surface, target: Surface, turns: Float[np.ndarray, "k 3 3"] | None = None
) -> list[Transform]:
    """The source turned by each rotation, the cube's 24 if None, its middle on the target's."""
    turns = cube_rotations() if turns is None else turns
    middles = source.points[source.even].mean(axis=0), target.points[target.even].mean(axis=0)
    return [as_transform(turn, middles[1] - turn @ middles[0]) for turn in turns]


def _turned(pose: Transform, middle: np.ndarray, axis: np.ndarray, degrees: float) -> Transform:
    from scipy.spatial.transform import Rotation

    turn = Rotation.from_rotvec(degrees * axis, degrees=True).as_matrix()
    return as_transform(turn @ pose[:3, :3], turn @ (pose[:3, 3] - middle) + middle)


def examine(
    starts: list[Transform],
    source: Surface,
    target: Surface,
    coefficients: Coefficients,
    *,
    keep: int = KEPT,
    close: list[Transform] | None = None,
) -> list[Candidate]:
    """Refine starts on few points, the best of them on more, and rank what is left, best first.

    Poses that are ``close`` to the truth if they are right at all leave out the first step, whose
    wide radius would pull them away where little overlaps.
    """
    rough, residuals = pose_programs.refine_each(starts, source, target, pose_programs.COARSE)
    middle = source.points.mean(axis=0)
    rough = [rough[row] for row in _distinct(rough, residuals, middle)[:keep]] + (close or [])
    fine, residuals = pose_programs.refine_each(rough, source, target, pose_programs.FINE)
    poses = [fine[row] for row in _distinct(fine, residuals, middle)]
    # Normals of few points are rough: there, soft matching may have been nearer the truth.
    soft = rank(poses, source, target, coefficients)
    poses = [
        refined_on_even_points(candidate.pose, source, target) for candidate in soft[:REFINED_AGAIN]
    ]
    return merged(soft, rank(poses, source, target, coefficients), middle=middle)


def refined_on_even_points(pose: Transform, source: Surface, target: Surface) -> Transform:
    """The pose after a few steps of point-to-plane ICP of the source's even points."""
    distance = inlier_distance(source, target)
    radii = tuple(max(least, by * distance) for least, by in ((0.06, 2.0), (0.04, 1.5)))
    return refine_point_to_plane(pose, source, target, (*radii, *(distance,) * 4), rows=source.even)


def rank(
    poses: list[Transform], source: Surface, target: Surface, coefficients: Coefficients
) -> list[Candidate]:
    """Measure poses, and sort them by score, one of those that are the same."""
    distance = inlier_distance(source, target)
    fits = [measure_fit(pose, source, target, distance) for pose in poses]
    scores = np.array([fit_score(fit, coefficients) for fit in fits])
    rows = _distinct(poses, -scores, source.points.mean(axis=0))
    return [Candidate(poses[row], fits[row], float(scores[row])) for row in rows]


def merged(*lists: list[Candidate], middle: Float[np.ndarray, "3"]) -> list[Candidate]:
    """Candidates of several lists as one, best first, each pose once."""
    every = [candidate for some in lists for candidate in some]
    rows = _distinct([x.pose for x in every], -np.array([x.score for x in every]), middle)
    return [every[row] for row in rows]


def different(
    candidates: list[Candidate], other: Candidate, middle: Float[np.ndarray, "3"]
) -> list[Candidate]:
    """The candidates that are other poses than one."""
    return [x for x in candidates if _differ(x.pose, other.pose, middle)]


def choose(
    candidates: list[Candidate], guess: Transform | None, middle: Float[np.ndarray, "3"]
) -> int:
    """The row of the answer: of those that fit alike, the one nearest to the given orientation.

    With a guess, what lies near it is left only for what fits clearly better.
    """
    scores = np.array([candidate.score for candidate in candidates])
    if guess is not None:
        near = [not _differ(x.pose, guess, middle, NEAR_GUESS_DEG, NEAR_GUESS) for x in candidates]
        rows = np.flatnonzero(near & (scores > scores.max() - CLEARLY))
        if len(rows):
            return int(rows[scores[rows].argmax()])
    alike = np.flatnonzero(scores > scores.max() - ALIKE)
    turns = turn_deg(np.array([candidates[row].pose[:3, :3] for row in alike]))
    return int(alike[turns.argmin()])


def _distinct(
    poses: list[Transform], costs: Float[np.ndarray, " k"], middle: Float[np.ndarray, "3"]
) -> list[int]:
    """Rows of poses that differ from each other, cheapest first."""
    kept: list[int] = []
    for row in np.argsort(costs, kind="stable"):
        if all(_differ(poses[row], poses[other], middle) for other in kept):
            kept.append(int(row))
    return kept


def _differ(
    a: Transform,
    b: Transform,
    middle: Float[np.ndarray, "3"],
    degrees: float = DIFFERENT_DEG,
    length: float = DIFFERENT,
) -> bool:
    """Whether two poses are more than slightly apart."""
    if float(np.linalg.norm(move(a, middle) - move(b, middle))) > length:
        return True
    return angle_between(a, b)[0] > degrees
