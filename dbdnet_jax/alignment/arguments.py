"""What `align` may be asked for: options of use, or an error before any work."""

import numbers
from typing import Any

import numpy as np

from dbdnet_jax.ops.transforms import as_transform
from dbdnet_jax.types import Transform

SEARCHES = ("auto", "near", "any")
FEWEST_POINTS, MAX_POINTS = 64, 768  # the weights were trained on 717; a little more costs nothing


def check_options(
    refine: bool = True,
    search: Any = "auto",
    scale: Any = "auto",
    overlap_threshold: Any = None,
    max_points: Any = MAX_POINTS,
    initial: Any = None,
    proposals: Any = (),
) -> tuple[Transform | None, list[Transform]]:
    """The guess and the proposals of options of `align`, as exact transforms.

    Raises:
      ValueError: words, numbers or transforms of no use, by the option's name.
    """
    if search not in SEARCHES:
        raise ValueError(
            f"search must be one of {', '.join(SEARCHES)}; got {search!r}. Use 'auto'."
        )
    if not refine and search == "any":
        raise ValueError(
            "search must be 'auto' or 'near' with refine=False, which searches nothing; got 'any'. "
            "Leave out one of the two."
        )
    if scale != "auto" and not (_is_number(scale) and 0 < scale < np.inf):
        raise ValueError(f"scale must be 'auto' or a positive number; got {scale!r}. Use 'auto'.")
    if overlap_threshold is not None and not (
        _is_number(overlap_threshold) and 0 <= overlap_threshold < 1
    ):
        raise ValueError(
            f"overlap_threshold must be in [0, 1); got {overlap_threshold!r}. Leave it out for the "
            "network's own."
        )
    if not (_is_number(max_points) and max_points == int(max_points) >= FEWEST_POINTS):
        raise ValueError(
            f"max_points must be a whole number of at least {FEWEST_POINTS}; got {max_points!r}. "
            f"Use {MAX_POINTS}."
        )
    given = () if proposals is None else proposals
    proposed = [check_transform(x, f"proposals[{i}]") for i, x in enumerate(given)]
    return None if initial is None else check_transform(initial), proposed


def check_transform(values: Any, name: str = "initial") -> Transform:
    """A 4x4 rigid transform, its rotation made exact.

    Raises:
      ValueError: it is none.
    """
    try:
        transform = np.asarray(values, np.float64)
    except (TypeError, ValueError) as error:
        raise ValueError(
            f"{name} must be a 4x4 array of numbers: {error}. Give rows of four numbers."
        ) from error
    if transform.shape != (4, 4):
        raise ValueError(
            f"{name} must be 4x4 and finite; got shape {transform.shape}. Append 0 0 0 1 to a "
            "rotation and its translation."
        )
    if not np.isfinite(transform).all():
        first = transform[~np.isfinite(transform)][0]
        raise ValueError(
            f"{name} must be 4x4 and finite; it holds {first}. Leave it out where nothing is known."
        )
    rotation = transform[:3, :3]
    skew = np.abs(rotation @ rotation.T - np.eye(3)).max()
    if skew > 1e-3 or np.linalg.det(rotation) < 0 or (transform[3] != [0, 0, 0, 1]).any():
        raise ValueError(
            f"{name} must be a rotation and a translation with a last row of 0 0 0 1; its rotation "
            f"misses orthogonality by {skew:.2g}, with determinant {np.linalg.det(rotation):.3g}. "
            "Remove scale and reflection."
        )
    return as_transform(rotation, transform[:3, 3])


def _is_number(value: Any) -> bool:
    """Whether it is a real number, NumPy's included; True is none."""
    return isinstance(value, numbers.Real) and not isinstance(value, bool | np.bool_)
