"""A pair at the network's scale, and the way back to the clouds as given."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from dbdnet_jax.alignment.downsampling import Downsampled, downsample
from dbdnet_jax.alignment.surfaces import Surface, surface
from dbdnet_jax.data.pairs import UNIT_SIZE
from dbdnet_jax.io.point_files import MIN_POINTS
from dbdnet_jax.ops.transforms import as_transform, move
from dbdnet_jax.types import OtherPoints, Points, Transform


class NormalisedCloud(NamedTuple):
    """One cloud as given, the rows chosen of it, and these at the network's scale as a surface."""

    points: Points
    downsampled: Downsampled
    surface: Surface
    sparse: Float[np.ndarray, "s 3"]


class NormalisedPair(NamedTuple):
    """Both clouds, each about its own centre, the source turned by the guess, one scale.

    ``factor`` leads from the given unit to the network's.
    """

    source: NormalisedCloud
    target: NormalisedCloud
    factor: float
    guess: Transform


def normalise_pair(
    source: Points,
    target: OtherPoints,
    scale: float | str,
    max_points: int,
    guess: Transform | None = None,
) -> NormalisedPair:
    """Downsample, centre, turn (by the guess, if any) and scale two clouds, in float64.

    Raises:
      ValueError: a cloud whose points are at too few places, or a scale beyond float32.
    """
    guess = np.eye(4) if guess is None else guess
    downsampled = downsample(source, max_points), downsample(target, max_points)
    for name, rows in zip(("source", "target"), downsampled, strict=True):
        if len(rows.sparse) < MIN_POINTS:
            raise ValueError(
                f"{name} must have points at {MIN_POINTS} places at least; got "
                f"{len(rows.sparse)}. Give more points."
            )
    size = max(rows.size for rows in downsampled)
    factor = UNIT_SIZE / size if scale == "auto" else float(scale)
    if not 1e-6 <= size * factor <= 1e6:
        raise ValueError(
            f"scale must bring the clouds to a size from 1e-6 to 1e6, of which the weights know "
            f"{UNIT_SIZE:g}; scale={factor:g} makes {size * factor:g} of {size:g}. Use 'auto'."
        )

    def side(points: np.ndarray, rows: Downsampled, turn: np.ndarray) -> NormalisedCloud:
        dense = (points[rows.dense] - rows.centre) @ turn.T * factor
        sparse = dense[rows.even[: len(rows.sparse)]]
        return NormalisedCloud(points, rows, surface(dense, rows.even), sparse)

    return NormalisedPair(
        side(source, downsampled[0], guess[:3, :3]),
        side(target, downsampled[1], np.eye(3)),
        factor,
        guess,
    )


def as_normalised(transform: Transform, scene: NormalisedPair) -> Transform:
    """A transform of the clouds as given as a pose of the scene; undoes `as_given`."""
    pose = as_transform(transform[:3, :3] @ scene.guess[:3, :3].T, np.zeros(3))
    moved = move(transform, scene.source.downsampled.centre)
    pose[:3, 3] = (moved - scene.target.downsampled.centre) * scene.factor
    return pose


def as_given(pose: Transform, scene: NormalisedPair) -> Transform:
    """A pose of the scene as one of the clouds as given."""
    transform = as_transform(pose[:3, :3] @ scene.guess[:3, :3], np.zeros(3))
    moved = transform[:3, :3] @ scene.source.downsampled.centre
    transform[:3, 3] = pose[:3, 3] / scene.factor + scene.target.downsampled.centre - moved
    return transform


def is_full_resolution(scene: NormalisedPair) -> bool:
    """Whether a pose is judged on all points of both clouds, but for outliers and copies."""
    sides = scene.source, scene.target
    return all(
        len(rows.dense) + rows.outliers + rows.copies == len(side.points)
        for side in sides
        for rows in [side.downsampled]
    )


def size_ratio(scene: NormalisedPair) -> float:
    """The larger cloud's size per the smaller one's."""
    sizes = scene.source.downsampled.size, scene.target.downsampled.size
    return max(sizes) / min(sizes)
