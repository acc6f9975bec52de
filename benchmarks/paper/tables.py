"""The paper's tables as Markdown: our figures, and the paper's own beside them; empty if none."""

import statistics
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from benchmarks.paper import published
from benchmarks.paper.recipes import RECIPES, Training
from benchmarks.paper.scoring import SETS, classical_methods, of_half, points_of, read_row
from benchmarks.paper.training import POINTS

POSE = {  # the paper's columns, and their digits
    "RMSE R": ("rmse_euler_deg", 3),
    "RMSE t": ("rmse_translation", 3),
    "MAE R": ("mae_euler_deg", 3),
    "MAE t": ("mae_translation", 3),
    "Error R": ("error_rotation_deg", 3),
    "Error t": ("error_translation", 3),
}
ISOTROPIC = dict(list(POSE.items())[-2:])
OVERLAP = ("accuracy", "precision", "recall", "f1")
Line = tuple[str, Mapping[str, Any] | None]  # a method's title and its figures on one set


def table(heads: Sequence[str], body: Iterable[Sequence[str]]) -> str:
    """A Markdown table."""
    rows = [heads, ["---"] * len(heads), *body]
    return "\n".join(f"| {' | '.join(row)} |" for row in rows)


def number(value: float | None, digits: int) -> str:
    """A figure; nothing where there is none."""
    return "" if value is None else f"{value:.{digits}f}"


def poses(lines: Sequence[Line], paper: Mapping[str, published.Figures]) -> str:
    """All the paper's columns, ours and then its own."""
    heads = ["method", *POSE, *(f"paper: {head}" for head in POSE)]
    body = []
    for title, figures in lines:
        ours = _summary(figures, "all", POSE)
        body.append([title, *ours, *_published(paper.get(title), POSE)])
    return table(heads, body)


def poses_by_symmetry(lines: Sequence[Line], paper: Mapping[str, published.Figures]) -> str:
    """All the paper's columns, the plain and the symmetric shapes apart, and its Error R and t."""
    kinds = ("plain", "symmetric")
    heads = ["method", *POSE, "median R", "< 5 deg, 0.1"]
    heads += [f"{kind}: {head}" for kind in kinds for head in ISOTROPIC]
    heads += ["s/pair", *(f"paper: {head}" for head in ISOTROPIC)]
    more = {"median": ("median_rotation_deg", 2), "recall": ("recall_5deg_0p1", 3)}
    body = []
    for title, figures in lines:
        cells = [title, *_summary(figures, "all", POSE | more)]
        for kind in kinds:
            cells += _summary(figures, kind, ISOTROPIC)
        seconds = None if figures is None else figures.get("seconds_per_pair")
        body.append([*cells, number(seconds, 3), *_published(paper.get(title), ISOTROPIC)])
    return table(heads, body)


def overlaps(lines: Sequence[Line], paper: Mapping[str, published.Figures]) -> str:
    """Overlap prediction, ours and the paper's."""
    body = []
    for title, figures in lines:
        ours = (figures or {}).get("overlap", {})
        theirs = paper.get(title, (None,) * len(OVERLAP))
        body.append(
            [
                title,
                *(number(ours.get(name), 4) for name in OVERLAP),
                *(number(value, 4) for value in theirs),
            ]
        )
    heads = [name.capitalize() for name in OVERLAP]
    return table(["overlap", *heads, *(f"paper: {head}" for head in heads)], body)


def ablation(columns: Mapping[str, Mapping[str, Sequence[Mapping[str, Any]]]]) -> str:
    """The ladder: Error R and t of each step under each heading, and the paper's.

    Of several figures, which are of several seeds, the mean and the sample standard deviation.
    """
    heads = ["step", *(f"{name}: {head}" for name in columns for head in ISOTROPIC)]
    body = []
    for step, theirs in published.ABLATION.items():
        cells = [step]
        for steps in columns.values():
            found = steps.get(step, ())
            for field, digits in ISOTROPIC.values():
                cells.append(spread([figures["all"][field] for figures in found], digits))
        body.append([*cells, *_published(theirs, ISOTROPIC)])
    return table([*heads, *(f"paper: {head}" for head in ISOTROPIC)], body)


def spread(values: Sequence[float], digits: int) -> str:
    """Mean and sample standard deviation; of one value, itself."""
    if len(values) < 2:
        return number(values[0] if values else None, digits)
    return f"{statistics.mean(values):.{digits}f} +- {statistics.stdev(values):.{digits}f}"


def of_results(results: Path) -> str:
    """All tables of the embedded shapes, from the files of the methods."""
    parts = []
    methods = {name: recipe for name, recipe in RECIPES.items() if recipe.title}
    for point in POINTS:
        training = "the same pairs" if point == "pairs" else "the same core-minutes"
        for key in SETS:
            lines = [_classical(results, name, key) for name in classical_methods()]
            lines += [
                (recipe.title, learned_figures(results, name, point, key))
                for name, recipe in methods.items()
                if not recipe.overlap_only
            ]
            paper = _PAPER[key]
            against = f", the paper's {paper.lower()} beside" if paper else ""
            parts += [
                f"### {key}, {training}{against}",
                poses_by_symmetry(lines, published.POSES.get(paper, {})),
            ]
        lines = [
            (recipe.title, learned_figures(results, name, point, "noise"))
            for name, recipe in methods.items()
            if recipe.title in published.OVERLAP or recipe.title in _ALSO_OVERLAP
        ]
        parts += [f"### Overlap, noise, {training}", overlaps(lines, published.OVERLAP)]
    columns = {
        f"{key}, {point}": _steps(results, point, key) for point in POINTS for key in ("noise",)
    }
    return "\n\n".join([*parts, "### The ladder, mean and spread over seeds", ablation(columns)])


# Beside the noisy pairs stands the only table of the paper whose figures are known for all methods.
_PAPER = {
    "noise": published.UNSEEN_CATEGORIES_NOISE,
    "clean": published.UNSEEN_SHAPES,
    "disjoint": "",
    "unseen": published.UNSEEN_CATEGORIES_NOISE,
}
_ALSO_OVERLAP = ("OMNet", "DBDNet as shipped")


def learned_figures(results: Path, name: str, point: str, key: str) -> Mapping[str, Any] | None:
    """A learned method's figures on one set after one of the two trainings."""
    held = read_row(results, name) or {"seeds": {}}
    return points_of(held, Training(half=of_half(key))).get(point, {}).get("sets", {}).get(key)


def _classical(results: Path, name: str, key: str) -> Line:
    held = read_row(results, name)
    title = classical_methods()[name].name
    return title, None if held is None else held["sets"].get(key)


def _steps(results: Path, point: str, key: str) -> dict[str, list[Mapping[str, Any]]]:
    found: dict[str, list[Mapping[str, Any]]] = {}
    for name, recipe in RECIPES.items():
        held = read_row(results, name)
        for points in held["seeds"].values() if recipe.step and held else ():
            figures = points.get(point, {}).get("sets", {}).get(key)
            if figures is not None:
                found.setdefault(recipe.step, []).append(figures)
    return found


def _summary(
    figures: Mapping[str, Any] | None, part: str, columns: Mapping[str, tuple[str, int]]
) -> list[str]:
    held = (figures or {}).get(part, {})
    return [number(held.get(field), digits) for field, digits in columns.values()]


def _published(
    figures: published.Figures | None, columns: Mapping[str, tuple[str, int]]
) -> list[str]:
    """The last of the paper's figures, as many as there are columns."""
    held = list(figures or (None,) * len(POSE))[-len(columns) :]
    return [
        number(value, digits) for value, (_, digits) in zip(held, columns.values(), strict=True)
    ]
