"""Fit what ranks the poses of `align`, and its success probability; show how far to trust it.

    python -m tools.fit_success --params=cad --count=400
    python -m tools.fit_success --params=cad --check   # only measure, on frozen test pairs

Poses of every pair are found once and kept in ``--records``, so an interrupted run goes on where
it was; delete that file when weights or code have changed. Writes the coefficients beside the
weights. The figures printed for the fit are of five folds by shape: no pair is judged by
coefficients that have seen its shape.
"""

import argparse
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
from scipy.optimize import minimize
from tqdm import tqdm

from dbdnet_jax.alignment.align import align
from dbdnet_jax.alignment.arguments import MAX_POINTS
from dbdnet_jax.alignment.candidates import Candidate, examine, far_starts, merged, near_starts
from dbdnet_jax.alignment.consensus import agreed_poses, match_surfaces
from dbdnet_jax.alignment.normalised import as_given, normalise_pair
from dbdnet_jax.alignment.pose_programs import NetworkPose
from dbdnet_jax.alignment.search import Clues, behind, find_clues, incumbent, settle
from dbdnet_jax.alignment.success import (
    SUCCESS_DEG,
    SUCCESS_FILE,
    SUCCESS_PART,
    Coefficients,
    FitFeatures,
    Logistic,
    PoseFeatures,
    fit_features,
)
from dbdnet_jax.alignment.surfaces import PoseFit
from dbdnet_jax.data.frozen import cad_test_pairs
from dbdnet_jax.io.files import write_atomic
from dbdnet_jax.io.programs import keep_compiled_programs
from dbdnet_jax.networks.params import Params
from dbdnet_jax.networks.weights import load_named
from dbdnet_jax.ops.transforms import move, turn_deg
from dbdnet_jax.types import Transform
from tools.scan_pairs import ScanPair, scan_pair

VARIANTS = ("noise", "clean", "disjoint")  # of the frozen test pairs
TEST_PAIRS = 200
FOLDS, BINS = 5, 10
RIDGE = 1.0  # on the weights of standardised features, in units of one pair's loss
# Ranks poses before there is anything to rank them by.
PLAIN = Logistic((0.0,) * 5, (1.0,) * 5, (2.0, 3.0, 0.0, 3.0, 0.0), 0.0)
UNSURE = Logistic(*((x,) * len(PoseFeatures._fields) for x in (0.0, 1.0, 0.0)), 0.0)


class Record(NamedTuple):
    """What is kept of a pair: its poses, how they fit and whether they are right.

    Found near the given orientation, and everywhere.
    """

    near: list[tuple[list, PoseFit, bool]]
    far: list[tuple[list, PoseFit, bool]]
    network: list
    source_overlap: list
    target_overlap: list


def is_right(transform: Transform, pair: ScanPair) -> bool:
    """Whether rotation and place are those of the pair."""
    low, high = np.percentile(pair.target, [1, 99], axis=0)
    middle = pair.source.mean(axis=0)
    shift = np.linalg.norm(move(transform, middle) - move(pair.target_from_source, middle))
    angle = turn_deg(transform[:3, :3].T @ pair.target_from_source[:3, :3])
    return bool(angle < SUCCESS_DEG and shift < SUCCESS_PART * np.linalg.norm(high - low))


def find(params: Params, pair: ScanPair, coefficients: Coefficients) -> Record:
    """The poses of a pair."""
    scene = normalise_pair(pair.source, pair.target, "auto", MAX_POINTS)
    source, target = scene.source.surface, scene.target.surface
    predicted, matched = find_clues(params, scene)
    lists = [
        [
            (x.pose.tolist(), x.fit, is_right(as_given(x.pose, scene), pair))
            for x in examine(starts, source, target, coefficients, close=close)
        ]
        for starts, close in (
            (near_starts(predicted.transform, source), agreed_poses(matched)),
            (far_starts(source, target), []),
        )
    ]
    overlaps = predicted.source_overlap.tolist(), predicted.target_overlap.tolist()
    return Record(*lists, predicted.transform.tolist(), *overlaps)


def records(params: Params, count: int, path: Path) -> Iterator[tuple[ScanPair, Record]]:
    """Every pair and its poses: those in the file, then new ones, which are added to it."""
    held = path.read_text().splitlines() if path.exists() else []
    coefficients = Coefficients(PLAIN, UNSURE)
    for number in tqdm(range(count)):
        pair = scan_pair(number)
        if number < len(held):
            yield pair, Record(*json.loads(held[number]))
            continue
        record = find(params, pair, coefficients)
        with open(path, "a") as file:
            file.write(json.dumps(record) + "\n")
        yield pair, record


def candidates(kept: list, rank: Logistic) -> list[Candidate]:
    """Poses of a record under other coefficients, best first."""
    found = [Candidate(np.array(pose), PoseFit(*fit), 0.0) for pose, fit, _ in kept]
    scored = [x._replace(score=rank.logit(fit_features(x.fit))) for x in found]
    return sorted(scored, key=lambda x: -x.score)


def judged(
    pair: ScanPair, record: Record, coefficients: Coefficients
) -> Iterator[tuple[PoseFeatures, bool, bool]]:
    """Features of the answer near the given orientation and everywhere, and whether it is right."""
    scene = normalise_pair(pair.source, pair.target, "auto", MAX_POINTS)
    overlaps = (np.array(x) for x in (record.source_overlap, record.target_overlap))
    nothing: Any = np.zeros((0, 0))
    predicted = NetworkPose(np.array(record.network), *overlaps, nothing)
    near, far = (candidates(x, coefficients.rank) for x in (record.near, record.far))
    every = merged(near, far, middle=scene.source.surface.points.mean(axis=0))
    sides = scene.source.surface, scene.target.surface
    first = incumbent(predicted, *sides, coefficients)
    near, every = (behind(first, x, sides[0]) for x in (near, every))
    clues = Clues(predicted, match_surfaces(*sides))
    for some, everywhere in ((near, False), (every, True)):
        found = settle(scene, some, clues, coefficients, None, everywhere=everywhere)
        yield found.evidence, is_right(as_given(found.pose, scene), pair), everywhere


def rank_rows(record: Record) -> tuple[list[FitFeatures], list[bool]]:
    """Features of every pose of a pair, and which are right."""
    every = [*record.near, *record.far]
    return [fit_features(PoseFit(*fit)) for _, fit, _ in every], [right for *_, right in every]


def fit(features: np.ndarray, right: np.ndarray) -> Logistic:
    """A ridge logistic regression on standardised features."""
    mean, deviation = features.mean(0), features.std(0) + 1e-9
    x = np.hstack([(features - mean) / deviation, np.ones((len(features), 1))])
    sign = np.where(right, 1.0, -1.0)

    def loss(w):
        return np.logaddexp(0, -sign * (x @ w)).sum() + RIDGE * (w[:-1] ** 2).sum() / 2

    w = minimize(loss, np.zeros(x.shape[1]), method="BFGS").x
    return Logistic(*(tuple(map(float, v)) for v in (mean, deviation, w[:-1])), float(w[-1]))


def predict(features: np.ndarray, fitted: Logistic) -> np.ndarray:
    """Probabilities under coefficients."""
    mean, deviation, weight = (np.array(part) for part in fitted[:3])
    return 1 / (1 + np.exp(-((features - mean) / deviation @ weight + fitted.bias)))


def held_out(features: np.ndarray, right: np.ndarray, shapes: np.ndarray) -> np.ndarray:
    """Probability of every row under a fit without its shape."""
    probability = np.zeros(len(right))
    for fold in range(FOLDS):
        mine = shapes % FOLDS == fold
        probability[mine] = predict(features[mine], fit(features[~mine], right[~mine]))
    return probability


def area_under_curve(probability: np.ndarray, right: np.ndarray) -> float:
    """The chance that a right pose gets a higher probability than a wrong one."""
    above, below = probability[right], probability[~right]
    higher = (above[:, None] > below).mean() if above.size and below.size else np.nan
    return float(higher + (above[:, None] == below).mean() / 2)


def show(probability: np.ndarray, right: np.ndarray) -> dict:
    """Print the reliability curve; return it, its calibration error and the area under the ROC."""
    print("probability      pairs   mean   right")
    error, curve = 0.0, []
    edges = np.linspace(0, 1, BINS + 1)
    for low, high in zip(edges, edges[1:], strict=False):
        inside = (probability >= low) & ((probability < high) | (high == 1))
        if inside.any():
            mean, part = probability[inside].mean(), right[inside].mean()
            error += inside.mean() * abs(mean - part)
            print(f"{low:.1f} .. {high:.1f} {inside.sum():12d} {mean:6.3f} {part:7.3f}")
            curve.append({"pairs": int(inside.sum()), "mean": float(mean), "right": float(part)})
    auc = area_under_curve(probability, right)
    print(f"{right.mean():.1%} of {len(right)} right ({SUCCESS_DEG:g} degrees, {SUCCESS_PART:.0%})")
    print(f"expected calibration error {error:.3f}, area under the ROC curve {auc:.3f}")
    return {"calibration_error": float(error), "auc": auc, "reliability": curve}


def check(params: Params, count: int) -> None:
    """The shipped probability on so many of the frozen test pairs of each set, evenly chosen."""
    found = []
    for variant in VARIANTS:
        pairs = jax.device_get(cad_test_pairs(variant)[0])
        probability, right = [], []
        for i in tqdm(np.arange(count) * TEST_PAIRS // count):
            pair = jax.tree.map(lambda leaf: leaf[i], pairs)  # noqa: B023
            true = np.eye(4)
            true[:3, :3], true[:3, 3] = pair.target_from_source
            clouds = [np.float64(x.points[: int(x.count)]) for x in (pair.source, pair.target)]
            answer = align(*clouds, params)
            probability.append(answer.success_probability)
            right.append(is_right(answer.transform, ScanPair(*clouds, true, int(i))))
        print(f"\n{variant}:")
        show(np.array(probability), np.array(right))
        found.append((np.array(probability), np.array(right)))
    print("\ntogether:")
    show(*map(np.concatenate, zip(*found, strict=True)))


def fit_all(params: Params, count: int, path: Path) -> dict:
    """Both regressions, as they are written, and how far to trust the second one."""
    held = list(records(params, count, path))
    rows = [rank_rows(record) for _, record in held]
    features = np.array([x for row in rows for x in row[0]])
    rank = fit(features, np.array([x for row in rows for x in row[1]]))
    judged_rows = [
        (pair.shape, *answer)
        for pair, record in tqdm(held)
        for answer in judged(pair, record, Coefficients(rank, UNSURE))
    ]
    shapes, evidence, right, everywhere = map(np.array, zip(*judged_rows, strict=True))
    success = fit(evidence, right)
    probability = held_out(evidence, right, shapes)
    figures = {}
    for name, rows_of in (("near", ~everywhere), ("everywhere", everywhere)):
        print(f"\n{name}:")
        figures[name] = show(probability[rows_of], right[rows_of])
    best = [max(zip(*row, strict=True), key=lambda x: rank.logit(x[0]))[1] for row in rows]
    print(f"\na right pose among those found {np.mean([any(row[1]) for row in rows]):.1%}, ")
    print(f"ranked first {np.mean(best):.1%}")
    named = {}
    for name, fitted, kind in (("rank", rank, FitFeatures), ("success", success, PoseFeatures)):
        parts = zip(("mean", "deviation", "weight"), fitted[:3], strict=True)
        named[name] = {part: kind(*values)._asdict() for part, values in parts}
        named[name]["bias"] = fitted.bias
        print(name, {k: round(v, 2) for k, v in named[name]["weight"].items()})
    return named | {"about": {"pairs": count, "five_folds": figures}}


def main() -> None:
    """Fit and write, or check."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--params", default="cad")
    parser.add_argument("--count", type=int, default=400)
    parser.add_argument("--records", type=Path, default=Path("fit_success.jsonl"))
    parser.add_argument("--check", action="store_true")
    parser.add_argument("--output", type=Path, default=SUCCESS_FILE)
    options = parser.parse_args()
    keep_compiled_programs()
    params = load_named(options.params)
    if options.check:
        check(params, min(options.count, TEST_PAIRS))
        return
    text = json.dumps(fit_all(params, options.count, options.records), indent=2)
    options.output.parent.mkdir(exist_ok=True)
    write_atomic(options.output, (text + "\n").encode())


if __name__ == "__main__":
    main()
