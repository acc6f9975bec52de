"""The record every data set of whole shapes is read into."""

from __future__ import annotations

import dataclasses

import numpy as np
from jaxtyping import Bool, Float, Int, Shaped


@dataclasses.dataclass(frozen=True, eq=False)
class Shapes:
    """``s`` shapes of ``n`` surface points each, in the unit sphere, with what is known of them.

    The points' centroid is the origin and the largest norm 1; normals have unit length, and their
    side is whatever the source meshes say. All other fields are text, one entry per shape, and ""
    where the data set has nothing to say: ``labels`` holds the shape class, ``halves`` "seen" or
    "unseen" (the two halves of the classes, for training on one and testing on the other),
    ``libraries`` and ``paths`` where the shape comes from.
    """

    points: Float[np.ndarray, "s n 3"]
    normals: Float[np.ndarray, "s n 3"]
    names: Shaped[np.ndarray, " s"]
    labels: Shaped[np.ndarray, " s"]
    halves: Shaped[np.ndarray, " s"]
    categories: Shaped[np.ndarray, " s"]
    libraries: Shaped[np.ndarray, " s"]
    paths: Shaped[np.ndarray, " s"]
    creators: Shaped[np.ndarray, " s"]
    licences: Shaped[np.ndarray, " s"]

    def __len__(self) -> int:
        return len(self.points)


def select(shapes: Shapes, index: Int[np.ndarray, " k"] | Bool[np.ndarray, " s"]) -> Shapes:
    """The shapes at ``index`` (rows, or a mask over all), as a copy."""
    fields = dataclasses.fields(shapes)
    return Shapes(**{field.name: getattr(shapes, field.name)[index] for field in fields})


def joined(first: Shapes, second: Shapes) -> Shapes:
    """Both sets as one, the first one first."""
    fields = [field.name for field in dataclasses.fields(first)]
    pairs = {name: (getattr(first, name), getattr(second, name)) for name in fields}
    return Shapes(**{name: np.concatenate(both) for name, both in pairs.items()})
