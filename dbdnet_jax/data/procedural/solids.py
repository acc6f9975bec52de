"""Solids as triangle soups (t, 3, 3): boxes, lathe and sweep work, and what moves them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

Soup = Float[np.ndarray, "_ 3 3"]
Number = int | float
Vector = Sequence[Number] | Float[np.ndarray, "3"]
Profile = Sequence[Sequence[Number]] | Float[np.ndarray, "_ 2"]
Path = Sequence[Vector] | Float[np.ndarray, "_ 3"]

AXES = {"x": (1, 2), "y": (2, 0), "z": (0, 1)}  # the plane that a turn about the axis moves


def join(*parts: Soup) -> Soup:
    """All parts as one soup; they may touch and intersect."""
    return np.concatenate(parts)


def move(soup: Soup, x: Number = 0.0, y: Number = 0.0, z: Number = 0.0) -> Soup:
    """The soup, shifted."""
    return soup + np.array([x, y, z])


def turn(soup: Soup, axis: str, angle: Number) -> Soup:
    """The soup, turned by ``angle`` radians about the "x", "y" or "z" axis through the origin."""
    first, second = AXES[axis]
    cos, sin = np.cos(angle), np.sin(angle)
    turned = soup.copy()
    turned[..., first] = cos * soup[..., first] - sin * soup[..., second]
    turned[..., second] = sin * soup[..., first] + cos * soup[..., second]
    return turned


def mirror(soup: Soup, axis: int) -> Soup:
    """The soup, mirrored across the plane through the origin normal to a coordinate axis."""
    mirrored = soup[:, ::-1].copy()  # the other winding keeps the normals outside
    mirrored[..., axis] *= -1
    return mirrored


def ring(corners: Profile, z: Number = 0.0) -> Float[np.ndarray, "k 3"]:
    """A planar outline at one height."""
    outline = np.asarray(corners, np.float64)
    return np.column_stack([outline, np.full(len(outline), z)])


def regular(sides: int, radius: Number = 1.0, power: Number = 2.0) -> Float[np.ndarray, "sides 2"]:
    """An outline around the origin: a circle, or squarish (superellipse) for powers above 2."""
    angle = 2 * np.pi * (np.arange(sides) + 0.5) / sides
    circle = np.column_stack([np.cos(angle), np.sin(angle)])
    return radius * np.sign(circle) * np.abs(circle) ** (2 / power)


def loft(rings: Sequence[Float[np.ndarray, "k 3"]], closed: bool = True) -> Soup:
    """The surface through rings of equally many corners; ``closed`` caps both ends.

    Rings that run counter-clockwise about the direction of travel give outward normals. A cap is
    a fan around the ring's mean, so the outline must be star-shaped about it.
    """
    stack = np.stack(rings)
    if closed:
        ends = [np.broadcast_to(end.mean(0), end.shape)[None] for end in (stack[0], stack[-1])]
        stack = np.concatenate([ends[0], stack, ends[1]])
    after = np.roll(stack, -1, axis=1)
    a, b, c, d = stack[:-1], after[:-1], after[1:], stack[1:]
    faces = np.stack([np.stack([a, b, c], axis=2), np.stack([a, c, d], axis=2)])
    return faces.reshape(-1, 3, 3)


def box(low: Vector, high: Vector) -> Soup:
    """The box between two corners."""
    outline = [(low[0], low[1]), (high[0], low[1]), (high[0], high[1]), (low[0], high[1])]
    return loft([ring(outline, low[2]), ring(outline, high[2])])


def block(width: Number, depth: Number, height: Number, taper: Number = 1.0) -> Soup:
    """A box standing on the origin; ``taper`` scales its top."""
    corners = np.array([(-0.5, -0.5), (0.5, -0.5), (0.5, 0.5), (-0.5, 0.5)]) * (width, depth)
    return loft([ring(corners), ring(corners * taper, height)])


def extrude(outline: Profile, height: Number, hole: Profile | None = None) -> Soup:
    """A prism standing on its outline; ``hole`` has as many corners as the outline."""
    if hole is None:
        return loft([ring(outline), ring(outline, height)])
    walls = [ring(hole), ring(outline), ring(outline, height), ring(hole, height), ring(hole)]
    return loft(walls, closed=False)


def revolve(profile: Profile, sides: int = 24, closed: bool = True) -> Soup:
    """A lathe's work: (radius, height) pairs from bottom to top, turned about z."""
    circle = regular(sides)
    return loft([ring(radius * circle, height) for radius, height in profile], closed)


def cylinder(radius: Number, height: Number, sides: int = 20) -> Soup:
    """A cylinder standing on the origin."""
    return revolve([(radius, 0.0), (radius, height)], sides)


def sweep(
    path: Path, section: Number | Profile, scale: Float[np.ndarray, " _"] | Number = 1.0
) -> Soup:
    """An outline carried along a path without twist; a number is a round bar's radius.

    The outline's second axis starts as upright as the path allows.
    """
    points = np.asarray(path, np.float64)
    outline = regular(10, section) if isinstance(section, int | float) else np.asarray(section)
    tangents = np.gradient(points, axis=0)
    tangents /= np.linalg.norm(tangents, axis=1, keepdims=True)
    steep = abs(tangents[0, 2]) > 0.9
    up = np.array([0.0, 1.0, 0.0] if steep else [0.0, 0.0, 1.0])
    rings = []
    for point, tangent, size in zip(
        points, tangents, np.broadcast_to(scale, len(points)), strict=True
    ):
        up = up - tangent * (tangent @ up)
        up = up / np.linalg.norm(up)
        side = np.cross(up, tangent)
        rings.append(point + size * (outline[:, :1] * side + outline[:, 1:] * up))
    return loft(rings)


def curve(*corners: Vector, steps: int = 12) -> Float[np.ndarray, "steps 3"]:
    """A Bezier curve of the given control points."""
    t = np.linspace(0.0, 1.0, steps)[:, None]
    rows = [np.broadcast_to(np.asarray(corner, np.float64), (steps, 3)) for corner in corners]
    while len(rows) > 1:
        rows = [(1 - t) * a + t * b for a, b in zip(rows[:-1], rows[1:], strict=True)]
    return rows[0]
