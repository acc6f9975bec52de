"""Household objects with random proportions, z up, the front towards -y.

Every function draws one object from a generator, in units of roughly a metre.
"""

from __future__ import annotations

import numpy as np

from dbdnet_jax.data.procedural.solids import (
    Soup,
    block,
    box,
    curve,
    cylinder,
    extrude,
    join,
    loft,
    move,
    regular,
    revolve,
    ring,
    sweep,
    turn,
)

Rng = np.random.Generator


def chance(rng: Rng, probability: float = 0.5) -> bool:
    """A coin."""
    return bool(rng.random() < probability)


def turned_profile(rng: Rng, radius: float, height: float) -> np.ndarray:
    """Six smoothly joined radii between a foot and a mouth, as (radius, height) rows."""
    knots = radius * rng.uniform(0.3, 1.0, 6)
    t = np.linspace(0.0, 1.0, 20)
    smooth = np.interp(t, np.linspace(0, 1, 6), knots)
    smooth = np.convolve(np.pad(smooth, 2, mode="edge"), [0.1, 0.25, 0.3, 0.25, 0.1], "valid")
    return np.column_stack([smooth, t * height])


def vase(rng: Rng) -> Soup:
    """A vase, jug or teapot: a hollow lathe with handles, a spout or a lid."""
    height = rng.uniform(0.2, 0.6)
    outer = turned_profile(rng, rng.uniform(0.1, 0.3), height)
    inner = outer[:2:-1] * (0.9, 1.0)
    parts = [
        revolve(np.concatenate([[(0.0, 0.0)], outer, inner, [(0.0, height * 0.15)]]), closed=False)
    ]
    low, high = int(rng.integers(2, 8)), int(rng.integers(11, 18))
    reach = outer[:, 0].max() * rng.uniform(1.3, 2.0)
    ear = curve(
        (outer[low, 0], 0, outer[low, 1]),
        (reach, 0, outer[low, 1]),
        (reach, 0, outer[high, 1]),
        (outer[high, 0], 0, outer[high, 1]),
    )
    grip = sweep(ear, rng.uniform(0.01, 0.03))
    for k in range(rng.choice([0, 1, 2], p=[0.25, 0.5, 0.25])):
        parts.append(turn(grip, "z", np.pi * k))
    if chance(rng, 0.4):
        start = (-outer[low, 0] * 0.8, 0, outer[low, 1])
        spout = curve(start, (-reach, 0, start[2]), (-reach, 0, height), (-reach * 1.2, 0, height))
        parts.append(sweep(spout, rng.uniform(0.02, 0.05), np.linspace(1.3, 0.6, 12)))
    if chance(rng, 0.3):
        mouth = outer[-1, 0]
        lid = [(mouth, 0), (mouth * 0.8, 0.03), (0.01, 0.05), (0.03, 0.08), (0.02, 0.1)]
        parts.append(move(revolve(lid), rng.choice([0.0, 0.0, mouth]), 0, height))
    return join(*parts)


def bottle(rng: Rng) -> Soup:
    """A bottle, can or jerrycan: a squarish body with a shoulder, an off-centre neck and a grip."""
    width, depth, height = rng.uniform(0.15, 0.5), rng.uniform(0.1, 0.3), rng.uniform(0.3, 0.9)
    outline = regular(24, 0.5, rng.choice([2.0, 3.0, 6.0])) * (width, depth)
    x, radius = rng.choice([0.0, 0.25]) * width, rng.uniform(0.15, 0.5) * depth
    mouth = regular(24, radius) + (x, 0)
    start = height + rng.uniform(0.05, 0.3)
    top = start + rng.uniform(0.05, 0.2)
    outlines = [(outline * 0.9, 0.0), (outline, 0.03), (outline, height), (mouth, start)]
    parts = [loft([ring(corners, z) for corners, z in [*outlines, (mouth, top)]])]
    if chance(rng, 0.6):
        parts.append(move(cylinder(radius * 1.3, 0.06), x, 0, top - 0.02))
    if chance(rng, 0.75):
        low, high = sorted(rng.uniform(0.1, 1.0, 2) * height)
        side, reach = -width * 0.48, -width * rng.uniform(0.7, 1.1)
        bow = curve((side, 0, low), (reach, 0, low), (reach, 0, high), (side, 0, high + 0.05))
        parts.append(sweep(bow, 0.025))
    if chance(rng, 0.3):
        lever = curve((x, 0, top), (x, 0, top + 0.12), (x - 0.2, 0, top + 0.1))
        parts.append(sweep(lever, 0.02))
    return join(*parts)


def lamp(rng: Rng) -> Soup:
    """A floor, desk or bow lamp: a base, a bent or jointed arm, a shade."""
    height, reach = rng.uniform(0.4, 1.6), rng.uniform(0.0, 0.8)
    foot = rng.uniform(0.1, 0.3)
    if chance(rng, 0.6):
        base = revolve([(foot, 0), (foot, 0.02), (0.05, rng.uniform(0.03, 0.15))])
    else:
        base = block(2 * foot, rng.uniform(1, 2) * foot, rng.uniform(0.02, 0.1))
    elbow = np.array([rng.uniform(-0.3, 0.3), 0, height * rng.uniform(0.4, 0.9)])
    tip = np.array([reach, rng.normal(0, 0.1), height])
    parts = [base]
    if chance(rng):
        middle = (elbow[0], 0, height * 1.2)
        parts.append(sweep(curve((0, 0, 0), elbow, middle, tip), rng.uniform(0.01, 0.03)))
    else:
        parts.append(sweep(np.linspace((0, 0, 0), elbow, 3), 0.015))
        parts.append(sweep(np.linspace(elbow, tip, 3), 0.015))
        parts.append(move(turn(cylinder(0.03, 0.06, 12), "x", np.pi / 2), elbow[0], 0.03, elbow[2]))
    wide, narrow = rng.uniform(0.1, 0.35), rng.uniform(0.03, 0.2)
    sides = int(rng.choice([4, 6, 24]))
    shade = revolve([(wide, -rng.uniform(0.1, 0.4)), (narrow, 0.03)], sides, chance(rng))
    tilt = rng.uniform(-0.9, 0.9) if chance(rng, 0.6) else 0.0
    parts.append(move(turn(shade, "y", tilt), *tip))
    if chance(rng, 0.25):
        parts.append(move(turn(shade * 0.6, "y", -0.6), *(elbow + (0.0, 0.0, 0.1))))
    return join(*parts)


def monitor(rng: Rng) -> Soup:
    """A monitor, television or laptop: a tilted and turned screen on a foot."""
    width, height = rng.uniform(0.4, 1.4), rng.uniform(0.25, 0.8)
    thick = rng.uniform(0.01, 0.15)
    screen = [box((-width / 2, -thick / 2, 0), (width / 2, thick / 2, height))]
    rim = rng.uniform(0.02, 0.06)
    for low, high in (
        ((-width / 2, 0), (width / 2, rim)),
        ((-width / 2, height - rim), (width / 2, height)),
    ):
        screen.append(box((low[0], -thick / 2 - 0.02, low[1]), (high[0], 0, high[1])))
    if chance(rng, 0.4):
        bulge = block(width * 0.7, height * 0.7, rng.uniform(0.1, 0.4), 0.6)
        screen.append(move(turn(bulge, "x", -np.pi / 2), 0, 0, height / 2))
    face = turn(turn(join(*screen), "x", rng.uniform(-0.5, 0.1)), "z", rng.normal(0, 0.25))
    if chance(rng, 0.3):
        deck = box((-width / 2, -height, 0), (width / 2, 0, 0.04))
        pad = box((-width / 6, -height * 0.95, 0.04), (width / 6, -height * 0.7, 0.05))
        keys = box((-width * 0.45, -height * 0.6, 0.04), (width * 0.3, -height * 0.1, 0.06))
        return join(move(face, z=0.04), deck, pad, keys)
    lift, foot = rng.uniform(0.05, 0.3), rng.uniform(0.2, 0.7) * width
    x = rng.choice([0.0, 0.0, 0.3]) * width
    parts = [move(face, z=lift), move(block(foot, foot * 0.6, 0.02), x, 0.05)]
    parts.append(move(block(0.08, 0.05, lift + height / 2), x, 0.05 + thick / 2))
    if chance(rng, 0.3):
        parts.append(move(block(width, 0.2, 0.03), 0, -0.4))
        parts.append(move(block(0.07, 0.12, 0.04), width * 0.65, -0.4))
    return join(*parts)


def sofa(rng: Rng) -> Soup:
    """A sofa or armchair: base, back, arms, cushions and perhaps a longer end."""
    width, depth, seat = rng.uniform(0.7, 2.4), rng.uniform(0.7, 1.0), rng.uniform(0.25, 0.45)
    low, arm = rng.uniform(0.0, 0.15), rng.uniform(0.08, 0.25)
    back = rng.uniform(0.3, 0.6)
    parts = [box((-width / 2, -depth / 2, low), (width / 2, depth / 2, seat))]
    rest = turn(block(width, arm, back + seat, rng.uniform(0.9, 1.0)), "x", -rng.uniform(0, 0.25))
    parts.append(move(rest, 0, depth / 2 - arm / 2, low))
    sides = rng.choice([0, 1, 2], p=[0.15, 0.35, 0.5])
    for side in (-1, 1)[:sides]:
        tall = seat + rng.uniform(0.1, 0.3)
        parts.append(move(block(arm, depth, tall - low), side * (width / 2 + arm / 2), 0, low))
    if chance(rng, 0.3):
        parts.append(
            box((width / 2 - 0.6, -depth / 2 - rng.uniform(0.4, 0.9), low), (width / 2, 0, seat))
        )
    count = max(1, round(width / rng.uniform(0.5, 0.9)))
    step = width / count
    cushion = extrude(regular(20, 0.48, 6.0) * (step, depth * 0.8), rng.uniform(0.08, 0.18))
    for k in range(count):
        x = -width / 2 + (k + 0.5) * step
        parts.append(move(cushion, x, -0.05, seat))
        if chance(rng, 0.6):
            pillow = turn(cushion * (0.8, 0.5, 1.0), "x", 1.2)
            parts.append(move(turn(pillow, "z", rng.normal(0, 0.3)), x, depth / 4, seat + 0.35))
    if low > 0.03:
        foot = cylinder(0.03, low, 8)
        parts += [move(foot, x * width * 0.45, y * depth * 0.4) for x in (-1, 1) for y in (-1, 1)]
    return join(*parts)


def bed(rng: Rng) -> Soup:
    """A bed, cot or bunk: mattress, boards, pillows, a folded blanket, posts or rails."""
    width, depth, low = rng.uniform(0.7, 2.0), rng.uniform(1.8, 2.2), rng.uniform(0.1, 0.4)
    head, foot = low + rng.uniform(0.3, 1.0), low + rng.uniform(0.0, 0.5)
    frame = box((-width / 2, -depth / 2, low), (width / 2, depth / 2, low + 0.1))
    mattress = extrude(regular(28, 0.49, 10.0) * (width, depth), rng.uniform(0.1, 0.3))
    parts = [frame, move(mattress, z=low + 0.1)]
    top = low + 0.1 + np.ptp(mattress[..., 2])
    parts.append(box((-width / 2, depth / 2, 0), (width / 2, depth / 2 + 0.06, head)))
    parts.append(box((-width / 2, -depth / 2 - 0.05, 0), (width / 2, -depth / 2, foot)))
    pillow = extrude(regular(16, 0.5, 4.0) * (0.6, 0.4), 0.12)
    for k in range(rng.integers(1, 4)):
        x = (k - 0.5) * width * 0.45
        parts.append(
            move(turn(pillow, "z", rng.normal(0, 0.2)), min(x, width / 3), depth * 0.38, top)
        )
    if chance(rng, 0.6):
        end = rng.uniform(-0.2, 0.3) * depth
        parts.append(box((-width * 0.53, -depth / 2, low + 0.1), (width * 0.53, end, top + 0.03)))
    if chance(rng, 0.3):
        post, tall = block(0.07, 0.07, 1.0), rng.uniform(0.8, 2.0)
        corners = [(x * width / 2, y * depth / 2) for x in (-1, 1) for y in (-1, 1)]
        parts += [move(post * (1, 1, tall), x, y) for x, y in corners]
        if chance(rng):
            parts.append(move(frame, z=tall - low - 0.1))
    if chance(rng, 0.4):
        side = rng.choice([-1, 1]) * (width / 2 + 0.3)
        parts.append(move(block(0.45, 0.4, rng.uniform(0.3, 0.7)), side, depth * 0.4))
    return join(*parts)


def plant(rng: Rng) -> Soup:
    """A pot with bent stems, each ending in a leaf."""
    pot, height = rng.uniform(0.1, 0.25), rng.uniform(0.15, 0.4)
    parts = [revolve([(pot * rng.uniform(0.5, 1.0), 0), (pot, height), (pot * 0.85, height * 0.9)])]
    for _ in range(rng.integers(3, 10)):
        reach, tall = rng.uniform(0.1, 0.5), rng.uniform(0.2, 0.9)
        path = curve((0, 0, height * 0.8), (0, 0, tall), (reach, 0, height + tall), steps=8)
        leaf = regular(8, 1.0) * (rng.uniform(0.03, 0.12), 0.004)
        growth = np.array([0.05, 0.08, 0.1, 0.3, 0.7, 1.0, 0.8, 0.1])
        parts.append(turn(sweep(path, leaf, growth), "z", rng.uniform(0, 2 * np.pi)))
    return join(*parts)
