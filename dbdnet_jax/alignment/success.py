"""What ranks poses, and the probability that the chosen one is right, both without the true pose.

Two logistic regressions, fitted by ``tools/fit_success.py`` on validation shapes; their
coefficients lie beside the weights they belong to.
"""

import json
import math
from pathlib import Path
from typing import Any, NamedTuple

from dbdnet_jax.alignment.surfaces import PoseFit
from dbdnet_jax.networks.weights import PRETRAINED

SUCCESS_FILE = PRETRAINED / "cad_success.json"
SUCCESS_DEG = 5.0  # a pose is right when its rotation is off by less ...
SUCCESS_PART = 0.05  # ... and the source's middle by less than this part of the target's extent
PARTS = ("mean", "deviation", "weight")  # of a regression, for each feature


class FitFeatures(NamedTuple):
    """What ranks a pose: a large overlap alone is no merit, but a part that lies well is."""

    tight: float  # logarithm of the part of both clouds that lies on the other's surface
    tight_per_inlier: float  # logarithm of that part of the inliers
    inliers: float  # logarithm of the smaller one of the parts that come near
    normal_agreement: float
    plane_rmse: float


class PoseFeatures(NamedTuple):
    """What speaks for or against the chosen pose; every entry free of units."""

    tight: float
    tight_per_inlier: float
    inliers: float
    normal_agreement: float
    plane_rmse: float
    shared_point_score: float  # whether the clouds have points in common, see `quality`
    overlap_agreement: float  # how well the network's overlap and the inliers agree
    min_eigenvalue: float  # logarithm of the least held motion's eigenvalue
    network_angle: float  # logarithm of 1 + degrees from the network's pose
    last_step_angle: float  # the same of the last refinement
    ambiguity_margin: float  # score of the pose less that of the best other one
    ambiguity_count: float  # how many others fit about as well
    agreeing_matches: float  # logarithm of 1 + the matched surface points that agree, `consensus`
    turn: float  # logarithm of 1 + degrees from the given orientation
    everywhere: float  # 1 where all rotations were searched


class Logistic(NamedTuple):
    """A regression on standardised features: ``(x - mean) / deviation``."""

    mean: tuple[float, ...]
    deviation: tuple[float, ...]
    weight: tuple[float, ...]
    bias: float

    def logit(self, features: tuple[float, ...]) -> float:
        """The logarithm of the odds."""
        parts = zip(features, self.mean, self.deviation, self.weight, strict=True)
        return self.bias + sum(w * (x - m) / d for x, m, d, w in parts)


class Coefficients(NamedTuple):
    """What ranks poses by their fit, and what tells how probably the chosen one is right."""

    rank: Logistic
    success: Logistic


def fit_features(fit: PoseFit) -> FitFeatures:
    """What ranks a pose."""
    tight = fit.source_tight + fit.target_tight
    inliers = fit.source_inliers + fit.target_inliers
    return FitFeatures(
        tight=math.log(math.sqrt(fit.source_tight * fit.target_tight) + 0.01),
        tight_per_inlier=math.log(tight / max(inliers, 1e-9) + 0.01),
        inliers=math.log(min(fit.source_inliers, fit.target_inliers) + 0.01),
        normal_agreement=fit.normal_agreement,
        plane_rmse=fit.plane_rmse,
    )


def fit_score(fit: PoseFit, coefficients: Coefficients) -> float:
    """The logarithm of the odds that a pose is right, by its fit alone."""
    return coefficients.rank.logit(fit_features(fit))


def success_probability(evidence: PoseFeatures, coefficients: Coefficients) -> float:
    """Probability that the pose is right, by `SUCCESS_DEG` and `SUCCESS_PART`."""
    return 1 / (1 + math.exp(-min(max(coefficients.success.logit(evidence), -50.0), 50.0)))


def _logistic(held: dict[str, Any], kind: type[FitFeatures] | type[PoseFeatures]) -> Logistic:
    mean, deviation, weight = (
        tuple(float(held[part][name]) for name in kind._fields) for part in PARTS
    )
    return Logistic(mean, deviation, weight, float(held["bias"]))


def load_coefficients(path: Path = SUCCESS_FILE) -> Coefficients:
    """Read what ``tools/fit_success.py`` wrote.

    Raises:
      ValueError: the file is damaged, or of another release.
      OSError: it cannot be read.
    """
    try:
        held = json.loads(path.read_text())
        rank, success = (
            _logistic(held[name], kind)
            for name, kind in (("rank", FitFeatures), ("success", PoseFeatures))
        )
        return Coefficients(rank, success)
    except (ValueError, KeyError, TypeError) as error:
        raise ValueError(
            f"{path} must hold the coefficients of the success probability; it does not "
            f"({type(error).__name__}: {error}). Run tools/fit_success.py, or reinstall."
        ) from error
