"""Pairs to be spoiled."""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from dbdnet_jax.data.cad import cad_split
from dbdnet_jax.data.procedural.shapes import procedural_shapes
from dbdnet_jax.data.symmetry import symmetric_shapes
from dbdnet_jax.ops.transforms import move, transform_of
from dbdnet_jax.types import Points, Transform

TURNED_DEG = 30.0
KEPT = 0.7  # part of each cloud beyond a plane of its own
HANDED_SEED = 4001  # no seed of a training's
QUERIES, UNLIKE = 512, 2.0  # points that are reflected; their mean distance per spacing


class Drawn(NamedTuple):
    """Two partial drawings of one shape and the transform between them."""

    source: Points
    target: Points
    target_from_source: Transform


def drawn_pairs(count: int, *, handed: bool = False) -> Iterator[tuple[Drawn, np.random.Generator]]:
    """Pairs of validation shapes in turn, and what draws the rest of each.

    Where ``handed``, of generated solids that a mirror shows otherwise.
    """
    if handed:
        shapes = procedural_shapes(4 * count, seed=HANDED_SEED).points.astype(np.float64)
        shapes = shapes[[is_handed(shape) for shape in shapes]]
    else:
        shapes = cad_split("val").points.astype(np.float64)
    shapes = shapes[~symmetric_shapes(shapes)]
    for number in range(count):
        rng = np.random.default_rng((2026, number))
        points = rng.permutation(shapes[number % len(shapes)])
        clouds = []
        for half in (points[:1024], points[1024:]):
            side = half @ rng.normal(size=3)
            clouds.append(half[np.argsort(side)[: round(KEPT * len(half))]])
        axis = rng.normal(size=3)
        motion = _motion(axis / np.linalg.norm(axis), rng.uniform(-1, 1, 3))
        yield Drawn(clouds[0], move(motion, clouds[1]), motion), rng


def is_handed(points: Points) -> bool:
    """Whether no reflection at a coordinate or principal plane brings a shape onto itself."""
    centred = points - points.mean(axis=0)
    tree, some = cKDTree(centred), centred[:QUERIES]
    spacing = tree.query(some, k=2)[0][:, 1].mean()
    axes = np.concatenate([np.eye(3), np.linalg.eigh(np.cov(centred.T))[1].T])
    reflected = [some - 2 * np.outer(some @ axis, axis) for axis in axes]
    return min(tree.query(each)[0].mean() for each in reflected) > UNLIKE * spacing


def _motion(axis: np.ndarray, translation: np.ndarray) -> Transform:
    turn = Rotation.from_rotvec(TURNED_DEG * axis, degrees=True)
    return transform_of(turn.as_matrix(), translation)
