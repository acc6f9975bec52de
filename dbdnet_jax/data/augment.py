"""Pairs drawn more widely than a protocol says, to train networks that will meet such pairs."""

import math

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from dbdnet_jax.data.pairs import PairDraw, Protocol, assemble
from dbdnet_jax.ops import rigid
from dbdnet_jax.ops.quaternion import any_rotation
from dbdnet_jax.ops.sampling import ball_crop, half_space_crop, random_direction
from dbdnet_jax.types import Pair

LEAST_KEPT = 0.5
MOST_NOISE = 3.0  # times the protocol's
CLEAN = 0.25  # of the pairs
LARGEST_SCALE = 1.2  # and its inverse the smallest


def make_augmented_pair(
    key: PRNGKeyArray, points: Float[Array, "s 3"], normals: Float[Array, "s 3"], protocol: Protocol
) -> Pair:
    """One pair of a shape, as large as the protocol's clouds, everything else drawn more widely.

    The part that a crop leaves is 0.5 to 1: the smaller it is, the more points are drawn before the
    cut. The crop is by a plane or takes what is nearest to a point on the unit sphere (PRNet, Wang
    & Solomon 2019). The noise is none or up to three times the protocol's, shapes are larger and
    smaller by up to a fifth. Half of the pairs are disjoint; these have half of the shape's points
    for each cloud and keep accordingly more, at least 0.7 where 717 of 2,048 points remain. Motions
    are the protocol's.

    Raises:
        ValueError: two clouds of the protocol's size are more than the shape has.
    """
    total = points.shape[0]
    require_enough_points(total, protocol)
    rows_key, crop_key, motion_key, noise_key, choice_key = jax.random.split(key, 5)
    chance = jax.random.uniform(choice_key, (4,))
    points = points * LARGEST_SCALE ** (2 * chance[0] - 1)

    disjoint = chance[1] < 0.5
    order, other = (jax.random.permutation(k, total) for k in jax.random.split(rows_key))
    orders = order, jnp.where(disjoint, order[::-1], other)
    kept = LEAST_KEPT + (1 - LEAST_KEPT) * chance[2]
    drawn = jnp.minimum(protocol.size / kept, jnp.where(disjoint, total // 2, total))

    def crop(key: PRNGKeyArray, rows: Array) -> Array:
        side_key, style_key = jax.random.split(key)
        args = points[rows], random_direction(side_key), protocol.size, drawn
        by_plane = jax.random.uniform(style_key) < 0.5
        return rows[jnp.where(by_plane, half_space_crop(*args), ball_crop(*args))]

    source, target = (
        crop(k, rows) for k, rows in zip(jax.random.split(crop_key), orders, strict=True)
    )
    motion = rigid.random_rigid(
        motion_key, math.radians(protocol.max_angle_deg), protocol.max_translation
    )
    amount = jnp.maximum(chance[3] - CLEAN, 0) / (1 - CLEAN) * MOST_NOISE
    noise = protocol.noise_sigma * amount * jax.random.normal(noise_key, (2, protocol.size, 3))
    noise = jnp.clip(noise, -protocol.noise_clip, protocol.noise_clip)
    draw = PairDraw(source, target, motion, noise[0], noise[1])
    return assemble(draw, points, normals, protocol.overlap_radius)


def stretched(key: PRNGKeyArray, points: Float[Array, "s 3"], most: float) -> Float[Array, "s 3"]:
    """A centred shape stretched along three axes at right angles, of any direction, to radius 1.

    Each factor lies between 1 / ``most`` and ``most``; 1 leaves the shape as it is.
    """
    axes_key, factor_key = jax.random.split(key)
    axes = any_rotation(axes_key)
    factors = most ** jax.random.uniform(factor_key, (3,), minval=-1.0)
    stretch = jnp.matmul(axes * factors[None, :], axes.T, precision=rigid.HIGHEST)
    points = jnp.matmul(points, stretch, precision=rigid.HIGHEST)
    return points / jnp.linalg.norm(points, axis=1).max()


def require_enough_points(total: int, protocol: Protocol) -> None:
    """Raise ValueError where shapes of so many points are too small for disjoint clouds."""
    if 2 * protocol.size > total:
        raise ValueError(
            f"augmented pairs of {protocol.size} points need shapes of at least "
            f"{2 * protocol.size}; got {total}. Lower config.protocol.points, or set "
            "config.data.augment=0."
        )
