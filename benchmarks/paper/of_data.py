"""The paper's tables on its own data sets, from whatever weights lie in a folder of runs."""

import dataclasses
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from benchmarks.paper import published
from benchmarks.paper.recipes import RECIPES, Recipe, Training
from benchmarks.paper.scoring import classical_methods, figures, first, of_params
from benchmarks.paper.tables import Line, ablation, overlaps, poses
from dbdnet_jax.data.test_pairs import PairSet, load_test_pairs
from dbdnet_jax.evaluation.methods import possible
from dbdnet_jax.networks.weights import load_params
from dbdnet_jax.training.task import RunConfig

# Whether a table's pairs are noisy, and whether its networks saw a half of the categories only.
SHAPE_TABLES = {
    published.UNSEEN_SHAPES: (False, False),
    published.UNSEEN_CATEGORIES: (False, True),
    published.UNSEEN_SHAPES_NOISE: (True, False),
    published.UNSEEN_CATEGORIES_NOISE: (True, True),
}


def tables(config: RunConfig, names: Iterable[str], runs: Path, count: int | None) -> str:
    """Every table that the data set has: four of shapes, overlap and ablation, or one of scans."""
    chosen = {name: RECIPES[name] for name in names}
    if config.data.name == "threedmatch":
        lines = _lines(chosen, runs, False, first(_load(config, runs), count))
        return _titled(published.SCANS, poses(lines, published.POSES[published.SCANS]))
    parts = []
    noisy: dict[str, Mapping[str, Any]] = {}
    for title, (noise, half) in SHAPE_TABLES.items():
        test = first(_load(_under(config, noise, half), runs), count)
        lines = _lines(chosen, runs, half, test)
        parts.append(_titled(title, poses(lines, published.POSES[title])))
        if title == published.UNSEEN_SHAPES_NOISE:
            noisy = {
                name: found
                for name, recipe in chosen.items()
                if (found := _score(name, recipe, runs, False, test)) is not None
            }
    predicted = [
        (recipe.title, noisy.get(name))
        for name, recipe in chosen.items()
        if recipe.title in published.OVERLAP
    ]
    parts.append(_titled("Overlap", overlaps(predicted, published.OVERLAP)))
    steps = {RECIPES[name].step: [found] for name, found in noisy.items() if RECIPES[name].step}
    parts.append(_titled("Ablation", ablation({"ours": steps})))
    return "\n\n".join(parts)


def weights_of(name: str, runs: Path, half: bool) -> Path:
    """Where a method's weights lie: those of a half of the categories apart."""
    return Training(half=half).folder(runs, name) / "params.npz"


def _under(config: RunConfig, noise: bool, half: bool) -> RunConfig:
    protocol = config.protocol if noise else dataclasses.replace(config.protocol, noise_sigma=0.0)
    data = dataclasses.replace(config.data, categories="seen" if half else "all")
    return dataclasses.replace(config, data=data, protocol=protocol)


def _load(config: RunConfig, runs: Path) -> PairSet:
    noise = "noise" if config.protocol.noise_sigma else "clean"
    return load_test_pairs(config.data, config.protocol, runs / f"pairs_{noise}")


def _lines(chosen: Mapping[str, Recipe], runs: Path, half: bool, test: PairSet) -> list[Line]:
    methods = possible(
        list(classical_methods().values()),
        normals=bool(test.pairs.source_normals.any()),
        unit_sphere=test.scans is None,
    )
    lines: list[Line] = [(method.name, figures(method, test)) for method in methods]
    return lines + [
        (recipe.title, _score(name, recipe, runs, half, test))
        for name, recipe in chosen.items()
        if recipe.title and not recipe.overlap_only
    ]


def _score(
    name: str, recipe: Recipe, runs: Path, half: bool, test: PairSet
) -> Mapping[str, Any] | None:
    path = weights_of(name, runs, half)
    return figures(of_params(name, load_params(path)), test) if path.exists() else None


def _titled(title: str, table: str) -> str:
    return f"### {title}\n\n{table}"
