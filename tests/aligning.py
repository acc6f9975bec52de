"""A pair that refinement alone aligns, and a tiny network: what tests of `align` share."""

import functools

import jax
import numpy as np
from scipy.spatial.transform import Rotation

from dbdnet_jax.alignment.align import align
from dbdnet_jax.networks.initial import init_params
from dbdnet_jax.networks.params import Params
from dbdnet_jax.ops.transforms import transform_of
from tests.networks.dbdnet.small import SMALL

POINTS = 150  # one bucket, hence one compiled program, for every test


@functools.cache
def tiny_params() -> Params:
    """Untrained: what the door does around a network does not depend on its weights."""
    return init_params(jax.random.key(0), SMALL)


def solid(count: int, seed: int) -> np.ndarray:
    """(count, 3) points on a shape without symmetry: three unequal walls and a slanted bar."""
    rng = np.random.default_rng(seed)
    u, v = rng.uniform(size=(2, count))
    walls = [
        np.stack([0.9 * u, 0.6 * v, 0 * u]),
        np.stack([0.9 * u, 0 * u, 0.35 * v]),
        np.stack([0 * u, 0.6 * u, 0.5 * v]),
        np.stack([0.3 + 0.3 * u, 0.2 + 0.25 * u + 0.05 * v, 0.4 * u]),
    ]
    wall = rng.integers(0, len(walls), count)
    return np.stack(walls)[wall, :, np.arange(count)] - 0.3


def motion(seed: int, degrees: float = 8.0, shift: float = 0.5) -> np.ndarray:
    """A 4x4 motion of an angle that refinement alone can bridge."""
    rng = np.random.default_rng(seed)
    axis = rng.normal(size=3)
    turn = Rotation.from_rotvec(degrees * axis / np.linalg.norm(axis), degrees=True)
    return transform_of(turn.as_matrix(), rng.uniform(-shift, shift, 3))


def pair(count: int = 380, seed: int = 0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Source, target and the true transform between them; no point stands in both."""
    transform = motion(seed)
    rotation, translation = transform[:3, :3], transform[:3, 3]
    source, target = solid(count, 2 * seed), solid(count, 2 * seed + 1)
    return (source - translation) @ rotation, target, transform


def tiny_align(source, target, **options):
    """`align` with the tiny network, guided to the answer by ``initial`` where it is given."""
    return align(source, target, tiny_params(), max_points=POINTS, **options)


def rotation_error_deg(found: np.ndarray, true: np.ndarray) -> float:
    """Angle between the rotations of two 4x4 transforms."""
    delta = found[:3, :3] @ true[:3, :3].T
    return float(np.degrees(Rotation.from_matrix(delta).magnitude()))
