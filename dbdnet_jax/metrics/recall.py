"""Registration recall on 3DMatch and 3DLoMatch by the two definitions in use, on the host.

- **Rotation < 15 degrees and translation < 0.3 m** (Choy et al. 2020), usually a mean over pairs.
- **RMSE of the ground-truth correspondences < 0.2 m** (Zeng et al. 2017), usually a mean over the
  scenes' own recalls. The benchmark of 3DMatch leaves out pairs of consecutive fragments, and its
  toolbox estimates the RMSE from a covariance file; here it is computed from the points.

The same answers score differently under each, so the definition is part of every name here.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Shaped

from dbdnet_jax.types import Registration, Rigid


class Scans(NamedTuple):
    """What recall needs of ``p`` pairs of scans beside the motions; one entry for each pair.

    ``scenes`` are names, ``consecutive`` marks neighbours in the scanner's path, and
    ``correspondences`` are source and target points (k, 3) that meet under the true pose, metres.
    """

    scenes: Sequence[str]
    consecutive: Bool[np.ndarray, " p"]
    correspondences: Sequence[tuple[Float[np.ndarray, "k 3"], Float[np.ndarray, "k 3"]]]

    def first(self, count: int) -> Scans:
        """Those of the first pairs."""
        return Scans(self.scenes[:count], self.consecutive[:count], self.correspondences[:count])


class ScanRecall(NamedTuple):
    """The share of pairs that are registered, 0..1, under either definition.

    A pair mean weighs every pair alike, a scene mean every scene. ``..._apart`` leaves out
    consecutive fragments: the one to hold against 3DMatch's benchmark, None when there is no
    other pair.
    """

    recall_15deg_30cm_pair_mean: float
    recall_15deg_30cm_scene_mean: float
    recall_rmse_20cm_pair_mean: float
    recall_rmse_20cm_scene_mean: float
    recall_rmse_20cm_scene_mean_apart: float | None


def within_15deg_30cm(
    rotation_error_deg: Float[np.ndarray, " p"], translation_error_m: Float[np.ndarray, " p"]
) -> Bool[np.ndarray, " p"]:
    """Pairs with a rotation error < 15 degrees and a translation error < 0.3 m; NaN is neither."""
    return (np.asarray(rotation_error_deg) < 15.0) & (np.asarray(translation_error_m) < 0.3)


def correspondence_rmse_m(
    predicted: Rigid | Registration,
    source: Float[np.ndarray, "k 3"],
    target: Float[np.ndarray, "k 3"],
) -> float:
    """Root of the mean over the true correspondences of ``|R source + t - target|^2``, metres.

    NaN without a correspondence and for a motion that is not finite.
    """
    if not len(source):
        return float("nan")
    rotation = np.asarray(predicted.rotation, np.float64)
    moved = np.asarray(source, np.float64) @ rotation.T + np.asarray(predicted.translation)
    return float(np.sqrt(((moved - target) ** 2).sum(-1).mean()))


def rmse_within_20cm(rmse_m: Float[np.ndarray, " p"]) -> Bool[np.ndarray, " p"]:
    """Pairs whose correspondences have an RMSE < 0.2 m; NaN has not."""
    return np.asarray(rmse_m) < 0.2


def scene_mean(registered: Bool[np.ndarray, " p"], scenes: Shaped[np.ndarray, " p"]) -> float:
    """Mean over the scenes of each one's share; ``scenes[i]`` is the scene of pair ``i``."""
    return float(np.mean([registered[scenes == scene].mean() for scene in np.unique(scenes)]))


def scan_recall(
    rotation_error_deg: Float[np.ndarray, " p"],
    translation_error_m: Float[np.ndarray, " p"],
    rmse_m: Float[np.ndarray, " p"],
    scans: Scans,
) -> ScanRecall:
    """Every recall of one method.

    Raises:
        ValueError: no pair, or not one scene for each.
    """
    scenes, pairs = np.array(scans.scenes), len(rmse_m)
    if not pairs or len(scenes) != pairs:
        raise ValueError(
            f"recall needs at least one pair and a scene for each; got {pairs} pairs and "
            f"{len(scenes)} scenes. Give the Scans of the same pairs."
        )
    posed = within_15deg_30cm(rotation_error_deg, translation_error_m)
    near = rmse_within_20cm(rmse_m)
    apart = ~np.asarray(scans.consecutive, bool)
    return ScanRecall(
        recall_15deg_30cm_pair_mean=float(posed.mean()),
        recall_15deg_30cm_scene_mean=scene_mean(posed, scenes),
        recall_rmse_20cm_pair_mean=float(near.mean()),
        recall_rmse_20cm_scene_mean=scene_mean(near, scenes),
        recall_rmse_20cm_scene_mean_apart=(
            scene_mean(near[apart], scenes[apart]) if apart.any() else None
        ),
    )
