"""The last step of an alignment: symmetric point-to-plane ICP on all points (Rusinkiewicz 2019)."""

import numpy as np
from jaxtyping import Float, Int

from dbdnet_jax.alignment.surfaces import Surface
from dbdnet_jax.ops.transforms import as_transform, move, transform_of
from dbdnet_jax.types import Transform

FEWEST = 12  # matched points of a step
ROBUST = 2.0  # residuals above this many medians count little (Geman & McClure)
AGREEING = 0.7  # cosine between the normals of matched points
STILL = 1e-6  # radians, and length: a step that changes nothing


def refine_point_to_plane(
    pose: Transform,
    source: Surface,
    target: Surface,
    radii: tuple[float, ...],
    rows: Int[np.ndarray, " k"] | None = None,
) -> Transform:
    """The pose after a step for each matching radius, of all source points or the given rows."""
    points = source.points if rows is None else source.points[rows]
    normals = source.normals if rows is None else source.normals[rows]
    for radius in radii:
        step = _step(pose, points, normals, target, radius)
        if step is None:
            return pose
        pose = step @ pose
        if np.abs(step - np.eye(4)).max() < STILL:
            break
    return as_transform(pose[:3, :3], pose[:3, 3])


def _step(
    pose: Transform,
    points: Float[np.ndarray, "n 3"],
    normals: Float[np.ndarray, "n 3"],
    target: Surface,
    radius: float,
) -> Transform | None:
    """One Gauss-Newton step; None where too little is matched."""
    moved = move(pose, points)
    found, rows = target.tree.query(moved, distance_upper_bound=radius)
    near = np.flatnonzero(np.isfinite(found))
    own, theirs = normals[near] @ pose[:3, :3].T, target.normals[rows[near]]
    cosine = (own * theirs).sum(axis=1)
    agreeing = np.abs(cosine) > AGREEING
    if agreeing.sum() < FEWEST:
        return None
    near, own, theirs, cosine = (x[agreeing] for x in (near, own, theirs, cosine))
    normal = theirs + np.sign(cosine)[:, None] * own
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    goal = target.points[rows[near]]
    residual = ((moved[near] - goal) * normal).sum(axis=1)
    scale = ROBUST * np.median(np.abs(residual)) + 1e-9
    weight = 1.0 / (1.0 + (residual / scale) ** 2) ** 2
    pivot = goal.mean(axis=0)
    jacobian = np.hstack([np.cross(moved[near] - pivot, normal), normal])
    weighted = jacobian * weight[:, None]
    held = weighted.T @ jacobian
    # The ridge keeps motions that nothing resists where they are.
    held += 1e-6 * np.trace(held) * np.eye(6)
    turn, shift = np.split(-np.linalg.solve(held, weighted.T @ residual), 2)
    from scipy.spatial.transform import Rotation

    rotation = Rotation.from_rotvec(turn).as_matrix()
    return transform_of(rotation, pivot + shift - rotation @ pivot)
