"""Partial clouds of a surface: cut by a plane or a ball, or seen by a camera or a lidar.

A cut or a view is a weight for each point of the surface, 0 where it is not seen; a cloud is drawn
by the weights. So every way of seeing has one static shape.
"""

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from dbdnet_jax.data.worlds import Surface
from dbdnet_jax.ops import rigid
from dbdnet_jax.ops.sampling import divisor, farthest_order, prefix_mask, random_direction
from dbdnet_jax.types import Cloud

CELLS = 48  # of the depth buffer, along each side of an image of 90 degrees
DEPTH_STEP = 0.15  # what stands farther behind the nearest of its cell is hidden
RINGS = 24  # of a lidar, over 90 degrees
LEAST_KEPT, MOST_KEPT = 0.3, 1.0  # of the surface, by a cut


class Seen(NamedTuple):
    """How a surface is seen from somewhere: weights of its points, and from where."""

    weight: Float[Array, " n"]
    eye: Float[Array, "3"]


def cut(key: PRNGKeyArray, surface: Surface) -> Seen:
    """A part of the surface between `LEAST_KEPT` and all of it, by a plane or by a ball."""
    side_key, choice_key = jax.random.split(key)
    centre, size = extent(surface)
    way = random_direction(side_key)
    offset = surface.points - centre[None, :]
    along = jnp.sum(offset * way[None, :], axis=1)
    nearness = -jnp.sum((offset - size * way[None, :]) ** 2, axis=1)
    by_plane, keep = jax.random.uniform(choice_key, (2,))
    score = jnp.where(by_plane < 0.5, along, nearness)
    there = surface.area > 0
    score = jnp.where(there, score, -jnp.inf)
    kept = LEAST_KEPT + (MOST_KEPT - LEAST_KEPT) * keep
    # Of equal areas a point may stand for; where they differ the part kept differs a little.
    rank = jnp.sort(score)[::-1]
    last = rank[jnp.maximum(jnp.round(kept * jnp.sum(there).astype(kept.dtype)).astype(int) - 1, 0)]
    return Seen(jnp.where(score >= last, surface.area, 0.0), centre + 3.0 * size * way)


def view(
    key: PRNGKeyArray, surface: Surface, about: Float[Array, ""], inside: Float[Array, ""] | float
) -> Seen:
    """What a camera at azimuth ``about`` (radians from between x and z) sees of the surface.

    It looks down at the surface from 1.5 to 4 of its sizes; where ``inside`` is 1, from half of
    that, past the middle. Hidden is what stands behind something else (a depth buffer), and what is
    beyond 40 degrees of the line of sight. Half of the cameras sample as their pixels do, by the
    inverse square of the distance; a quarter by the rings of a lidar; the others evenly.
    """
    chance = jax.random.uniform(key, (6,))
    centre, size = extent(surface)
    azimuth, elevation = math.pi / 4 + about, math.radians(5) + math.radians(50) * chance[0]
    level = jnp.cos(elevation)
    way = jnp.stack([level * jnp.cos(azimuth), jnp.sin(elevation), level * jnp.sin(azimuth)])
    distance = size * (1.5 + 2.5 * chance[1]) * (1 - 0.5 * inside)
    eye = centre + distance * way
    aim = centre + inside * 0.5 * size * (jnp.stack([chance[2], 0.5, chance[3]]) - 0.5)
    depth, x, y = _image(surface.points, eye, aim)
    visible = _unhidden(depth, x, y, surface.area > 0)
    near = 1.0 / jnp.maximum(depth * depth * (1 + x * x + y * y), 1e-3)
    ring = jnp.arctan(y) * RINGS / (math.pi / 2)
    rings = jnp.where(jnp.abs(ring - jnp.round(ring)) < 0.25, 1.0, 0.0)
    style = chance[4]
    density = jnp.where(style < 0.5, near, jnp.where(style < 0.75, rings, 1.0))
    return Seen(jnp.where(visible, surface.area * density, 0.0), eye)


def extent(surface: Surface) -> tuple[Float[Array, "3"], Float[Array, ""]]:
    """Middle of the surface, and the root of its points' mean square distance from there."""
    weight = surface.area / jnp.maximum(jnp.sum(surface.area), 1e-9)
    centre = weight @ surface.points
    square = weight @ jnp.sum((surface.points - centre[None, :]) ** 2, axis=1)
    return centre, jnp.sqrt(square)


def shared(first: Seen, second: Seen, surface: Surface) -> Float[Array, ""]:
    """The part of the smaller of two views that the other one sees too, by area."""
    seen = [jnp.where(one.weight > 0, surface.area, 0.0) for one in (first, second)]
    both = jnp.sum(jnp.where(second.weight > 0, seen[0], 0.0))
    return both / jnp.maximum(jnp.minimum(jnp.sum(seen[0]), jnp.sum(seen[1])), 1e-9)


def sample(
    key: PRNGKeyArray,
    surface: Surface,
    weight: Float[Array, " n"],
    size: int,
    spaced: Bool[Array, ""],
) -> tuple[Int[Array, " size"], Int[Array, ""]]:
    """Rows of ``size`` points drawn by weight, none twice, and how many of them there are.

    ``spaced``: of twice as many the farthest ones, as `align` thins what it is given.
    """
    noise = jax.random.gumbel(key, weight.shape)
    score = jnp.where(weight > 0, jnp.log(jnp.maximum(weight, 1e-30)) + noise, -jnp.inf)
    best, rows = jax.lax.top_k(score, 2 * size)
    count = jnp.sum(best > -jnp.inf)
    rows = jax.lax.cond(
        spaced,
        lambda: rows[farthest_order(surface.points[rows], count, size)][:size],
        lambda: rows[:size],
    )
    return rows, jnp.minimum(count, size)


def noisy(
    key: PRNGKeyArray,
    points: Float[Array, "n 3"],
    eye: Float[Array, "3"],
    sigma: Float[Array, ""],
    clip: float,
) -> Float[Array, "n 3"]:
    """Half of the noise to all sides, half along the line of sight."""
    side_key, sight_key = jax.random.split(key)
    ray = points - eye[None, :]
    ray = ray / jnp.maximum(jnp.linalg.norm(ray, axis=1), 1e-6)[:, None]
    sides = jax.random.normal(side_key, points.shape)
    sight = jax.random.normal(sight_key, points.shape[:1])[:, None] * ray
    return points + jnp.clip(math.sqrt(0.5) * sigma * (sides + sight), -clip, clip)


def centred_cloud(
    points: Float[Array, "n 3"], count: Int[Array, ""]
) -> tuple[Cloud, Float[Array, "3"], Float[Array, ""]]:
    """The cloud about its own centre, that centre, and within what 98 % of it lie."""
    valid = prefix_mask(len(points), count)
    total = divisor(count, points.dtype)
    centre = jnp.sum(jnp.where(valid[:, None], points, 0.0), axis=0) / total
    points = jnp.where(valid[:, None], points - centre[None, :], 0.0)
    away = jnp.sort(jnp.where(valid, jnp.linalg.norm(points, axis=1), jnp.inf))
    return Cloud(points, count), centre, away[(0.98 * (total - 1)).astype(int)]


def _image(
    points: Float[Array, "n 3"], eye: Float[Array, "3"], aim: Float[Array, "3"]
) -> tuple[Float[Array, " n"], Float[Array, " n"], Float[Array, " n"]]:
    """Depth along the line of sight, and tangents to the side and upward; y is up."""
    forward = (aim - eye) / jnp.maximum(jnp.linalg.norm(aim - eye), 1e-6)
    side = jnp.stack([-forward[2], 0.0 * forward[1], forward[0]])
    side = side / jnp.maximum(jnp.linalg.norm(side), 1e-6)
    frame = jnp.stack([forward, side, jnp.cross(side, forward)])
    depth, x, y = jnp.matmul(points - eye[None, :], frame.T, precision=rigid.HIGHEST).T
    safe = jnp.maximum(depth, 1e-3)
    return depth, x / safe, y / safe


def _unhidden(
    depth: Float[Array, " n"],
    x: Float[Array, " n"],
    y: Float[Array, " n"],
    there: Bool[Array, " n"],
) -> Bool[Array, " n"]:
    """In front of the camera, within its image, and near the first thing of its cell."""
    wide = math.tan(math.radians(40))
    there = there & (depth > 0.05) & (jnp.abs(x) < wide) & (jnp.abs(y) < wide)
    cell = (jnp.floor((x + 1) * CELLS / 2) * CELLS + jnp.floor((y + 1) * CELLS / 2)).astype(int)
    cell = jnp.where(there, cell, CELLS * CELLS)
    first = jnp.full(CELLS * CELLS + 1, jnp.inf).at[cell].min(jnp.where(there, depth, jnp.inf))
    return there & (depth <= first[cell] + DEPTH_STEP)
