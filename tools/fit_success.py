"""Fit the success probability of `align` on validation pairs, and show how far to trust it.

    python -m tools.fit_success --params=cad
    python -m tools.fit_success --params=cad --check   # only measure, on 3 x 200 frozen test pairs

Writes the coefficients beside the weights. The figures printed for the fit are of five folds by
shape: no pair is judged by coefficients that have seen its shape.
"""

import argparse
import importlib
import json
from collections.abc import Iterator
from pathlib import Path
from unittest import mock

import jax
import numpy as np
from scipy.optimize import minimize
from tqdm import tqdm

from dbdnet_jax.alignment.align import align
from dbdnet_jax.alignment.success import (
    SUCCESS_DEG,
    SUCCESS_FILE,
    Coefficients,
    PoseFeatures,
    load_coefficients,
)
from dbdnet_jax.alignment.success import success_probability as probability_of
from dbdnet_jax.data.cad import cad_split
from dbdnet_jax.data.frozen import cad_test_pairs
from dbdnet_jax.data.pairs import Protocol, make_pair
from dbdnet_jax.io.files import write_atomic
from dbdnet_jax.networks.params import Params
from dbdnet_jax.networks.weights import load_named
from dbdnet_jax.types import Pair

VARIANTS = ("noise", "clean", "disjoint")  # of the frozen test pairs, in the order of:
TEST_PAIRS = 200
PROTOCOLS = (Protocol(), Protocol(noise_sigma=0.0), Protocol(disjoint=True))
SEED = 77
ALIGN = importlib.import_module("dbdnet_jax.alignment.align")  # not the function of that name
FOLDS, BINS = 5, 10
NOTHING = Coefficients(
    *(PoseFeatures(*[x] * len(PoseFeatures._fields)) for x in (0.0, 1.0, 0.0)), bias=0.0
)
RIDGE = 1.0  # on the weights of standardised evidence, in units of one pair's loss


def validation_pairs(count: int) -> Iterator[tuple[int, Pair]]:
    """Shape number and pair: shapes in turn, protocols in turn."""
    shapes = cad_split("val")
    for i, key in enumerate(jax.random.split(jax.random.key(SEED), count)):
        row, protocol = i % len(shapes), PROTOCOLS[i // len(shapes) % len(PROTOCOLS)]
        yield row, jax.device_get(_draw[protocol](key, shapes.points[row], shapes.normals[row]))


_draw = {
    protocol: jax.jit(lambda *x, protocol=protocol: make_pair(*x, protocol))
    for protocol in PROTOCOLS
}


def test_pairs(variant: str) -> Iterator[tuple[int, Pair]]:
    """The frozen test pairs of one variant."""
    pairs, _ = cad_test_pairs(variant)
    for i in range(TEST_PAIRS):
        yield i, jax.tree.map(lambda leaf: leaf[i], pairs)  # noqa: B023


def examine(params: Params, pairs: Iterator[tuple[int, Pair]], count: int):
    """Features (n, fields), success (n,), shape numbers (n,), rotation errors (n,) in degrees."""
    rows, shapes, errors = [], [], []
    for shape, pair in tqdm(pairs, total=count):
        # The coefficients at hand may be of other evidence, and are what is to be made here.
        with mock.patch.object(ALIGN, "load_coefficients", lambda: NOTHING):
            answer = align(pair.source.points, pair.target.points, params)
        delta = answer.rotation.T @ pair.target_from_source.rotation
        rows.append(answer.evidence)
        shapes.append(shape)
        errors.append(np.degrees(np.arccos(np.clip((np.trace(delta) - 1) / 2, -1, 1))))
    errors = np.array(errors)
    return np.array(rows), errors < SUCCESS_DEG, np.array(shapes), errors


def fit(evidence: np.ndarray, success: np.ndarray) -> dict:
    """Coefficients of a ridge logistic regression on standardised evidence."""
    mean, deviation = evidence.mean(0), evidence.std(0) + 1e-9
    x = np.hstack([(evidence - mean) / deviation, np.ones((len(evidence), 1))])
    sign = np.where(success, 1.0, -1.0)

    def loss(w):
        return np.logaddexp(0, -sign * (x @ w)).sum() + RIDGE * (w[:-1] ** 2).sum() / 2

    w = minimize(loss, np.zeros(x.shape[1]), method="BFGS").x
    parts = {"mean": mean, "deviation": deviation, "weight": w[:-1]}
    named = {k: PoseFeatures(*map(float, v))._asdict() for k, v in parts.items()}
    return named | {"bias": float(w[-1])}


def predict(evidence: np.ndarray, fitted: dict) -> np.ndarray:
    """Probabilities under coefficients."""
    mean, deviation, weight = (
        np.array(list(fitted[k].values())) for k in ("mean", "deviation", "weight")
    )
    return 1 / (1 + np.exp(-((evidence - mean) / deviation @ weight + fitted["bias"])))


def held_out(evidence: np.ndarray, success: np.ndarray, shapes: np.ndarray) -> np.ndarray:
    """Probability of every pair under a fit without its shape."""
    probability = np.zeros(len(success))
    for fold in range(FOLDS):
        mine = shapes % FOLDS == fold
        probability[mine] = predict(evidence[mine], fit(evidence[~mine], success[~mine]))
    return probability


def area_under_curve(probability: np.ndarray, success: np.ndarray) -> float:
    """The chance that a right pose gets a higher probability than a wrong one."""
    right, wrong = probability[success], probability[~success]
    above = (right[:, None] > wrong).mean() if right.size and wrong.size else np.nan
    return float(above + (right[:, None] == wrong).mean() / 2)


def show(probability: np.ndarray, success: np.ndarray) -> dict:
    """Print the reliability curve; return it, its calibration error and the area under the ROC."""
    print("probability      pairs   mean   right")
    error, curve = 0.0, []
    edges = np.linspace(0, 1, BINS + 1)
    for low, high in zip(edges, edges[1:], strict=False):
        inside = (probability >= low) & ((probability < high) | (high == 1))
        if inside.any():
            mean, right = probability[inside].mean(), success[inside].mean()
            error += inside.mean() * abs(mean - right)
            print(f"{low:.1f} .. {high:.1f} {inside.sum():12d} {mean:6.3f} {right:7.3f}")
            curve.append({"pairs": int(inside.sum()), "mean": float(mean), "right": float(right)})
    figures = {
        "calibration_error": float(error),
        "auc": area_under_curve(probability, success),
        "reliability": curve,
    }
    print(f"{success.mean():.1%} of {len(success)} right (rotation off < {SUCCESS_DEG:g} degrees)")
    print(f"expected calibration error {error:.3f}, area under the ROC curve {figures['auc']:.3f}")
    return figures


def main() -> None:
    """Fit and write, or check."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--params", default="cad")
    parser.add_argument("--pairs", type=int, default=582)
    parser.add_argument("--check", action="store_true")
    parser.add_argument("--output", type=Path, default=SUCCESS_FILE)
    options = parser.parse_args()
    params = load_named(options.params)
    if options.check:
        held = load_coefficients(options.output)
        found = []
        for variant in VARIANTS:
            evidence, success, _, _ = examine(params, test_pairs(variant), TEST_PAIRS)
            probability = np.array([probability_of(PoseFeatures(*row), held) for row in evidence])
            print(f"\n{variant}:")
            show(probability, success)
            found.append((probability, success))
        print("\ntogether:")
        show(*map(np.concatenate, zip(*found, strict=True)))
        return
    evidence, success, shapes, errors = examine(
        params, validation_pairs(options.pairs), options.pairs
    )
    print(f"mean error {errors.mean():.2f}, median {np.median(errors):.2f} degrees")
    figures = show(held_out(evidence, success, shapes), success)
    fitted = fit(evidence, success)
    for field, weight in fitted["weight"].items():
        print(f"{field:14s} {weight:7.3f}")
    about = {"pairs": len(success), "right": float(success.mean()), "five_folds": figures}
    text = json.dumps(fitted | {"about": about}, indent=2)
    options.output.parent.mkdir(exist_ok=True)
    write_atomic(options.output, (text + "\n").encode())


if __name__ == "__main__":
    main()
