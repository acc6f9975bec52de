"""Poses of one pair at the network's scale: the network's, refined ones, alternatives."""

from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from dbdnet_jax.alignment.quality import inlier_distance
from dbdnet_jax.classical import refine as em_icp
from dbdnet_jax.io.programs import load_or_trace
from dbdnet_jax.networks.dbdnet.register import register_clouds
from dbdnet_jax.networks.params import Params
from dbdnet_jax.types import Cloud, Rigid

Points = Float[np.ndarray, "n 3"]
OtherPoints = Float[np.ndarray, "m 3"]
Transform = Float[np.ndarray, "4 4"]

SMALLEST_BUCKET = 192
SYMMETRY_DEG = (90.0, 180.0, 270.0)  # turns of symmetric shapes tell of doubt, and are not followed
CAP_PER_DISTANCE = 0.7  # the cap of residuals, per distance of inliers
DIFFERENT_DEG = 15.0  # from the pose, of what counts as a alternative
NO_ALTERNATIVE = 3.0  # the margin where there is none
ALTERNATIVE_MARGIN = 0.5  # one whose truncated RMSE is larger by this logarithm counts as 1/e

_PROGRAMS: dict[tuple[str, tuple], Callable] = {}  # by name and shapes, as jax.jit keeps its own


class NetworkPose(NamedTuple):
    """The network's answer, a row for every point it was given; see `types.Registration`."""

    transform: Transform
    source_overlap: Float[np.ndarray, " n"]
    target_overlap: Float[np.ndarray, " m"]
    source_kept: Bool[np.ndarray, " n"]
    mass: Float[np.ndarray, "n m"]  # mean of both branches
    confidence: Float[np.ndarray, " n"]
    valid: bool


class AlternativePose(NamedTuple):
    """The best other pose: how it differs, and the logarithm of its truncated RMSE per the pose's.

    ``alternatives`` counts the turns that end in another pose: one that fits as well or better
    as 1, the others as ``exp(-margin / 0.5)``. ``refinement_drift_deg`` is how far refining it once
    more moves the pose itself: little, where it is well held.
    """

    angle_deg: float
    axis: Float[np.ndarray, "3"]
    margin: float
    alternatives: float
    refinement_drift_deg: float


def predict_pose(params: Params, source: Points, target: OtherPoints) -> NetworkPose:
    """Register two clouds of any size; programs are compiled for a few sizes only."""
    config = params.config

    def network(weights, source, target):
        weights = jax.tree.map(lambda leaf: leaf.astype(jnp.float32), weights)
        answer = register_clouds(Params(weights, config), Cloud(*source), Cloud(*target))
        branches = answer.rotation_branch, answer.translation_branch
        return (
            answer.rotation,
            answer.translation,
            answer.src_overlap,
            answer.tgt_overlap,
            answer.src_kept,
            sum(branch.correspondence for branch in branches) / 2,
            answer.confidence,
            answer.valid,
        )

    answer = _run(repr(config), network, params.networks, *_pad(source, target))
    rotation, translation, source_overlap, target_overlap, kept, mass, confidence, valid = answer
    n, m = len(source), len(target)
    return NetworkPose(
        as_transform(rotation, translation),
        source_overlap[:n],
        target_overlap[:m],
        kept[:n],
        mass[:n, :m],
        confidence[:n],
        bool(valid),
    )


def refine(pose: Transform, source: Points, target: OtherPoints) -> Transform:
    """The pose after `classical.refine` on an even part of the clouds."""
    rotation, translation, *_ = _run_em_icp(em_icp.refine, pose, _even(source), _even(target))
    return as_transform(rotation, translation)


def _even(points: Points) -> Float[np.ndarray, "k 3"]:
    """As many points as `classical.refine` takes, evenly chosen."""
    size = min(len(points), em_icp.MOST_POINTS)
    return points[np.arange(size) * len(points) // size]


def refine_multistart(
    pose: Transform, source: Points, target: OtherPoints
) -> tuple[Transform, float]:
    """The refined pose, or a refined neighbour of it that fits clearly better; and its RMSE."""
    rotation, translation, rmse, _ = _run_em_icp(em_icp.refine_multistart, pose, source, target)
    return as_transform(rotation, translation), float(rmse)


def truncated_rmse(pose: Transform, source: Points, target: OtherPoints) -> float:
    """How badly a pose fits, a length; see `classical.refine`."""
    return float(_run_em_icp(em_icp.truncated_rmse, pose, source, target)[0])


def strongest_alternative(pose: Transform, source: Points, target: OtherPoints) -> AlternativePose:
    """The best other pose among the refined turns of this one.

    A turn that falls back to the pose itself, or to what refining would make of it, is none.
    """
    *motions, residuals, _, own = _run_em_icp(_all_turns, pose, source, target)
    cap = _cap(source, target)
    margins = np.log(((residuals / cap) ** 2 + 1e-3) / ((own / cap) ** 2 + 1e-3))
    others = [as_transform(*motion) for motion in zip(*motions, strict=True)]
    angles, axes = zip(*(angle_between(other, pose) for other in others), strict=True)
    apart = [angle_between(other, others[0])[0] for other in others]
    others_apart = np.flatnonzero(np.minimum(angles, apart) > DIFFERENT_DEG)
    if not others_apart.size:
        return AlternativePose(180.0, np.eye(3)[0], NO_ALTERNATIVE, 0.0, angles[0])
    best = others_apart[np.argmin(margins[others_apart])]
    count = np.exp(-np.maximum(margins[others_apart], 0.0) / ALTERNATIVE_MARGIN).sum()
    margin = min(float(margins[best]), NO_ALTERNATIVE)
    return AlternativePose(angles[best], axes[best], margin, float(count), angles[0])


def _all_turns(
    source: Cloud, target: Cloud, pose: Rigid, cap: jax.Array
) -> tuple[em_icp.Refined, jax.Array]:
    """The pose and its turns refined, and the truncated RMSE of the pose as it is."""
    turns = em_icp.RESTART_DEG + SYMMETRY_DEG
    found = em_icp.refine_from_rotations(source, target, pose, turns, cap)
    return found, em_icp.truncated_rmse(source, target, pose, cap)


def _run_em_icp(
    function: Callable, pose: Transform, source: Points, target: OtherPoints
) -> list[np.ndarray]:
    """The arrays that a function of `classical.refine` gives for the pose."""

    def arrays(source, target, start, cap):
        return tuple(jax.tree.leaves(function(Cloud(*source), Cloud(*target), Rigid(*start), cap)))

    start = tuple(jnp.asarray(part, jnp.float32) for part in (pose[:3, :3], pose[:3, 3]))
    cap = jnp.asarray(_cap(source, target), jnp.float32)
    return list(_run(function.__name__, arrays, *_pad(source, target), start, cap))


def _cap(source: Points, target: OtherPoints) -> float:
    """Of residuals: more than the spacing of the points, which of sparse clouds is wide."""
    return max(em_icp.CAP, CAP_PER_DISTANCE * inlier_distance(source, target))


def _run(name: str, function: Callable, *arguments: Any) -> Any:
    """The function's results on the host, through a program kept for arguments of these shapes."""
    key = name, tuple((leaf.shape, leaf.dtype) for leaf in jax.tree.leaves(arguments))
    if key not in _PROGRAMS:
        _PROGRAMS[key] = load_or_trace(function, name, *arguments)
    return jax.device_get(_PROGRAMS[key](*arguments))


def _pad(*clouds: np.ndarray) -> Iterator[tuple[jax.Array, jax.Array]]:
    """Points and count of clouds at the next of a few sizes: 192, 384, 768, 1536, ..."""
    size = SMALLEST_BUCKET
    while size < max(len(points) for points in clouds):
        size *= 2
    for points in clouds:
        padded = np.zeros((size, 3), np.float32)
        padded[: len(points)] = points
        yield jnp.asarray(padded), jnp.asarray(len(points))


def as_transform(rotation: Float[np.ndarray, "3 3"], translation) -> Transform:
    """A 4x4 float64 matrix; the rotation is the nearest one to the given matrix."""
    u, _, vt = np.linalg.svd(np.asarray(rotation, np.float64))
    transform = np.eye(4)
    transform[:3, :3] = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
    transform[:3, 3] = translation
    return transform


def move(transform: Transform, points: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 3"]:
    """A point or points under a 4x4 transform."""
    return points @ transform[:3, :3].T + transform[:3, 3]


def angle_between(a: Transform, b: Transform) -> tuple[float, Float[np.ndarray, "3"]]:
    """Degrees and axis of the rotation that leads from pose b to pose a."""
    from scipy.spatial.transform import Rotation

    vector = Rotation.from_matrix(a[:3, :3] @ b[:3, :3].T).as_rotvec(degrees=True)
    angle = float(np.linalg.norm(vector))
    return angle, vector / angle if angle else np.eye(3)[0]
