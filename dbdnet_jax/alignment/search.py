"""Poses of one pair at the network's scale: the network's own, refined ones, and their rivals."""

from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from dbdnet_jax.model.config import ModelConfig
from dbdnet_jax.model.dbdnet import register
from dbdnet_jax.model.params import Params
from dbdnet_jax.ops.sampling import prefix_mask
from dbdnet_jax.polish import polish
from dbdnet_jax.programs import load_or_trace
from dbdnet_jax.types import Cloud, Rigid

Points = Float[np.ndarray, "n 3"]
OtherPoints = Float[np.ndarray, "m 3"]
Transform = Float[np.ndarray, "4 4"]

SMALLEST_BUCKET = 192
REFINE_POINTS = 3072  # at most, of each cloud: a matrix of all distances stays small
NEAR_DEG = (-30, 30)  # turns that may lead out of a local minimum, about the principal axes
FAR_DEG = (90, 180, 270)  # turns of symmetric shapes: they tell of doubt, and are not followed
DIFFERENT_DEG = 15.0  # from the pose, of what counts as a rival
NO_RIVAL = 3.0  # the margin where there is none
CLEARLY = 0.94  # of a misfit: better by 3 % of the distance

_PROGRAMS: dict[tuple[ModelConfig, int], Callable] = {}  # as jax.jit keeps its own


class Proposal(NamedTuple):
    """The network's answer, a row for every point it was given; see `types.Registration`."""

    transform: Transform
    source_overlap: Float[np.ndarray, " n"]
    target_overlap: Float[np.ndarray, " m"]
    source_kept: Bool[np.ndarray, " n"]
    mass: Float[np.ndarray, "n m"]  # mean of both branches
    confidence: Float[np.ndarray, " n"]
    valid: bool


class Rival(NamedTuple):
    """Another pose: how it differs, and the logarithm of its misfit per that of the pose."""

    angle_deg: float
    axis: Float[np.ndarray, "3"]
    margin: float


def ask_network(params: Params, source: Points, target: OtherPoints) -> Proposal:
    """Register two clouds of any size; programs are compiled for a few sizes only."""
    networks = jax.tree.map(
        lambda x: jnp.asarray(x, jnp.float32), (params.overlap, params.registration)
    )
    arguments = *networks, *(tuple(cloud) for cloud in _pad(source, target))
    program = _program(params.config, len(arguments[2][0]), *arguments)
    answer = jax.device_get(program(*arguments))
    rotation, translation, source_overlap, target_overlap, kept, mass, confidence, valid = answer
    n, m = len(source), len(target)
    return Proposal(
        as_transform(rotation, translation),
        source_overlap[:n],
        target_overlap[:m],
        kept[:n],
        mass[:n, :m],
        confidence[:n],
        bool(valid),
    )


def _program(config: ModelConfig, size: int, *arguments) -> Callable:
    """The compiled network of one configuration and size."""

    def network(overlap, registration, source, target):
        params = Params(overlap, registration, config)
        masks = (prefix_mask(size, count) for _, count in (source, target))
        answer = register(params, source[0], target[0], *masks)
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

    if (config, size) not in _PROGRAMS:
        _PROGRAMS[config, size] = load_or_trace(network, repr(config), *arguments)
    return _PROGRAMS[config, size]


def refine(transform: Transform, source: Points, target: OtherPoints) -> Transform:
    """The pose after `polish` on an even part of the clouds; exactly a rotation, in float64."""
    source, target = (x[:: -(-len(x) // REFINE_POINTS)] for x in (source, target))
    start = Rigid(
        jnp.asarray(transform[:3, :3], jnp.float32), jnp.asarray(transform[:3, 3], jnp.float32)
    )
    clouds = list(_pad(source, target))
    motion = jax.device_get(polish(clouds[0], clouds[1], start).target_from_source)
    return as_transform(motion.rotation, motion.translation)


def _pad(*clouds: np.ndarray) -> Iterator[Cloud]:
    """The clouds at the next of a few sizes: 192, 384, 768, 1536, ..."""
    size = SMALLEST_BUCKET
    while size < max(len(points) for points in clouds):
        size *= 2
    for points in clouds:
        padded = np.zeros((size, 3), np.float32)
        padded[: len(points)] = points
        yield Cloud(jnp.asarray(padded), jnp.asarray(len(points)))


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


def misfit(transform: Transform, source: Points, target: OtherPoints, distance: float) -> float:
    """Mean over both clouds of the squared distance to the other, no more than 1 a point.

    In units of ``distance`` squared: 0 is a perfect fit of everything, 1 none.
    """
    from scipy.spatial import cKDTree

    moved = move(transform, source)
    ways = (cKDTree(target).query(moved)[0], cKDTree(moved).query(target)[0])
    return float(np.mean([(np.minimum(found / distance, 1.0) ** 2).mean() for found in ways]))


def explore(pose: Transform, source: Points, target: OtherPoints, distance: float) -> Transform:
    """The refined pose, or a refined neighbour of it that fits clearly better.

    Slightly better is no reason: a wrong pose with more overlap may fit as well as the right one.
    """
    first = refine(pose, source, target)
    fit = misfit(first, source, target, distance)
    others = [refine(turned, source, target) for turned in _turns(pose, source, NEAR_DEG)]
    fits = [misfit(other, source, target, distance) for other in others]
    best = int(np.argmin(fits))
    return others[best] if fits[best] < CLEARLY * fit else first


def best_rival(pose: Transform, source: Points, target: OtherPoints, distance: float) -> Rival:
    """The best other pose among the refined turns of this one.

    A turn that falls back to the pose itself is no rival.
    """
    found = [Rival(180.0, np.eye(3)[0], NO_RIVAL)]
    own = misfit(pose, source, target, distance)
    for turned in _turns(pose, source, NEAR_DEG + FAR_DEG):
        other = refine(turned, source, target)
        angle, axis = angle_between(other, pose)
        if angle > DIFFERENT_DEG:
            ratio = (misfit(other, source, target, distance) + 1e-3) / (own + 1e-3)
            found.append(Rival(angle, axis, float(np.log(ratio))))
    return min(found, key=lambda rival: rival.margin)


def _turns(pose: Transform, source: Points, angles_deg: Sequence[int]) -> Iterator[Transform]:
    """The pose turned about each principal axis of the moved source."""
    from scipy.spatial.transform import Rotation

    moved = move(pose, source)
    middle = moved.mean(axis=0)
    for axis in np.linalg.eigh(np.cov(moved.T))[1].T:
        for degrees in angles_deg:
            turn = np.eye(4)
            turn[:3, :3] = Rotation.from_rotvec(degrees * axis, degrees=True).as_matrix()
            turn[:3, 3] = middle - turn[:3, :3] @ middle
            yield turn @ pose


def angle_between(a: Transform, b: Transform) -> tuple[float, Float[np.ndarray, "3"]]:
    """Degrees and axis of the rotation that leads from pose b to pose a."""
    from scipy.spatial.transform import Rotation

    vector = Rotation.from_matrix(a[:3, :3] @ b[:3, :3].T).as_rotvec(degrees=True)
    angle = float(np.linalg.norm(vector))
    return angle, vector / angle if angle else np.eye(3)[0]
