"""The probability that a pose is right, from quantities known without the true one.

A logistic regression, fitted by ``tools/fit_success.py`` on pairs of the validation split; its
coefficients lie beside the weights they belong to.
"""

import json
import math
from pathlib import Path
from typing import NamedTuple

import numpy as np

from dbdnet_jax.alignment.quality import PoseQuality
from dbdnet_jax.alignment.search import AlternativePose, NetworkPose, Transform, angle_between
from dbdnet_jax.networks.weights import PRETRAINED

SUCCESS_FILE = PRETRAINED / "cad_success.json"
SUCCESS_DEG = 5.0  # a pose is right when its rotation is off by less


class PoseFeatures(NamedTuple):
    """What speaks for or against a pose; every entry free of units."""

    plane_rmse: float  # distance along the normals, root mean square, per inlier distance
    shared_point_score: float  # whether the clouds have points in common, see `quality`
    overlap_confidence: float  # mean distance of the overlap probabilities from one half
    min_eigenvalue: float  # logarithm of the least held motion's eigenvalue
    refinement_angle: float  # logarithm of 1 + degrees from the network's pose to the refined one
    refinement_drift: float  # the same between the pose and what refining it once more makes of it
    ambiguity_margin: float  # logarithm of the best alternative's truncated RMSE per this pose's
    ambiguity_count: float  # how many turns of the pose end in another one that fits about as well


def gather(
    predicted: NetworkPose,
    pose: Transform,
    quality: PoseQuality,
    alternative: AlternativePose,
    shared_point_score: float,
) -> PoseFeatures:
    """The evidence for a pose."""
    overlap = predicted.source_overlap, predicted.target_overlap
    return PoseFeatures(
        plane_rmse=min(quality.plane_rmse / quality.distance, 1.0),
        shared_point_score=shared_point_score,
        overlap_confidence=float(np.mean([np.abs(p - 0.5).mean() for p in overlap])),
        min_eigenvalue=math.log(max(quality.min_eigenvalue, 1e-6)),
        refinement_angle=math.log1p(angle_between(pose, predicted.transform)[0]),
        refinement_drift=math.log1p(alternative.refinement_drift_deg),
        ambiguity_margin=alternative.margin,
        ambiguity_count=alternative.alternatives,
    )


class Coefficients(NamedTuple):
    """Of the regression on standardised evidence: ``(x - mean) / deviation``."""

    mean: PoseFeatures
    deviation: PoseFeatures
    weight: PoseFeatures
    bias: float


def load_coefficients(path: Path = SUCCESS_FILE) -> Coefficients:
    """Read what ``tools/fit_success.py`` wrote.

    Raises:
      ValueError: the file is damaged, or of another release.
      OSError: it cannot be read.
    """
    try:
        held = json.loads(path.read_text())
        return Coefficients(
            mean=PoseFeatures(**held["mean"]),
            deviation=PoseFeatures(**held["deviation"]),
            weight=PoseFeatures(**held["weight"]),
            bias=float(held["bias"]),
        )
    except (ValueError, KeyError, TypeError) as error:
        raise ValueError(
            f"{path} must hold the coefficients of the success probability; it does not "
            f"({type(error).__name__}: {error}). Run tools/fit_success.py, or reinstall."
        ) from error


def success_probability(evidence: PoseFeatures, coefficients: Coefficients) -> float:
    """Probability that the rotation is off by less than `SUCCESS_DEG` degrees."""
    mean, deviation, weight, bias = coefficients
    terms = zip(evidence, mean, deviation, weight, strict=True)
    logit = bias + sum(w * (x - m) / d for x, m, d, w in terms)
    return 1 / (1 + math.exp(-min(max(logit, -50.0), 50.0)))
