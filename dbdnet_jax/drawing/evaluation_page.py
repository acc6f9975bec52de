"""The page about an evaluation: its tables, how errors spread, pairs to look at, and sweeps."""

import csv
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from jaxtyping import Float

from dbdnet_jax.drawing import figures
from dbdnet_jax.drawing.figures import Curve
from dbdnet_jax.drawing.page import Plot, render
from dbdnet_jax.evaluation.run import Evaluation, Row
from dbdnet_jax.evaluation.sweep import SWEEPS
from dbdnet_jax.evaluation.tables import tables

LEAST_DEG, LEAST_UNIT = 1e-2, 1e-4  # where the logarithmic axes begin


def evaluation_page(evaluation: Evaluation, run_dir: str | Path) -> bytes:
    """A self-contained HTML file of an evaluation and of the sweeps in ``run_dir``."""
    places = {row.method: place for place, row in enumerate(evaluation.rows)}
    return render(
        "evaluation.html.jinja",
        evaluation=evaluation,
        best=_best(evaluation),
        tables=tables(evaluation),
        charts=[*_distributions(evaluation, places), *_sweeps(Path(run_dir), places)],
        examples=_examples(evaluation),
    )


def _best(evaluation: Evaluation) -> str:
    """The network's own line in a sentence."""
    row = network_row(evaluation)
    if row is None or row.summary is None:
        return "No figures of the network."
    summary = row.summary
    return (
        f"{row.method}: a median rotation error of {summary.median_rotation_deg:.2f}°, and "
        f"{summary.recall_5deg_0p1:.1%} of the pairs below 5° and 0.1."
    )


def network_row(evaluation: Evaluation) -> Row | None:
    """The first row of trained weights that has a motion."""
    for row in evaluation.rows:
        if row.traits.learned and not row.traits.untrained and row.summary is not None:
            return row
    return None


def _distributions(evaluation: Evaluation, places: dict[str, int]) -> Iterator[Plot]:
    """For every method the share of pairs below each error."""
    scored = [(row, row.errors) for row in evaluation.rows if row.errors is not None]
    if not scored:
        return
    for heading, field, axis, least in (
        ("Rotation errors", "rotation_deg", "rotation error, degrees", LEAST_DEG),
        ("Translation errors", "translation", "translation error, units of the clouds", LEAST_UNIT),
    ):
        text = "Share of the pairs whose error is below; higher and farther left is better."
        lines = [
            _cumulative(row, places[row.method], getattr(errors, field), least)
            for row, errors in scored
        ]
        log = {"type": "log", "dtick": 1, "exponentformat": "none"}
        figure = figures.curves(lines, axis, "pairs, %", "lines", **log)
        yield Plot(heading, text, figure)


def _cumulative(row: Row, place: int, errors: Float[np.ndarray, " p"], least: float) -> Curve:
    errors = np.maximum(np.sort(errors), least)
    share = 100 * np.arange(1, len(errors) + 1) / len(errors)
    return Curve(row.method, place, errors.tolist(), share.tolist(), row.traits.learned)


def _sweeps(run_dir: Path, places: dict[str, int]) -> Iterator[Plot]:
    """A chart for each sweep that was saved."""
    for path in sorted(run_dir.glob("sweep_*.csv")):
        name = path.stem.removeprefix("sweep_")
        try:
            figure = figures.curves(*_read_sweep(path, name, places), mode="lines+markers")
        except (ValueError, KeyError, TypeError) as error:
            yield Plot(f"Sweep: {name}", f"{path.name} could not be read: {error!r}.")
        else:
            text = "Mean rotation error as the pairs get harder or easier; lower is better."
            yield Plot(f"Sweep: {name}", text, figure)


def _read_sweep(path: Path, name: str, places: dict[str, int]) -> tuple[list[Curve], str, str]:
    """Curves and the words at the axes."""
    found: dict[str, list[tuple[float, float]]] = {}
    learned = {}
    with path.open(newline="", encoding="utf-8") as file:
        for line in csv.DictReader(file):
            point = float(line["value"]), float(line["error_r"])
            found.setdefault(line["method"], []).append(point)
            learned[line["method"]] = line.get("learned") == "1"
    if not found:
        raise ValueError("it holds no line")
    lines = [
        Curve(
            method,
            places.get(method, place),
            [x for x, _ in points],
            [y for _, y in points],
            learned=learned[method],
        )
        for place, (method, points) in enumerate(found.items(), len(places))
    ]
    label = SWEEPS[name].label if name in SWEEPS else name
    return lines, label, "error, degrees"


def _examples(evaluation: Evaluation) -> Iterator[Plot]:
    """The network's best, median and worst pair, before and after."""
    row, pairs = network_row(evaluation), evaluation.test_pairs
    if row is None or pairs is None or row.errors is None or row.motions is None:
        return
    order = np.argsort(row.errors.rotation_deg, kind="stable")
    for name, place in (("Best", 0), ("Median", len(order) // 2), ("Worst", -1)):
        i = order[place]
        source, target = (
            np.asarray(cloud.points[i, : cloud.count[i]]) for cloud in (pairs.source, pairs.target)
        )
        moved = source @ row.motions.rotation[i].T + row.motions.translation[i]
        error = row.errors.rotation_deg[i], row.errors.translation[i]
        text = f"{row.method}, pair {i}: off by {error[0]:.2f}° and {error[1]:.3f}."
        yield Plot(
            f"{name} pair by rotation error, before",
            "As given.",
            figures.two_clouds(source, target),
        )
        yield Plot(f"{name} pair by rotation error, after", text, figures.two_clouds(moved, target))
