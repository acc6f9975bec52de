"""Mechanical parts, tools, stairs and vehicles with random proportions, z up.

Every function draws one object from a generator, in units of its own.
"""

from __future__ import annotations

import numpy as np

from dbdnet_jax.data.procedural.household import Rng, chance
from dbdnet_jax.data.procedural.solids import (
    Soup,
    block,
    box,
    curve,
    cylinder,
    extrude,
    join,
    move,
    regular,
    revolve,
    sweep,
    turn,
)


def gear(rng: Rng) -> Soup:
    """One to three gears on a shaft, with a hub, spokes or a crank."""
    parts, z = [], 0.0
    for _ in range(rng.integers(1, 4)):
        teeth, radius = int(rng.integers(8, 25)), rng.uniform(0.3, 1.0)
        thick = rng.uniform(0.08, 0.4)
        height = np.tile([1.0, 1.0, 1 + 3 / teeth, 1 + 3 / teeth], teeth)[:, None]
        outline = regular(4 * teeth, radius) * height
        hole = regular(4 * teeth, radius * rng.uniform(0.1, 0.8))
        parts.append(move(extrude(outline, thick, hole), z=z))
        spoke = box((-radius * 0.9, -0.06, z), (radius * 0.9, 0.06, z + thick * 0.8))
        angles = np.pi * np.arange(rng.integers(0, 3)) / 2 + rng.uniform(0, np.pi)
        parts += [turn(spoke, "z", angle) for angle in angles]
        z += thick + rng.uniform(0.0, 0.5)
    shaft = rng.uniform(0.08, 0.2)
    parts.append(move(cylinder(shaft, z + rng.uniform(0.2, 1.5)), z=-rng.uniform(0, 0.6)))
    if chance(rng, 0.6):
        reach, top = rng.uniform(0.4, 1.2), max(part[..., 2].max() for part in parts)
        parts.append(box((-shaft, -0.08, top), (reach, 0.08, top + 0.1)))
        parts.append(move(cylinder(0.07, rng.uniform(0.2, 0.5), 12), reach - 0.1, 0, top))
    return join(*parts)


def pipe(rng: Rng) -> Soup:
    """A pipe with right-angled elbows, flanges, a branch and a hand wheel."""
    radius, bend = rng.uniform(0.06, 0.18), 0.25
    position, direction = np.zeros(3), np.eye(3)[rng.integers(3)]
    path, flanges = [position], []
    for _ in range(rng.integers(2, 6)):
        end = position + direction * rng.uniform(0.6, 1.5)
        across = np.roll(direction, rng.integers(1, 3)) * rng.choice([-1, 1])
        flanges.append((position + 0.3 * (end - position), direction))
        start = end - bend * direction
        path += [*np.linspace(position + 0.1 * direction, start, 3)]
        path += [*curve(start, end, end + bend * across, steps=6)[1:]]
        position, direction = end + bend * across, across
    path += [position + 0.2 * direction, position + 0.5 * direction]
    parts = [sweep(np.array(path), regular(14, radius))]
    flanges += [(path[0], np.subtract(path[1], path[0])), (path[-1], direction)]
    for centre, along in flanges:
        if chance(rng, 0.6):
            along = 0.06 * along / np.linalg.norm(along)
            parts.append(sweep([centre - along, centre + along], regular(14, radius * 1.7)))
    centre, along = flanges[rng.integers(len(flanges))]
    side = np.roll(along, 1) / np.linalg.norm(along)
    tip = centre + rng.uniform(0.4, 0.8) * side
    parts.append(sweep([centre, tip], regular(10, radius * rng.uniform(0.5, 1.0))))
    if chance(rng):
        wheel = np.column_stack([regular(17, 0.35), np.zeros(17)])
        ring = sweep(np.concatenate([wheel, wheel[:1]]), 0.04)
        spoke = box((-0.35, -0.03, -0.03), (0.35, 0.03, 0.03))
        parts.append(join(ring, spoke, turn(spoke, "z", np.pi / 2)) + tip)
    return join(*parts)


def bracket(rng: Rng) -> Soup:
    """An angle bracket: two plates, ribs, bosses and bolts."""
    width, reach, tall = rng.uniform(0.4, 1.5, 3)
    thick = rng.uniform(0.05, 0.15)
    parts = [block(width, 2 * reach, thick), move(block(width, thick, tall), 0, reach - thick / 2)]
    outline = [(0, 0), (-reach * rng.uniform(0.5, 1.0), 0), (0, tall * rng.uniform(0.4, 1.0))]
    rib = turn(turn(extrude(outline, thick), "x", np.pi / 2), "z", np.pi / 2)
    for x in rng.uniform(-0.5, 0.5, rng.integers(1, 3)) * (width - thick):
        parts.append(move(rib, x - thick / 2, reach - thick, thick))
    for _ in range(rng.integers(1, 5)):
        radius = rng.uniform(0.08, 0.25) * width
        hole = regular(20, radius * rng.uniform(0.4, 0.8))
        boss = extrude(regular(20, radius), rng.uniform(0.05, 0.4), hole)
        x, y = rng.uniform(-0.35, 0.35) * width, rng.uniform(-0.8, 0.3) * reach
        if chance(rng):
            parts.append(move(boss, x, y, thick))
        else:
            upright = turn(boss, "x", rng.choice([-1, 1]) * np.pi / 2)
            parts.append(move(upright, x, reach, thick + (0.3 + abs(y) / 2) * tall))
    if chance(rng, 0.4):
        parts.append(box((width / 2 - thick, -reach, 0), (width / 2, reach, tall * 0.5)))
    return join(*parts)


def machine(rng: Rng) -> Soup:
    """A motor, pump or milled block: boxes and cylinders set on the faces of a housing."""
    size = rng.uniform(0.4, 1.2, 3)
    parts = [block(size[0], size[1], size[2], rng.uniform(0.7, 1.0))]
    if chance(rng, 0.4):
        body = turn(cylinder(0.5 * size[1], size[0], 24), "y", np.pi / 2)
        parts = [move(body, -size[0] / 2, 0, size[2] / 2)]
        fin = turn(cylinder(0.58 * size[1], 0.03, 24), "y", np.pi / 2)
        for x in np.linspace(-0.4, 0.4, rng.integers(2, 8)) * size[0]:
            parts.append(move(fin, x, 0, size[2] / 2))
        parts.append(block(size[0], size[1], 0.1))
    for _ in range(rng.integers(2, 7)):
        long, wide = rng.uniform(0.1, 0.7), rng.uniform(0.06, 0.3)
        if chance(rng, 0.6):
            steps = wide * np.sort(rng.uniform(0.4, 1.0, 3))[::-1]
            heights = np.linspace(0, long, 4)
            profile = [
                (r, h) for r, a, b in zip(steps, heights, heights[1:], strict=False) for h in (a, b)
            ]
            knob = revolve(profile, int(rng.choice([6, 16])))
        else:
            knob = block(2 * wide, rng.uniform(1, 3) * wide, long, rng.uniform(0.6, 1.0))
        x, y, z = rng.uniform(-0.35, 0.35, 3) * size
        face = rng.integers(5)
        if face == 0:
            parts.append(move(knob, x, y, size[2]))
        elif face in (1, 2):
            side = 1 if face == 1 else -1
            parts.append(
                move(turn(knob, "y", side * np.pi / 2), side * size[0] / 2, y, z + size[2] / 2)
            )
        else:
            side = 1 if face == 3 else -1
            parts.append(
                move(turn(knob, "x", -side * np.pi / 2), x, side * size[1] / 2, z + size[2] / 2)
            )
    return join(*parts)


def tool(rng: Rng) -> Soup:
    """A hammer, axe, spanner, ladle or screwdriver, lying along x."""
    length, radius = rng.uniform(0.8, 1.6), rng.uniform(0.03, 0.08)
    widths = 1 + 0.5 * np.sin(np.linspace(0, rng.uniform(2, 7), 12))
    bend = rng.uniform(-0.3, 0.3, 2)
    path = curve((0, 0, 0), (length / 2, *bend), (length, 0, 0))
    parts = [sweep(path, regular(12, radius, rng.choice([2.0, 4.0])), widths)]
    kind = rng.integers(4)
    if kind == 0:
        face = revolve([(0.1, 0), (0.1, 0.15), (0.07, 0.2), (0.07, 0.3)], int(rng.choice([8, 20])))
        claw = sweep(
            curve((0, 0, 0), (0, 0, -0.2), (-0.25, 0, -0.3), steps=8),
            [(-0.1, -0.03), (0.1, -0.03), (0.1, 0.03), (-0.1, 0.03)],
            np.linspace(1, 0.5, 8),
        )
        parts.append(move(join(face, claw), length))
    elif kind == 1:
        blade = np.array([(-0.1, 0), (0.1, 0), (0.3, 0.5), (-0.25, 0.55)]) * rng.uniform(
            0.6, 1.2, 2
        )
        parts.append(move(turn(extrude(blade, 0.06), "x", np.pi / 2), length, 0.03, -0.05))
        parts.append(move(block(0.2, 0.12, 0.3), length, 0, -0.25))
    elif kind == 2:
        jaw = extrude(regular(24, 0.25), 0.1, regular(24, 0.15))
        parts.append(move(jaw[:-24], length + 0.2, 0, -0.05))
        parts.append(move(extrude(regular(12, 0.18), 0.08, regular(12, 0.1)), -0.15, 0, -0.04))
    else:
        parts.append(sweep([(length, 0, 0), (length * rng.uniform(1.4, 2.0), 0, 0)], radius * 0.6))
        bowl = revolve([(0.02, -0.12), (0.14, -0.08), (0.2, 0.02), (0.17, 0.02)], closed=False)
        parts.append(move(bowl, length * 1.4, 0, 0.05))
    return join(*parts)


def stairs(rng: Rng) -> Soup:
    """A flight of stairs or a ladder with a rail on one side and perhaps a turned second flight."""
    count, width = int(rng.integers(4, 11)), rng.uniform(0.6, 1.4)
    rise, run = rng.uniform(0.15, 0.25), rng.uniform(0.1, 0.35)
    solid, thick = chance(rng), rng.uniform(0.03, 0.08)
    flight = []
    for k in range(count):
        low = 0.0 if solid else (k + 1) * rise - thick
        flight.append(box((0, k * run, low), (width, (k + 1.1) * run, (k + 1) * rise)))
    length, top = count * run, count * rise
    if not solid:
        for x in (0.0, width):
            flight.append(sweep([(x, 0, 0), (x, length, top)], regular(4, 0.08)))
    if chance(rng, 0.75):
        lift = rng.uniform(0.5, 0.9)
        for k in range(0, count, int(rng.integers(1, 4))):
            y, z = (k + 0.5) * run, (k + 1) * rise
            flight.append(box((width - 0.05, y - 0.02, z), (width, y + 0.02, z + lift)))
        flight.append(sweep([(width, 0, lift), (width, length, top + lift)], 0.04))
    parts = flight
    if chance(rng, 0.4):
        parts = [*flight, box((0, length, top - 0.1), (width, length + width, top))]
        second = move(turn(join(*flight), "z", rng.choice([-1, 1]) * np.pi / 2), 0, length, top)
        parts.append(second if second[..., 0].max() > width else move(second, 0, width))
    return join(*parts)


def vehicle(rng: Rng) -> Soup:
    """A car, truck or trolley: chassis, cabin, load, wheels; driving towards -x."""
    length, width, clear = rng.uniform(1.2, 2.8), rng.uniform(0.6, 1.0), rng.uniform(0.1, 0.25)
    hood, roof = clear + rng.uniform(0.15, 0.5), rng.uniform(0.3, 0.8)
    parts = [box((-length / 2, -width / 2, clear), (length / 2, width / 2, hood))]
    cabin = block(rng.uniform(0.25, 0.6) * length, width * 0.95, roof, rng.uniform(0.6, 0.95))
    parts.append(move(cabin, rng.uniform(-0.25, 0.2) * length, 0, hood))
    if chance(rng):
        load = rng.uniform(0.3, 0.55) * length
        parts.append(
            box(
                (length / 2 - load, -width / 2, hood),
                (length / 2, width / 2, hood + roof * rng.uniform(0.2, 1.4)),
            )
        )
    radius = clear + rng.uniform(0.02, 0.12)
    wheel = turn(extrude(regular(18, radius), 0.15, regular(18, radius * 0.3)), "x", np.pi / 2)
    for x in np.linspace(-0.35, 0.35, rng.integers(2, 4)) * length:
        parts += [move(wheel, x, y + 0.075, radius) for y in (-width / 2, width / 2)]
    if chance(rng, 0.4):
        mast = curve(
            (length * 0.4, 0, hood), (length * 0.4, 0, hood + 1), (-length * 0.3, 0.3, hood + 1.2)
        )
        parts.append(sweep(mast, 0.05))
    for side in (-1, 1)[: rng.integers(0, 3)]:
        parts.append(
            box(
                (-length * 0.3, side * width / 2, hood),
                (-length * 0.27, side * (width / 2 + 0.15), hood + 0.12),
            )
        )
    return join(*parts)
