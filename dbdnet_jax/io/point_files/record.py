"""What a reader hands back, what is wrong with a file, and points that are none."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

AGAIN = "Export it again."  # the fix of what is cut short or garbled
CHUNK = 65536  # lines of text that are parsed at once


class PointFile(NamedTuple):
    """Points of a file, and what its user should know about how they were read."""

    points: Float[np.ndarray, "n 3"]
    notes: tuple[str, ...] = ()


class FileFault(ValueError):
    """A file that is not what its ending says; the text says what is wrong, and the fix."""


def drop_unmeasured(points: np.ndarray) -> PointFile:
    """Rows with NaN or infinity, a sensor's way to say "no return", left out and counted."""
    if points.ndim != 2 or points.dtype.kind not in "fiu":
        return PointFile(points)
    good = np.isfinite(points).all(axis=1)
    if good.all():
        return PointFile(points)
    lost = len(good) - int(good.sum())
    note = f"{lost} of {len(good)} points have NaN or infinity and were left out"
    return PointFile(points[good], (note,))
