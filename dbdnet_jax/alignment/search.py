"""From two normalised clouds to the pose, what else fits, and what speaks for it."""

import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from dbdnet_jax.alignment import pose_programs
from dbdnet_jax.alignment.candidates import (
    ALIKE,
    Candidate,
    choose,
    different,
    examine,
    far_starts,
    merged,
    near_starts,
    rank,
)
from dbdnet_jax.alignment.consensus import MatchedPoints, agreed_poses, agreement, match_surfaces
from dbdnet_jax.alignment.normalised import NormalisedPair, is_full_resolution
from dbdnet_jax.alignment.point_to_plane import refine_point_to_plane
from dbdnet_jax.alignment.pose_programs import NetworkPose
from dbdnet_jax.alignment.quality import PoseQuality, assess_pose, shared_point_score
from dbdnet_jax.alignment.success import (
    Coefficients,
    PoseFeatures,
    fit_features,
    success_probability,
)
from dbdnet_jax.alignment.surfaces import Surface, inlier_distance
from dbdnet_jax.networks.params import Params
from dbdnet_jax.ops.transforms import angle_between, move
from dbdnet_jax.types import Transform

LIKELY = 0.5  # success probability of a valid pose
NEAR_DEG = 60.0  # how far from the given orientation a pose may turn that counts as near it
CONFIDENT = 0.9  # of a pose near the given orientation: no other rotations are searched
SPARSE = 2000  # points: of fewer, soft matching tells more than nearest neighbours do
# Of sparse clouds: by how much what is searched must fit better than the network's refined pose, in
# logarithms of the truncated RMSE; less where refining had turned that one far. A logarithm of the
# matches that agree counts as so much of it.
LEFT_FOR, LEFT_FOR_TURN, PER_MATCH = 0.29, 0.06, 0.1
# Of the last step, per inlier distance: first of the even points, then of all. Of 49 synthetic
# scans the median error is that of all points from the first (0.046 and 0.048 degrees), in half
# the time.
EVEN_RADII, LAST_RADII = (0.7,) * 4, (0.4,) * 8
NO_OTHER = 4.0  # the margin where nothing else fits, and the most it counts


class Clues(NamedTuple):
    """What is known of a pair before its pose is searched."""

    predicted: NetworkPose
    matched: MatchedPoints


class Found(NamedTuple):
    """The answer in the frame of a `NormalisedPair`, and all that is known of it."""

    pose: Transform
    score: float  # before the last step, as the others' are
    others: list[Candidate]  # different poses, best first
    margin: float  # score of the pose less that of the best other one
    clues: Clues
    quality: PoseQuality
    evidence: PoseFeatures
    probability: float
    everywhere: bool
    refined: bool = True

    @property
    def predicted(self) -> NetworkPose:
        """The network's answer."""
        return self.clues.predicted


def find_pose(
    params: Params,
    scene: NormalisedPair,
    coefficients: Coefficients,
    how: str,
    *,
    refine: bool,
    guess: Transform | None,
    proposals: list[Transform],
) -> Found:
    """Search near the given orientation, and everywhere where that is asked for or needed.

    Without ``refine`` the network's pose, the guess and the proposals are judged as they are.
    """
    source, target = scene.source.surface, scene.target.surface
    clues = find_clues(params, scene)
    predicted = clues.predicted
    given = proposals if guess is None else [guess, *proposals]
    if not refine:
        poses = rank([predicted.transform, *given], source, target, coefficients)
        return settle(scene, poses, clues, coefficients, guess, everywhere=False, refined=False)
    first = [] if guess is not None else incumbent(predicted, source, target, coefficients)
    agreed = agreed_poses(clues.matched)
    if how == "near":
        agreed = [pose for pose in agreed if angle_between(pose, np.eye(4))[0] < NEAR_DEG]
    starts = near_starts(predicted.transform, source) + given
    near = examine(starts, source, target, coefficients, close=given + agreed)
    near = behind(first, near, source)
    found = settle(scene, near, clues, coefficients, guess, everywhere=False)
    if how == "near" or (how == "auto" and found.probability >= CONFIDENT):
        return found
    far = examine(far_starts(source, target), source, target, coefficients)
    every = merged(near, far, middle=source.points.mean(axis=0))
    every = behind(first, every, source)
    return settle(scene, every, clues, coefficients, guess, everywhere=True)


def find_clues(params: Params, scene: NormalisedPair) -> Clues:
    """Ask the network, and match the surfaces by what they look like."""
    predicted = pose_programs.predict_pose(params, scene.source.sparse, scene.target.sparse)
    return Clues(predicted, match_surfaces(scene.source.surface, scene.target.surface))


def is_sparse(source: Surface, target: Surface) -> bool:
    """Whether a cloud has so few points that its normals are rough."""
    return min(len(side.points) for side in (source, target)) < SPARSE


def incumbent(
    predicted: NetworkPose, source: Surface, target: Surface, coefficients: Coefficients
) -> list[Candidate]:
    """Of sparse clouds the network's pose as soft matching refines it; of others nothing."""
    if not is_sparse(source, target):
        return []
    clouds = even_points(source), even_points(target)
    return rank(
        [pose_programs.refine_multistart(predicted.transform, *clouds)],
        source,
        target,
        coefficients,
    )


def behind(first: list[Candidate], candidates: list[Candidate], source: Surface) -> list[Candidate]:
    """The candidates behind the one that comes first, if any: those that are other poses."""
    if not first:
        return candidates
    return first + different(candidates, first[0], source.points.mean(axis=0))


def even_points(side: Surface) -> Float[np.ndarray, "e 3"]:
    """The points that cover a surface evenly."""
    return side.points[side.even]


def stay_or_leave(
    candidates: list[Candidate], clues: Clues, source: Surface, target: Surface
) -> int:
    """The row of the answer for sparse clouds: the first, or one that fits clearly better."""
    clouds = even_points(source), even_points(target)
    rmse = np.array([pose_programs.truncated_rmse(x.pose, *clouds) for x in candidates])
    agreeing = np.array([agreement(x.pose, clues.matched) for x in candidates])
    fits = PER_MATCH * np.log1p(agreeing) - np.log(np.maximum(rmse, 1e-9))
    turned = angle_between(candidates[0].pose, clues.predicted.transform)[0]
    best = int(fits.argmax())
    return best if fits[best] > fits[0] + LEFT_FOR - LEFT_FOR_TURN * math.log1p(turned) else 0


def settle(
    scene: NormalisedPair,
    candidates: list[Candidate],
    clues: Clues,
    coefficients: Coefficients,
    guess: Transform | None,
    *,
    everywhere: bool,
    refined: bool = True,
) -> Found:
    """Choose one of the candidates, refine it on all points, and say what speaks for it."""
    source, target = scene.source.surface, scene.target.surface
    if refined and guess is None and is_sparse(source, target):
        row = stay_or_leave(candidates, clues, source, target)
    else:
        row = choose(candidates, guess, source.points.mean(axis=0))
    chosen = candidates[row]
    others = sorted(candidates[:row] + candidates[row + 1 :], key=lambda x: -x.score)
    final = last_refined(chosen, source, target, coefficients) if refined else chosen
    distance = inlier_distance(source, target)
    moved = move(final.pose, source.points)
    quality = assess_pose(moved, target, distance)
    shared = shared_point_score(moved, target, distance) if is_full_resolution(scene) else 0.0
    # The others have not seen the last step: what it adds is no merit.
    margin = min(chosen.score - others[0].score, NO_OTHER) if others else NO_OTHER
    alike = [math.exp(min(other.score - chosen.score, 0.0)) for other in others]
    evidence = PoseFeatures(
        *fit_features(final.fit),
        shared_point_score=shared,
        overlap_agreement=_overlap_agreement(scene, clues.predicted, final.pose, distance),
        min_eigenvalue=math.log(max(quality.min_eigenvalue, 1e-6)),
        network_angle=math.log1p(angle_between(final.pose, clues.predicted.transform)[0]),
        last_step_angle=math.log1p(angle_between(final.pose, chosen.pose)[0]),
        ambiguity_margin=margin,
        ambiguity_count=float(sum(alike)),
        agreeing_matches=math.log1p(agreement(final.pose, clues.matched)),
        turn=math.log1p(angle_between(final.pose, np.eye(4))[0]),
        everywhere=float(everywhere),
    )
    probability = success_probability(evidence, coefficients)
    return Found(
        final.pose,
        chosen.score,
        others,
        margin,
        clues,
        quality,
        evidence,
        probability,
        everywhere,
        refined,
    )


def last_refined(
    candidate: Candidate, source: Surface, target: Surface, coefficients: Coefficients
) -> Candidate:
    """The candidate after refinement on all points, unless that fits worse."""
    if is_sparse(source, target):
        pose = pose_programs.refine(candidate.pose, even_points(source), even_points(target))
        return rank([pose], source, target, coefficients)[0]
    distance = inlier_distance(source, target)
    pose = candidate.pose
    for parts, rows in ((EVEN_RADII, source.even), (LAST_RADII, None)):
        radii = tuple(part * distance for part in parts)
        pose = refine_point_to_plane(pose, source, target, radii, rows)
    refined = rank([pose], source, target, coefficients)[0]
    return refined if refined.score > candidate.score - ALIKE else candidate


def _overlap_agreement(
    scene: NormalisedPair, predicted: NetworkPose, pose: Transform, distance: float
) -> float:
    """The mean probability that the network gives to what the pose says of each point."""
    forth = scene.target.surface.tree.query(move(pose, scene.source.sparse))[0] < 2 * distance
    back = np.linalg.inv(pose)
    back_again = scene.source.surface.tree.query(move(back, scene.target.sparse))[0] < 2 * distance
    pairs = ((predicted.source_overlap, forth), (predicted.target_overlap, back_again))
    return float(np.mean([np.where(near, p, 1 - p).mean() for p, near in pairs]))
