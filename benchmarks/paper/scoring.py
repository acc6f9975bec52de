"""Weights and methods scored on test pairs, and the files that keep what was scored."""

import hashlib
import json
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import jax
import numpy as np

from benchmarks.machine import record
from benchmarks.paper.classical import gicp, kiss_matcher
from benchmarks.paper.recipes import RECIPES, Training, trainings
from benchmarks.paper.training import POINTS
from dbdnet_jax.data.cad import cad_split
from dbdnet_jax.data.frozen import CAD_VARIANTS, cad_test_pairs
from dbdnet_jax.data.symmetry import symmetric_shapes
from dbdnet_jax.data.test_pairs import PairSet
from dbdnet_jax.evaluation.methods import Method, Traits, from_network, from_points, make_methods
from dbdnet_jax.evaluation.run import Row, evaluate_method
from dbdnet_jax.io.files import write_atomic
from dbdnet_jax.metrics.pose import summarise
from dbdnet_jax.networks.params import Params
from dbdnet_jax.networks.weights import load_params

SETS = ("noise", "clean", "disjoint", "unseen")
RESULTS = Path(__file__).parents[1] / "results" / "paper_cad"
Figures = dict[str, Any]


def of_half(key: str) -> bool:
    """Whether a set's networks see a half of the categories only: its pairs are of the other."""
    return CAD_VARIANTS[key][1] is not None


def frozen_set(variant: str) -> PairSet:
    """A frozen set of pairs of the embedded test shapes."""
    pairs, digest = cad_test_pairs(variant)
    shapes = cad_split("test", CAD_VARIANTS[variant][1])
    symmetric = symmetric_shapes(shapes.points)[np.arange(len(pairs.source.count)) % len(shapes)]
    return PairSet(f"cad_test_{variant}", pairs, digest, symmetric=symmetric)


def first(test: PairSet, count: int | None) -> PairSet:
    """The first pairs of a set; its hash stays that of the whole."""
    if count is None or count >= len(test.pairs.source.count):
        return test
    return test._replace(
        name=f"{test.name}_first_{count}",
        pairs=jax.tree.map(lambda leaf: leaf[:count], test.pairs),
        symmetric=None if test.symmetric is None else test.symmetric[:count],
        scans=test.scans and test.scans.first(count),
    )


def figures(method: Method, test: PairSet) -> Figures:
    """All that the tables show of a method on one set, as plain values."""
    row = evaluate_method(method, test.pairs, test.scans)
    found: Figures = {"set": test.name, "sha256": test.digest}
    if row.note:
        return found | {"note": row.note}
    found["seconds_per_pair"] = row.seconds_per_pair
    if row.overlap is not None:
        found["overlap"] = row.overlap._asdict()
    return found | _poses(row, test)


def _poses(row: Row, test: PairSet) -> Figures:
    if row.summary is None or row.errors is None:
        return {}
    found: Figures = {"all": row.summary._asdict()}
    if row.point_distance is not None:
        found["point_distance"] = float(row.point_distance.mean())
    if test.symmetric is not None:
        for kind, chosen in (("plain", ~test.symmetric), ("symmetric", test.symmetric)):
            if chosen.any():
                errors = jax.tree.map(lambda leaf, chosen=chosen: leaf[chosen], row.errors)
                found[kind] = summarise(errors)._asdict()
    return found


def of_params(title: str, params: Params) -> Method:
    """Weights as a method."""
    return Method(title, from_network(params), Traits(learned=True))


def classical_methods() -> dict[str, Method]:
    """The methods without weights, by the names of their files."""
    more = [Method("KISS-Matcher", from_points(kiss_matcher)), Method("GICP", from_points(gicp))]
    methods = [*make_methods([], seed=0), *more]
    return {
        "_".join(method.name.lower().replace(",", "").replace("-", " ").split()): method
        for method in methods
    }


def score_runs(
    names: Iterable[str],
    runs: Path,
    seed_count: int,
    sets: Mapping[str, PairSet],
    results: Path = RESULTS,
) -> None:
    """Score every run's parameters that its method's file does not hold yet."""
    for name in names:
        recipe = RECIPES[name]
        held = read_row(results, name) or {"method": recipe.title or recipe.step, "seeds": {}}
        changed = False
        for half in (False, True):
            tests = {key: test for key, test in sets.items() if of_half(key) == half}
            for training in trainings(recipe, seed_count, half):
                folder = training.folder(runs, name)
                known = points_of(held, training)
                new = {
                    point: found
                    for point in POINTS
                    if (found := _scored(name, folder, point, tests, known)) is not None
                }
                if new:
                    changed = True
                    held["seeds"][_named(training)] = known | new
        if changed:
            write_row(results, name, held)


def score_classical(sets: Mapping[str, PairSet], results: Path = RESULTS) -> None:
    """Score the methods without weights on the sets that their files do not hold yet."""
    for name, method in classical_methods().items():
        held = read_row(results, name) or {"method": method.name, "sets": {}}
        missing = {key: test for key, test in sets.items() if not _holds(held, key, test)}
        found = {key: figures(method, test) for key, test in missing.items()}
        if found and not any("note" in figure for figure in found.values()):
            write_row(results, name, held | {"sets": held["sets"] | found})


def points_of(held: Figures, training: Training) -> Figures:
    """What a method's file holds of one of its trainings, by the point where it was stopped."""
    found: Figures = held["seeds"].get(_named(training), {})
    return found


def _named(training: Training) -> str:
    return "seen" if training.half else str(training.seed)


def _scored(
    name: str, folder: Path, point: str, sets: Mapping[str, PairSet], known: Figures
) -> Figures | None:
    """A point's weights on the sets; None of weights that are not there, or known already."""
    path, spent = folder / f"{point}.npz", folder / f"{point}.json"
    if not sets or not path.exists():
        return None
    digest = hashlib.sha256(path.read_bytes()).hexdigest()[:12]
    held = known.get(point, {})
    if held.get("weights") == digest and all(_holds(held, *item) for item in sets.items()):
        return None
    method = of_params(name, load_params(path))
    return {
        "weights": digest,
        "spent": json.loads(spent.read_text()) if spent.exists() else None,
        "sets": {key: figures(method, test) for key, test in sets.items()},
    }


def _holds(held: Figures, key: str, test: PairSet) -> bool:
    """Whether a method's figures on this very set are there."""
    scored = held.get("sets", {}).get(key, {})
    return (scored.get("set"), scored.get("sha256")) == (test.name, test.digest)


def read_row(results: Path, name: str) -> Figures | None:
    """What is kept of a method; None where there is nothing."""
    path = results / f"{name}.json"
    return json.loads(path.read_text()) if path.exists() else None


def write_row(results: Path, name: str, held: Figures) -> None:
    """Keep it, with what it was measured on and by which command."""
    results.mkdir(parents=True, exist_ok=True)
    text = json.dumps({**held, "measured": record("benchmarks.paper", {})}, indent=1)
    write_atomic(results / f"{name}.json", (text + "\n").encode())
