"""What makes poses of one pair, through programs kept for a few sizes: network and refinement."""

from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from dbdnet_jax.alignment.surfaces import Surface
from dbdnet_jax.classical import refine as em_icp
from dbdnet_jax.io.programs import load_or_trace
from dbdnet_jax.networks.dbdnet.register import register_clouds
from dbdnet_jax.networks.params import Params
from dbdnet_jax.ops.transforms import as_transform
from dbdnet_jax.types import Cloud, OtherPoints, Points, Rigid, Transform

Arrays = tuple[Any, ...]  # of arrays, or of such tuples: all that a kept program takes and gives

SMALLEST_BUCKET = 192


class Level(NamedTuple):
    """How poses are refined: on how many points, how many poses at once, and with what radii."""

    points: int
    batch: int
    schedule: em_icp.Schedule


# By judgement: radii that catch any rotation of the cube group, and points that are enough for it.
COARSE = Level(256, 8, em_icp.Schedule(first=0.4, last=0.12, iterations=15, cap=0.15))
FINE = Level(512, 4, em_icp.Schedule(first=0.16, last=0.06, iterations=12, cap=0.08))

_PROGRAMS: dict[tuple[str, tuple], Callable] = {}  # by name and shapes, as jax.jit keeps its own


class NetworkPose(NamedTuple):
    """The network's answer, a row for every point it was given; see `types.Registration`."""

    transform: Transform
    source_overlap: Float[np.ndarray, " n"]
    target_overlap: Float[np.ndarray, " m"]
    mass: Float[np.ndarray, "n m"]  # mean of both branches


def predict_pose(params: Params, source: Points, target: OtherPoints) -> NetworkPose:
    """Register two clouds of any size; programs are compiled for a few sizes only."""
    config = params.config

    def network(weights: Any, source: Arrays, target: Arrays) -> Arrays:
        weights = jax.tree.map(lambda leaf: leaf.astype(jnp.float32), weights)
        answer = register_clouds(Params(weights, config), Cloud(*source), Cloud(*target))
        branches = answer.rotation_branch, answer.translation_branch
        return (
            answer.rotation,
            answer.translation,
            answer.src_overlap,
            answer.tgt_overlap,
            sum(branch.correspondence for branch in branches) / 2,
        )

    answer = _run(repr(config), network, params.networks, *_pad(source, target))
    rotation, translation, source_overlap, target_overlap, mass = answer
    n, m = len(source), len(target)
    return NetworkPose(
        as_transform(rotation, translation),
        source_overlap[:n],
        target_overlap[:m],
        mass[:n, :m],
    )


def refine(pose: Transform, source: Points, target: OtherPoints) -> Transform:
    """The pose after `classical.refine`, which takes the first 1,024 points of each cloud."""
    rotation, translation, *_ = _run_em_icp(em_icp.refine, pose, source, target)
    return as_transform(rotation, translation)


def refine_multistart(pose: Transform, source: Points, target: OtherPoints) -> Transform:
    """The refined pose, or a refined turn of it that fits clearly better; as `refine`."""
    rotation, translation, *_ = _run_em_icp(em_icp.refine_multistart, pose, source, target)
    return as_transform(rotation, translation)


def truncated_rmse(pose: Transform, source: Points, target: OtherPoints) -> float:
    """How badly a pose fits, a length; see `classical.refine`."""
    return float(_run_em_icp(em_icp.truncated_rmse, pose, source, target)[0])


def refine_each(
    starts: list[Transform], source: Surface, target: Surface, level: Level
) -> tuple[list[Transform], Float[np.ndarray, " k"]]:
    """Poses refined, each for itself, on the first even points, and their truncated RMSE."""

    def run(source: Arrays, target: Arrays, normals: Arrays, starts: Arrays) -> Arrays:
        clouds = Cloud(*source), Cloud(*target)
        poses, rmse = em_icp.refine_each(*clouds, normals, Rigid(*starts), level.schedule)
        return poses.rotation, poses.translation, rmse

    rows = [side.even[: level.points] for side in (source, target)]
    clouds, normals = (
        [_padded(values[row], level.points) for values, row in zip(parts, rows, strict=True)]
        for parts in ((source.points, target.points), (source.normals, target.normals))
    )
    counted = [(points, np.int32(len(row))) for points, row in zip(clouds, rows, strict=True)]
    found, residuals = [], []
    for first in range(0, len(starts), level.batch):
        some = np.array(starts[first : first + level.batch], np.float32)
        batch = np.repeat(np.eye(4, dtype=np.float32)[None], level.batch, axis=0)
        batch[: len(some)] = some
        poses = batch[:, :3, :3], batch[:, :3, 3]
        *motions, rmse = _run(f"refine_each {level}", run, *counted, tuple(normals), poses)
        pairs = zip(*motions, strict=True)
        found += [as_transform(*motion) for motion, _ in zip(pairs, some, strict=False)]
        residuals.append(rmse[: len(some)])
    return found, np.concatenate(residuals)


def _run_em_icp(
    function: Callable, pose: Transform, source: Points, target: OtherPoints
) -> list[np.ndarray]:
    """The arrays that a function of `classical.refine` gives for the pose."""

    def arrays(source: Arrays, target: Arrays, start: Arrays, cap: jax.Array) -> Arrays:
        return tuple(jax.tree.leaves(function(Cloud(*source), Cloud(*target), Rigid(*start), cap)))

    clouds = _pad(source[: em_icp.MOST_POINTS], target[: em_icp.MOST_POINTS])
    start = tuple(np.asarray(part, np.float32) for part in (pose[:3, :3], pose[:3, 3]))
    return list(_run(function.__name__, arrays, *clouds, start, np.float32(em_icp.CAP)))


def _run(name: str, function: Callable, *arguments: Any) -> Any:
    """The function's results on the host, through a program kept for arguments of these shapes."""
    with jax.enable_x64(False):  # what the weights were trained in; counts are int32
        arguments = jax.device_put(arguments)  # jnp.asarray would compile a cast for every shape
        key = name, tuple((leaf.shape, leaf.dtype) for leaf in jax.tree.leaves(arguments))
        if key not in _PROGRAMS:
            _PROGRAMS[key] = load_or_trace(function, name, *arguments)
        return jax.device_get(_PROGRAMS[key](*arguments))


def _pad(*clouds: np.ndarray) -> Iterator[tuple[np.ndarray, np.int32]]:
    """Points and count of clouds at the next of a few sizes: 192, 384, 768, 1536, ..."""
    size = SMALLEST_BUCKET
    while size < max(len(points) for points in clouds):
        size *= 2
    for points in clouds:
        yield _padded(points, size), np.int32(len(points))


def _padded(points: np.ndarray, size: int) -> Float[np.ndarray, "size 3"]:
    padded = np.zeros((size, 3), np.float32)
    padded[: len(points)] = points
    return padded
