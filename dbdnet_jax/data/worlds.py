"""Small worlds of shapes, floors and walls, of which two partial clouds may be taken.

A world is one static number of points, each with the area it stands for; what a world lacks has no
area. Lengths are in radii of the first shape; y is up.
"""

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from dbdnet_jax.ops import rigid
from dbdnet_jax.types import Rigid

OTHERS = 3  # places for further shapes
PLANE_POINTS = 1024  # of the floor and of each of two walls
SHAPE_AREA = 4.0  # of a shape in the unit sphere, roughly: what spreads points over shapes evenly


class World(NamedTuple):
    """What kind of world: numbers that a draw turns into one."""

    others: float = 0.0  # the largest number of further shapes; from half of it on
    floor: float = 0.0  # chance of a floor under all
    walls: float = 0.0  # chance of each of two walls
    spread: float = 0.0  # how far off other shapes stand; 0: close by
    scale: float = 1.0  # of the shapes in the world


class Surface(NamedTuple):
    """Points of a world and the area that each stands for, 0 where it is not there."""

    points: Float[Array, "n 3"]
    area: Float[Array, " n"]


def draw_world(
    key: PRNGKeyArray, shape: Float[Array, "s 3"], others: Float[Array, "o m 3"], world: World
) -> Surface:
    """Stand a shape on a floor, others beside it, walls behind them; each turned about y."""
    turn_key, place_key, plane_key, chance_key = jax.random.split(key, 4)
    angles = jax.random.uniform(turn_key, (len(others) + 1,), maxval=2 * math.pi)
    chance = jax.random.uniform(chance_key, (5,))
    first = _standing(shape, angles[0]) * world.scale
    count = jnp.round(world.others * (0.5 + 0.5 * chance[0]))
    reach = _reach(first)
    parts = [Surface(first, _areas(first, SHAPE_AREA * world.scale**2))]
    for i, (other, k) in enumerate(
        zip(others, jax.random.split(place_key, len(others)), strict=True)
    ):
        size, where, off = jax.random.uniform(k, (3,))
        scale = world.scale * (0.6 + 0.6 * size)
        other = _standing(other, angles[i + 1]) * scale
        way = 2 * math.pi * where
        # Touching at the nearest, so that few stand in one another.
        distance = (reach + _reach(other)) * (0.75 + 0.35 * off) + world.spread * off
        shift = distance * jnp.stack([jnp.cos(way), 0.0 * way, jnp.sin(way)])
        area = jnp.where(i < count, SHAPE_AREA * scale**2, 0.0)
        parts.append(Surface(other + shift[None, :], _areas(other, area)))
    parts += _planes(plane_key, parts, world, chance)
    return Surface(*(jnp.concatenate(arrays) for arrays in zip(*parts, strict=True)))


def _planes(
    key: PRNGKeyArray, parts: list[Surface], world: World, chance: Float[Array, "5"]
) -> list[Surface]:
    """The floor through the lowest points, a wall behind in x and another in z."""
    there = [part.area[0] > 0 for part in parts]
    ends = [jnp.max(jnp.abs(part.points[:, ::2])) for part in parts]
    far = jnp.max(jnp.where(jnp.stack(there), jnp.stack(ends), 0.0))
    half = far * (1.05 + 0.5 * chance[1])
    keys = jax.random.split(key, 3)
    a, b = (jax.random.uniform(k, (PLANE_POINTS, 2), minval=-1.0) for k in keys[:2])
    c = jax.random.uniform(keys[2], (PLANE_POINTS, 2), minval=-1.0)
    height = 0.8 * half
    zero = jnp.zeros(PLANE_POINTS)
    floor = jnp.stack([half * a[:, 0], zero, half * a[:, 1]], axis=1)
    behind = jnp.stack([zero - half, height * (b[:, 0] + 1), half * b[:, 1]], axis=1)
    beside = jnp.stack([half * c[:, 0], height * (c[:, 1] + 1), zero - half], axis=1)
    chances = (world.floor, world.walls, world.walls)
    areas = (4 * half * half, 4 * half * height, 4 * half * height)
    return [
        Surface(points, _areas(points, jnp.where(drawn < limit, area, 0.0)))
        for points, drawn, limit, area in zip(
            (floor, behind, beside), chance[2:], chances, areas, strict=True
        )
    ]


def _standing(points: Float[Array, "n 3"], angle: Float[Array, ""]) -> Float[Array, "n 3"]:
    """The shape turned about y, its lowest point at height 0."""
    turned = rigid.apply(
        Rigid(rigid.rotation_from_euler(angle * jnp.eye(3)[1]), jnp.zeros(3)), points
    )
    return turned.at[:, 1].add(-jnp.min(turned[:, 1]))


def _reach(points: Float[Array, "n 3"]) -> Float[Array, ""]:
    """How far the shape reaches from its axis: less than 2 % of points beyond."""
    return jnp.quantile(jnp.sqrt(points[:, 0] ** 2 + points[:, 2] ** 2), 0.98)


def _areas(points: Float[Array, "n 3"], area: Float[Array, ""] | float) -> Float[Array, " n"]:
    return jnp.full(len(points), 1.0 / len(points)) * area
