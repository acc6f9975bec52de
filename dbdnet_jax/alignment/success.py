"""The probability that a pose is right, from quantities known without the true one.

A logistic regression, fitted by ``tools/fit_success.py`` on pairs of the validation split; its
coefficients lie beside the weights they belong to.
"""

import json
import math
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from dbdnet_jax.alignment.judging import Judgement, near
from dbdnet_jax.alignment.search import Proposal, Rival, Transform, angle_between, move
from dbdnet_jax.weights import PRETRAINED

SUCCESS_FILE = PRETRAINED / "cad_success.json"
SUCCESS_DEG = 5.0  # a pose is right when its rotation is off by less


class Evidence(NamedTuple):
    """What speaks for or against a pose; every entry free of units."""

    inliers: float  # part of the points of both clouds that have a counterpart
    residual: float  # distance along the normals, root mean square, per inlier distance
    overlap: float  # mean predicted probability
    confidence: float  # mean over the matched points
    stiffness: float  # logarithm of the least held motion's stiffness
    correction: float  # logarithm of 1 + degrees between the network's pose and the refined one
    rival: float  # logarithm of the best rival pose's misfit per this one's misfit
    crowd: float  # how many turns of the pose end in another one that fits about as well


def gather(
    proposal: Proposal,
    pose: Transform,
    judgement: Judgement,
    rival: Rival,
    source: Float[np.ndarray, "n 3"],
    target: Float[np.ndarray, "m 3"],
) -> Evidence:
    """The evidence for a pose; the clouds are those that the network saw, at its scale."""
    moved = move(pose, source)
    shown = near(moved, target, judgement.distance), near(target, moved, judgement.distance)
    predicted = proposal.source_overlap, proposal.target_overlap
    kept = proposal.confidence[proposal.source_kept]
    return Evidence(
        inliers=float(np.mean([x.mean() for x in shown])),
        residual=min(judgement.plane_rmse / judgement.distance, 1.0),
        overlap=float(np.mean([p.mean() for p in predicted])),
        confidence=float(kept.mean()) if kept.size else 0.0,
        stiffness=math.log(max(judgement.stiffness, 1e-6)),
        correction=math.log1p(angle_between(pose, proposal.transform)[0]),
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
