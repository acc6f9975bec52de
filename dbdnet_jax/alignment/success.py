"""The probability that a pose is right, from quantities known without the true one.

A logistic regression, fitted by ``tools/fit_success.py`` on pairs of the validation split; its
coefficients lie beside the weights they belong to.
"""

import json
import math
from pathlib import Path
from typing import NamedTuple

import numpy as np

from dbdnet_jax.alignment.quality import Judgement
from dbdnet_jax.alignment.search import Proposal, Rival, Transform, angle_between
from dbdnet_jax.networks.weights import PRETRAINED

SUCCESS_FILE = PRETRAINED / "cad_success.json"
SUCCESS_DEG = 5.0  # a pose is right when its rotation is off by less


class Evidence(NamedTuple):
    """What speaks for or against a pose; every entry free of units."""

    residual: float  # distance along the normals, root mean square, per inlier distance
    coincidence: float  # of points that both clouds have in common, see `quality.coincidence`
    sureness: float  # mean distance of the overlap probabilities from one half
    stiffness: float  # logarithm of the least held motion's stiffness
    correction: float  # logarithm of 1 + degrees between the network's pose and the refined one
    drift: float  # the same between the pose and what refining it once more makes of it
    rival: float  # logarithm of the best rival pose's misfit per this one's misfit
    crowd: float  # how many turns of the pose end in another one that fits about as well


def gather(
    proposal: Proposal, pose: Transform, judgement: Judgement, rival: Rival, coincidence: float
) -> Evidence:
    """The evidence for a pose."""
    predicted = proposal.source_overlap, proposal.target_overlap
    return Evidence(
        residual=min(judgement.plane_rmse / judgement.distance, 1.0),
        coincidence=coincidence,
        sureness=float(np.mean([np.abs(p - 0.5).mean() for p in predicted])),
        stiffness=math.log(max(judgement.stiffness, 1e-6)),
        correction=math.log1p(angle_between(pose, proposal.transform)[0]),
        drift=math.log1p(rival.drift_deg),
        rival=rival.margin,
        crowd=rival.crowd,
    )


class Coefficients(NamedTuple):
    """Of the regression on standardised evidence: ``(x - mean) / deviation``."""

    mean: Evidence
    deviation: Evidence
    weight: Evidence
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
            mean=Evidence(**held["mean"]),
            deviation=Evidence(**held["deviation"]),
            weight=Evidence(**held["weight"]),
            bias=float(held["bias"]),
        )
    except (ValueError, KeyError, TypeError) as error:
        raise ValueError(
            f"{path} must hold the coefficients of the success probability; it does not "
            f"({type(error).__name__}: {error}). Run tools/fit_success.py, or reinstall."
        ) from error


def success_probability(evidence: Evidence, coefficients: Coefficients) -> float:
    """Probability that the rotation is off by less than `SUCCESS_DEG` degrees."""
    mean, deviation, weight, bias = coefficients
    terms = zip(evidence, mean, deviation, weight, strict=True)
    logit = bias + sum(w * (x - m) / d for x, m, d, w in terms)
    return 1 / (1 + math.exp(-min(max(logit, -50.0), 50.0)))
