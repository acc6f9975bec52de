"""Rigid transforms as 4x4 matrices in float64."""

import itertools

import numpy as np
from jaxtyping import Float

from dbdnet_jax.types import Transform


def transform_of(
    rotation: Float[np.ndarray, "3 3"], translation: Float[np.ndarray, "3"]
) -> Transform:
    """The 4x4 float64 matrix of a rotation, taken as it is, and a translation."""
    transform = np.eye(4)
    transform[:3, :3] = rotation
    transform[:3, 3] = translation
    return transform


def nearest_rotation(matrix: Float[np.ndarray, "*k 3 3"]) -> Float[np.ndarray, "*k 3 3"]:
    """The float64 rotation that differs least from a matrix; of several, each one's."""
    u, _, vt = np.linalg.svd(np.asarray(matrix, np.float64))
    signs = np.ones((*u.shape[:-2], 1, 3))
    signs[..., 0, 2] = np.linalg.det(u @ vt)
    return (u * signs) @ vt


def as_transform(
    rotation: Float[np.ndarray, "3 3"], translation: Float[np.ndarray, "3"]
) -> Transform:
    """A 4x4 float64 matrix; the rotation is the nearest one to the given matrix."""
    return transform_of(nearest_rotation(rotation), translation)


def move(transform: Transform, points: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 3"]:
    """A point or points under a 4x4 transform."""
    return points @ transform[:3, :3].T + transform[:3, 3]


def angle_between(a: Transform, b: Transform) -> tuple[float, Float[np.ndarray, "3"]]:
    """Degrees and axis of the rotation that leads from pose b to pose a."""
    from scipy.spatial.transform import Rotation

    vector = Rotation.from_matrix(a[:3, :3] @ b[:3, :3].T).as_rotvec(degrees=True)
    angle = float(np.linalg.norm(vector))
    return angle, vector / angle if angle else np.eye(3)[0]


def turn_deg(rotation: Float[np.ndarray, "*k 3 3"]) -> Float[np.ndarray, "*k"]:
    """The angle of one rotation or of several."""
    trace = np.trace(rotation, axis1=-2, axis2=-1)
    return np.degrees(np.arccos(np.clip((trace - 1) / 2, -1, 1)))


def cube_rotations() -> Float[np.ndarray, "24 3 3"]:
    """The 24 rotations of a cube, by angle: every rotation is within 63 degrees of one."""
    signs = np.array(list(itertools.product((1.0, -1.0), repeat=3)))
    found = [
        np.eye(3)[list(order)] * sign[:, None]
        for order in itertools.permutations(range(3))
        for sign in signs
    ]
    proper = np.array([x for x in found if np.linalg.det(x) > 0])
    return proper[np.argsort(turn_deg(proper), kind="stable")]


def finer_cube_rotations() -> Float[np.ndarray, "48 3 3"]:
    """Those of a cube, and each of them turned on by 60 degrees about a diagonal: between these."""
    from scipy.spatial.transform import Rotation

    between = Rotation.from_rotvec(np.full(3, np.pi / 3 / np.sqrt(3))).as_matrix()
    turns = cube_rotations()
    return np.concatenate([turns, turns @ between])
