"""Pairs to fit the success probability on: validation shapes and synthetic scans, all of NumPy.

Any rotation or the paper's, overlaps from 20 to 100 %, noise or none, shared points or none,
scattered outliers, a heap far away, an object on a floor, and dense clouds of procedural solids.
"""

from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from dbdnet_jax.data.cad import cad_split
from dbdnet_jax.data.procedural.shapes import procedural_solid
from dbdnet_jax.data.surface import sample_surface
from dbdnet_jax.ops.transforms import as_transform, move
from dbdnet_jax.types import Points, Transform

Rng = np.random.Generator

DENSE_PART, FLOOR_PART, CLUTTER_PART = 0.4, 0.25, 0.15
PROCEDURAL = 7919  # of the seed: no solid that training draws


class ScanPair(NamedTuple):
    """Two clouds, the transform between them, and the number of the shape."""

    source: Points
    target: Points
    target_from_source: Transform
    shape: int


def scan_pair(number: int, seed: int = 77) -> ScanPair:
    """The pair of a number: the same always."""
    rng = np.random.default_rng((seed, number))
    dense = rng.random() < DENSE_PART
    shape = 100_000 + number if dense else number % 97
    views = _dense_views(rng, number) if dense else _cad_views(rng, shape)
    clouds = [_cut(rng, view) for view in views]
    if dense and rng.random() < FLOOR_PART:
        clouds = _on_a_floor(rng, clouds)
    sigma = float(rng.choice([0.0, 0.003, 0.01])) * (0.5 if dense else 1.0)
    clouds = [cloud + rng.normal(0, sigma, cloud.shape) for cloud in clouds]
    if rng.random() < CLUTTER_PART:
        clouds = [_cluttered(rng, cloud) for cloud in clouds]
    source_from_target = _motion(rng)
    return ScanPair(
        move(source_from_target, clouds[0]), clouds[1], np.linalg.inv(source_from_target), shape
    )


def _cad_views(rng: Rng, shape: int) -> list[Points]:
    """Twice 1024 of a validation shape's points, drawn independently or from two halves."""
    points = np.asarray(cad_split("val").points[shape], np.float64)
    if rng.random() < 1 / 3:
        return [points[:1024], points[1024:]]
    return [points[rng.permutation(len(points))[:1024]] for _ in range(2)]


def _dense_views(rng: Rng, number: int) -> list[Points]:
    """Two independent samples of a procedural solid in the unit sphere."""
    soup = procedural_solid(np.random.default_rng((PROCEDURAL, number)))[1]
    vertices = soup.reshape(-1, 3)
    triangles = np.arange(len(vertices)).reshape(-1, 3)
    count = int(np.exp(rng.uniform(np.log(3000), np.log(20_000))))
    views = [sample_surface(vertices, triangles, count, rng)[0] for _ in range(2)]
    middle = views[0].mean(axis=0)
    size = np.linalg.norm(views[0] - middle, axis=1).max()
    return [(view - middle) / size for view in views]


def _cut(rng: Rng, points: Points) -> Points:
    """The part of a cloud on one side of a random plane."""
    direction = rng.normal(size=3)
    keep = rng.uniform(0.45, 1.0)
    along = points @ direction
    return points[along >= np.quantile(along, 1 - keep)]


def _on_a_floor(rng: Rng, clouds: list[Points]) -> list[Points]:
    """Both views with the floor that the shape stands on, y up."""
    low = min(cloud[:, 1].min() for cloud in clouds)
    width = rng.uniform(0.8, 2.0)
    floors = []
    for cloud in clouds:
        across = rng.uniform(-width, width, (int(len(cloud) * rng.uniform(0.5, 2.0)), 2))
        floors.append(np.column_stack([across[:, 0], np.full(len(across), low), across[:, 1]]))
    return [np.vstack(parts) for parts in zip(clouds, floors, strict=True)]


def _cluttered(rng: Rng, cloud: Points) -> Points:
    """A cloud with scattered points around it, or with a heap far away."""
    count = int(rng.uniform(0.01, 0.1) * len(cloud))
    if rng.random() < 0.5:
        extra = rng.uniform(-1, 1, (count, 3)) * rng.uniform(1.0, 4.0)
    else:
        direction = rng.normal(size=3)
        place = rng.uniform(2.0, 5.0) * direction / np.linalg.norm(direction)
        extra = place + 0.1 * rng.normal(size=(count, 3))
    return np.vstack([cloud, extra])


def _motion(rng: Rng) -> Transform:
    """Half of the motions as in the paper, the others of any rotation."""
    if rng.random() < 0.5:
        turn = Rotation.from_euler("xyz", rng.uniform(-45, 45, 3), degrees=True)
    else:
        turn = Rotation.from_quat(rng.normal(size=4))
    return as_transform(turn.as_matrix(), rng.uniform(-1, 1, 3))
