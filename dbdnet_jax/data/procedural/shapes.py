"""Thousands of furniture-like and mechanical shapes from random numbers, for training only."""

from __future__ import annotations

import numpy as np

from dbdnet_jax.data.procedural import furniture, household, parts
from dbdnet_jax.data.procedural.solids import Soup, mirror
from dbdnet_jax.data.shapes import Shapes
from dbdnet_jax.data.surface import KEPT, even_points

FAMILIES = (
    furniture.table,
    furniture.chair,
    furniture.shelf,
    furniture.cupboard,
    household.sofa,
    household.bed,
    household.lamp,
    household.vase,
    household.bottle,
    household.monitor,
    household.plant,
    parts.gear,
    parts.pipe,
    parts.bracket,
    parts.machine,
    parts.tool,
    parts.stairs,
    parts.vehicle,
)


def procedural_shapes(count: int, seed: int) -> Shapes:
    """``count`` shapes of 2048 evenly spaced points each, y up as in the embedded CAD set.

    Shape i depends on (seed, i) alone, so a longer set begins with a shorter one. Labels name the
    family; everything the shapes have no history for is "". About 15 ms a shape on one core.

    Raises:
        ValueError: count or seed is negative.
    """
    if count < 0 or seed < 0:
        raise ValueError(f"count and seed must not be negative; got {count} and {seed}.")
    points = np.empty((count, KEPT, 3), np.float32)
    normals = np.empty((count, KEPT, 3), np.float32)
    labels = []
    for i in range(count):
        rng = np.random.default_rng((seed, i))
        label, soup = procedural_solid(rng)
        vertices = soup.reshape(-1, 3)
        triangles = np.arange(len(vertices)).reshape(-1, 3)
        points[i], normals[i] = even_points(vertices, triangles, rng)
        labels.append(label)
    nothing = np.full(count, "")
    return Shapes(
        points=points,
        normals=normals,
        names=np.array([f"{label} {i}" for i, label in enumerate(labels)], dtype=str),
        labels=np.array(labels, dtype=str),
        halves=nothing,
        categories=nothing,
        libraries=np.full(count, "procedural"),
        paths=np.array([f"{seed}/{i}" for i in range(count)], dtype=str),
        creators=nothing,
        licences=nothing,
    )


def procedural_solid(rng: np.random.Generator) -> tuple[str, Soup]:
    """The family and the triangles of one shape: drawn, stretched, tapered, perhaps mirrored."""
    family = FAMILIES[rng.integers(len(FAMILIES))]
    soup = family(rng)
    soup = soup[..., [0, 2, 1]] * (1, 1, -1)  # z up becomes y up
    soup = soup * np.exp(rng.normal(0.0, 0.15, 3))
    height = (soup[..., 1:2] - soup[..., 1].min()) / max(np.ptp(soup[..., 1]), 1e-9)
    soup[..., [0, 2]] *= 1 + rng.normal(0.0, 0.1) * height
    return family.__name__, mirror(soup, 0) if rng.random() < 0.5 else soup
