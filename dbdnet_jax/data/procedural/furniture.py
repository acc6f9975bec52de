"""Furniture with random proportions, z up, the front towards -y.

Every function draws one object from a generator, in units of roughly a metre.
"""

from __future__ import annotations

import numpy as np

from dbdnet_jax.data.procedural.household import Rng, chance, lamp, monitor, vase
from dbdnet_jax.data.procedural.solids import (
    Soup,
    block,
    box,
    curve,
    cylinder,
    extrude,
    join,
    mirror,
    move,
    regular,
    revolve,
    sweep,
    turn,
)


def leg(rng: Rng, height: float, radius: float) -> Soup:
    """One leg standing on the origin: square, tapered, round or turned."""
    kind = rng.integers(4)
    if kind == 0:
        return block(2 * radius, 2 * radius, height)
    if kind == 1:
        return block(radius, radius, height, rng.uniform(1.5, 3.0))
    if kind == 2:
        return cylinder(radius, height, 10)
    bulges = radius * rng.uniform(0.4, 1.5, 9)
    return revolve(np.column_stack([bulges, np.linspace(0, height, 9)]), 10)


def four_legs(rng: Rng, width: float, depth: float, height: float) -> Soup:
    """Four equal legs under a rectangle around the origin, upright or splayed, perhaps tied."""
    radius = rng.uniform(0.015, 0.05)
    one = leg(rng, height, radius)
    splay = rng.uniform(0.0, 0.2) if chance(rng, 0.3) else 0.0
    legs = []
    for x in (-1, 1):
        for y in (-1, 1):
            upright = move(one, z=-height)
            tilted = turn(turn(upright, "x", y * splay), "y", -x * splay)
            legs.append(move(tilted, x * (width / 2 - radius), y * (depth / 2 - radius), height))
    if chance(rng, 0.4):
        z, bar = rng.uniform(0.1, 0.6) * height, 0.6 * radius
        for x in (-1, 1):
            end = x * (width / 2 - radius)
            legs.append(box((end - bar, -depth / 2, z), (end + bar, depth / 2, z + 2 * bar)))
        y = rng.choice([0.0, depth / 2 - radius])
        legs.append(box((-width / 2, y - bar, z), (width / 2, y + bar, z + 2 * bar)))
    return join(*legs)


def support(rng: Rng, width: float, depth: float, height: float) -> Soup:
    """What carries a top: four legs, two panels, two frames, a drawer unit, or a pedestal."""
    kind = rng.choice(5, p=[0.5, 0.12, 0.13, 0.12, 0.13])
    thick = rng.uniform(0.02, 0.06)
    x, y = width / 2 - thick, depth / 2 - thick
    if kind == 1:
        sides = [box((s * x - thick, -y, 0), (s * x + thick, y, height)) for s in (-1, 1)]
        return join(*sides, box((-x, y - thick, height * 0.4), (x, y, height * 0.9)))
    if kind == 2:
        corners = [(0, -y, height), (0, -y, 0), (0, y, 0), (0, y, height)]
        bars = [
            box(np.minimum(a, b) - thick / 2, np.maximum(a, b) + thick / 2)
            for a, b in zip(corners[:-1], corners[1:], strict=True)
        ]
        return join(move(join(*bars), -x), move(join(*bars), x))
    if kind == 3:
        unit = drawers(rng, width * rng.uniform(0.25, 0.4), depth * 0.9, height)
        legs = [move(block(thick, thick, height), -x, s * y) for s in (-1, 1)]
        return join(move(unit, x - width * 0.15), *legs)
    if kind == 4:
        stem = revolve([(thick, 0), (thick * rng.uniform(0.5, 2.5), height / 2), (thick, height)])
        if chance(rng):
            return join(stem, revolve([(width / 3, 0), (width / 3, 0.02), (thick, 0.08)]))
        return join(stem, star_base(rng, width * 0.4))
    return four_legs(rng, width, depth, height)


def star_base(rng: Rng, reach: float) -> Soup:
    """Three to five curved feet around the origin."""
    count = int(rng.integers(3, 6))
    foot = sweep(curve((0, 0, 0.12), (reach / 2, 0, 0.15), (reach, 0, 0.02), steps=6), 0.02)
    castor = move(turn(cylinder(0.03, 0.03, 10), "x", np.pi / 2), reach, 0.015, 0.03)
    one = join(foot, castor) if chance(rng) else foot
    return join(*(turn(one, "z", 2 * np.pi * k / count) for k in range(count)))


def handle(rng: Rng, length: float) -> Soup:
    """A handle on a front in the plane y = 0: a bar, a bow or a knob."""
    kind = rng.integers(3)
    if kind == 0:
        return box((-length / 2, -0.03, -0.01), (length / 2, 0.0, 0.01))
    if kind == 1:
        ends = (-length / 2, 0, 0), (length / 2, 0, 0)
        return sweep(curve(ends[0], (0, -0.08, 0), ends[1], steps=6), 0.01)
    return turn(
        revolve([(0.01, 0), (0.012, 0.02), (0.025, 0.03), (0.015, 0.045)], 10), "x", np.pi / 2
    )


def drawers(rng: Rng, width: float, depth: float, height: float) -> Soup:
    """A body with stacked drawers, some of them pulled out."""
    count = int(rng.integers(1, 6))
    edges = np.concatenate([[0.0], np.cumsum(rng.uniform(0.5, 1.5, count))])
    edges *= height / edges[-1]
    grip = handle(rng, width * rng.uniform(0.2, 0.7))
    parts = [move(block(width, depth, height))]
    for low, high in zip(edges[:-1], edges[1:], strict=True):
        front = -depth / 2 - 0.02 - (rng.uniform(0, 0.5) * depth if chance(rng, 0.15) else 0.0)
        inset = 0.02 * width
        parts.append(
            box(
                (-width / 2 + inset, front, low + 0.01),
                (width / 2 - inset, -depth / 2, high - 0.01),
            )
        )
        parts.append(move(grip, rng.choice([0.0, 0.0, 0.25]) * width, front, (low + high) / 2))
    return join(*parts)


def ornament(rng: Rng, size: float) -> Soup:
    """A small thing to stand on a top: books, a box, a vase, a lamp or a screen."""
    kind = rng.integers(5)
    if kind == 0:
        return books(rng, size, size * 0.6, size)
    if kind == 1:
        return turn(block(*(size * rng.uniform(0.3, 1.2, 3))), "z", rng.uniform(0, np.pi))
    thing = (vase, lamp, monitor)[kind - 2](rng)
    return turn(thing * (size / np.ptp(thing[..., 2])), "z", rng.normal(0, 0.4))


def books(rng: Rng, width: float, depth: float, height: float) -> Soup:
    """A row of upright books that fills a part of the width, from the left."""
    x = -width / 2
    end = width * rng.uniform(-0.2, 0.5)
    parts: list[Soup] = []
    while x < end or not parts:
        thick, tall = rng.uniform(0.06, 0.2) * width, rng.uniform(0.6, 0.95) * height
        parts.append(box((x, -depth * rng.uniform(0.2, 0.5), 0), (x + thick, depth / 2, tall)))
        x += thick
    return join(*parts)


def table(rng: Rng) -> Soup:
    """A table, desk or bench: a top on a support, with things on it and below."""
    width, depth = rng.uniform(0.6, 2.0), rng.uniform(0.4, 1.0)
    height, thick = rng.uniform(0.3, 1.0), rng.uniform(0.02, 0.08)
    if chance(rng, 0.6):
        top = block(width, depth, thick)
    else:
        outline = regular(28, 0.5, rng.choice([2.0, 2.0, 4.0, 6.0])) * (width, depth)
        top = extrude(outline, thick)
    parts = [move(top, z=height), support(rng, width * 0.9, depth * 0.9, height)]
    if chance(rng, 0.3):
        low = rng.uniform(0.15, 0.5) * height
        parts.append(move(block(width * 0.85, depth * 0.8, thick / 2), z=low))
    if chance(rng, 0.3):
        side = rng.choice([-1, 0, 1]) * width * 0.22
        unit = drawers(rng, width * 0.4, depth * 0.8, height * rng.uniform(0.15, 0.4))
        parts.append(move(unit, side, 0, height - np.ptp(unit[..., 2])))
    if chance(rng, 0.15):
        shelf = shelves(rng) * (width, depth * 0.8, 0.5)
        parts.append(move(shelf, 0, depth * 0.3, height + thick))
    for _ in range(rng.integers(0, 4)):
        x, y = rng.uniform(-0.4, 0.4, 2) * (width, depth)
        parts.append(move(ornament(rng, rng.uniform(0.15, 0.4)), x, y, height + thick))
    return join(*parts)


def chair(rng: Rng) -> Soup:
    """A chair or stool with a back of one of four kinds and no, one or two arms."""
    width, depth, seat = rng.uniform(0.4, 0.7), rng.uniform(0.4, 0.7), rng.uniform(0.35, 0.75)
    thick = rng.uniform(0.03, 0.15)
    outline = regular(24, 0.5, rng.choice([2.0, 4.0, 8.0, 20.0])) * (width, depth)
    parts = [move(extrude(outline, thick), z=seat)]
    if chance(rng, 0.75):
        parts.append(four_legs(rng, width * 0.95, depth * 0.95, seat))
    else:
        parts += [star_base(rng, width * 0.6), cylinder(0.03, seat, 12)]
    tall, lean = rng.uniform(0.2, 0.8), rng.uniform(-0.35, 0.0)
    back, kind = [], rng.integers(5)
    x = width / 2 - 0.03
    if kind == 0:
        back.append(move(block(width, 0.05, tall, rng.uniform(0.7, 1.1)), z=rng.uniform(0, 0.15)))
    elif kind == 1:
        back += [move(block(0.04, 0.04, tall), s * x) for s in (-1, 1)]
        for z in np.linspace(0.3, 1.0, rng.integers(1, 6)) * tall:
            back.append(box((-x, -0.015, z - 0.05), (x, 0.015, z)))
    elif kind == 2:
        back += [move(cylinder(0.015, tall, 8), s) for s in np.linspace(-x, x, rng.integers(3, 8))]
        back.append(box((-x - 0.03, -0.02, tall), (x + 0.03, 0.02, tall + 0.07)))
    elif kind == 3:
        bow = curve((-x, 0, 0), (-x, 0.1, 1.5 * tall), (x, 0.1, 1.5 * tall), (x, 0, 0))
        back += [sweep(bow, 0.02), box((-x, -0.01, tall * 0.4), (x, 0.02, tall * 0.7))]
    if back:
        parts.append(move(turn(join(*back), "x", lean), 0, depth / 2 - 0.03, seat + thick / 2))
    arms = rng.choice([0, 1, 2], p=[0.45, 0.2, 0.35])
    z, reach = seat + thick + rng.uniform(0.12, 0.25), rng.uniform(0.5, 1.0) * depth
    for side in (-1, 1)[:arms]:
        rest = box((-0.03, depth / 2 - reach, z - 0.02), (0.03, depth / 2, z + 0.02))
        post = box((-0.02, depth / 2 - reach * 0.9, seat), (0.02, depth / 2 - reach * 0.8, z))
        parts.append(move(join(rest, post), side * width / 2))
    return join(*parts)


def shelves(rng: Rng) -> Soup:
    """An open shelf of columns and uneven boards with a few things on them, 1 x 1 x 1."""
    columns = int(rng.integers(1, 4))
    edges = np.concatenate([[0.0], np.cumsum(rng.uniform(0.5, 1.5, columns))])
    edges = edges / edges[-1] - 0.5
    thick, parts = rng.uniform(0.015, 0.04), []
    tops = rng.uniform(0.5, 1.0, columns) if chance(rng, 0.3) else np.ones(columns)
    for left, right, top in zip(edges[:-1], edges[1:], tops, strict=True):
        for x in (left, right):
            parts.append(box((x - thick / 2, -0.5, 0), (x + thick / 2, 0.5, top)))
        boards = np.linspace(rng.uniform(0, 0.2), top - thick, rng.integers(2, 6))
        boards[1:-1] += rng.uniform(-0.06, 0.06, len(boards) - 2)
        for low, high in zip(boards, [*boards[1:], top + 0.3], strict=True):
            parts.append(box((left, -0.5, low), (right, 0.5, low + thick)))
            if chance(rng, 0.35):
                fill = books(rng, (right - left) * 0.9, 0.8, (high - low) * 0.8)
                parts.append(move(fill, (left + right) / 2, 0, low + thick))
        if chance(rng, 0.4):
            parts.append(box((left, 0.48, 0), (right, 0.5, top)))
    return join(*parts)


def shelf(rng: Rng) -> Soup:
    """A standing shelf."""
    scale = rng.uniform(0.5, 1.6), rng.uniform(0.2, 0.5), rng.uniform(0.6, 2.2)
    return shelves(rng) * scale


def cupboard(rng: Rng) -> Soup:
    """A cupboard or chest: columns of doors, drawers or open boards, on a plinth or legs."""
    depth, height = rng.uniform(0.3, 0.7), rng.uniform(0.5, 2.0)
    lift = rng.uniform(0.0, 0.3)
    widths = rng.uniform(0.3, 0.8, rng.integers(1, 4))
    edges = np.concatenate([[0.0], np.cumsum(widths)]) - widths.sum() / 2
    parts = [box((edges[0], -0.02, lift), (edges[-1], depth / 2, lift + height))]
    for left, width in zip(edges[:-1], widths, strict=True):
        kind, middle = rng.choice(3, p=[0.5, 0.35, 0.15]), left + width / 2
        low = lift + (height * rng.uniform(0.2, 0.6) if chance(rng, 0.3) else 0.0)
        tall = lift + height - low
        parts.append(box((left, -depth / 2, lift), (left + 0.02, depth / 2, low)))
        if kind == 0:
            door = box((0, -0.025, 0.01), (width - 0.01, 0, tall - 0.01))
            grip = turn(handle(rng, 0.2), "y", np.pi / 2)
            door = join(door, move(grip, width * 0.88, -0.025, tall * rng.uniform(0.4, 0.7)))
            door = turn(door, "z", -rng.uniform(0.2, 1.8)) if chance(rng, 0.2) else door
            if chance(rng):
                door = move(mirror(door, 0), width)
            parts.append(move(door, left, -depth / 2, low))
            parts.append(box((left, -depth / 2, low), (left + width, 0, low + 0.02)))
        elif kind == 1:
            parts.append(move(drawers(rng, width * 0.98, depth, tall), middle, 0, low))
        else:
            parts.append(move(shelves(rng) * (width, depth, tall), middle, 0, low))
    parts.append(
        box((edges[0], -depth / 2, lift + height), (edges[-1], depth / 2, lift + height + 0.03))
    )
    parts.append(four_legs(rng, widths.sum(), depth, lift + 0.01))
    return join(*parts)
