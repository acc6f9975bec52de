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
from jaxtyping import Bool, Float

from dbdnet_jax.types import Rigid


class Recall(NamedTuple):
    """The share of pairs that are registered, 0..1.

    ``pair_mean`` weighs every pair alike, ``scene_mean`` every scene; ``by_scene`` holds the
    scenes' own recalls.
    """

    pair_mean: float
    scene_mean: float
    by_scene: dict[str, float]


def within_15deg_30cm(
    rotation_error_deg: Float[np.ndarray, " p"], translation_error_m: Float[np.ndarray, " p"]
) -> Bool[np.ndarray, " p"]:
    """Pairs with a rotation error < 15 degrees and a translation error < 0.3 m; NaN is neither."""
    return (np.asarray(rotation_error_deg) < 15.0) & (np.asarray(translation_error_m) < 0.3)


def correspondence_rmse_m(
    predicted: Rigid, source: Float[np.ndarray, "k 3"], target: Float[np.ndarray, "k 3"]
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


def recall(registered: Bool[np.ndarray, " p"], scenes: Sequence[str]) -> Recall:
    """Recall over pairs and over scenes; ``scenes[i]`` is the scene of pair ``i``.

    Raises:
        ValueError: no pair, or not one scene for each.
    """
    registered = np.asarray(registered, dtype=bool)
    if not len(registered) or len(scenes) != len(registered):
        raise ValueError(
            f"recall needs at least one pair and a scene for each; got {len(registered)} pairs and "
            f"{len(scenes)} scenes. Give Info.scenes of the same pairs."
        )
    names = np.array(scenes)
    by_scene = {str(name): float(registered[names == name].mean()) for name in np.unique(names)}
    return Recall(float(registered.mean()), float(np.mean(list(by_scene.values()))), by_scene)


def recall_table(
    rotation_error_deg: Float[np.ndarray, " p"],
    translation_error_m: Float[np.ndarray, " p"],
    rmse_m: Float[np.ndarray, " p"],
    scenes: Sequence[str],
    consecutive: Bool[np.ndarray, " p"],
) -> dict[str, float]:
    """Every recall under a name that says its definition and its mean.

    The last entry is the one to hold against 3DMatch's benchmark; it is left out when all
    fragments are consecutive.
    """
    by_pose = recall(within_15deg_30cm(rotation_error_deg, translation_error_m), scenes)
    near = rmse_within_20cm(rmse_m)
    by_rmse = recall(near, scenes)
    table = {
        "recall (R < 15 deg, t < 0.3 m), pair mean": by_pose.pair_mean,
        "recall (R < 15 deg, t < 0.3 m), scene mean": by_pose.scene_mean,
        "recall (RMSE < 0.2 m), pair mean": by_rmse.pair_mean,
        "recall (RMSE < 0.2 m), scene mean": by_rmse.scene_mean,
    }
    apart = ~np.asarray(consecutive, dtype=bool)
    if apart.any():
        name = "recall (RMSE < 0.2 m, fragments not consecutive), scene mean"
        kept = [scene for scene, far in zip(scenes, apart, strict=True) if far]
        table[name] = recall(near[apart], kept).scene_mean
    return table
