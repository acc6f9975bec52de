"""Points checked at the door: (n, 3) float64, finite, or an error."""

from typing import Any

import numpy as np

from dbdnet_jax.types import Points

MIN_POINTS = 16
LARGEST = 1e100  # of a coordinate: squares and their sums must stay finite


def check_points(values: Any, name: str = "points") -> Points:
    """``values`` as (n, 3) float64, or a ValueError that says rule, value and fix."""
    if np.ma.is_masked(values):
        raise ValueError(
            f"{name} must have no masked entries. Give values[~values.mask.any(1)].data."
        )
    try:
        array = np.asarray(values)
    except Exception as error:  # ragged lists, tensors on another device, odd objects
        raise ValueError(
            f"{name} must be an (n, 3) array of numbers; got {type(values).__name__}: {error}. "
            "Convert it with numpy first."
        ) from error
    if array.dtype.kind not in "fiu":
        raise ValueError(
            f"{name} must hold real numbers; got dtype {array.dtype} ({type(values).__name__}). "
            "Give float or int coordinates."
        )
    if array.ndim != 2 or array.shape[1] != 3:
        raise ValueError(f"{name} must be (n, 3); got {array.shape}. {_shape_advice(array.shape)}")
    if len(array) < MIN_POINTS:
        raise ValueError(
            f"{name} must have at least {MIN_POINTS} points; got {len(array)}. Give more points."
        )
    bad = ~np.isfinite(array).all(axis=1)
    if bad.any():
        raise ValueError(
            f"{name} must be finite; {bad.sum()} of {len(array)} points have NaN or infinity, "
            f"the first at row {bad.argmax()}. Give points[np.isfinite(points).all(1)]."
        )
    points = np.asarray(array, np.float64)
    low, high = points.min(axis=0), points.max(axis=0)
    size = max(float(abs(low).max()), float(abs(high).max()))
    if not size < LARGEST:
        raise ValueError(
            f"{name} must have coordinates below {LARGEST:g}; got {size:g}. Change the unit."
        )
    if not (high - low).max() > 1e-12 * size:
        raise ValueError(f"{name} must hold different points; all {len(points)} are {low}.")
    return points


def _shape_advice(shape: tuple[int, ...]) -> str:
    if len(shape) == 2 and shape[0] == 3:
        return "Rows are points: give points.T."
    if len(shape) == 2 and shape[1] == 2:
        return "For points in a plane add a column of zeros."
    if len(shape) == 2 and shape[1] > 3:
        return "Give the coordinates alone: points[:, :3]."
    if len(shape) == 3:
        return "Give one cloud at a time."
    return "Rows are points, columns x, y, z."
