"""How errors grow as the protocol gets harder: one curve for each method."""

import csv
import dataclasses
import io
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import jax

from dbdnet_jax.data.config import DataConfig
from dbdnet_jax.data.pairs import Protocol
from dbdnet_jax.data.test_pairs import load_test_pairs
from dbdnet_jax.evaluation.methods import Weights, make_methods, possible
from dbdnet_jax.evaluation.run import Row, evaluate_methods
from dbdnet_jax.io.files import write_atomic
from dbdnet_jax.training.parallel import local_mesh

SWEEP_PAIRS = 60  # of each value, unless told otherwise
NOISE_CLIP = 5.0  # standard deviations, as in the paper's protocol


class Sweep(NamedTuple):
    """What is varied: its name and unit, its values, and the protocol with one of them."""

    label: str
    values: tuple[float, ...]
    change: Callable[[Protocol, float], Protocol]


SWEEPS = {
    "crop": Sweep(
        "part of the cloud kept",
        (0.5, 0.6, 0.7, 0.8, 0.9, 1.0),
        lambda protocol, value: dataclasses.replace(protocol, keep=value),
    ),
    "noise": Sweep(
        "standard deviation of the noise",
        (0.0, 0.01, 0.02, 0.03, 0.04, 0.05),
        lambda protocol, value: dataclasses.replace(
            protocol, noise_sigma=value, noise_clip=NOISE_CLIP * value
        ),
    ),
    "rotation": Sweep(
        "largest Euler angle, degrees",
        (15, 30, 45, 60, 90, 120, 180),
        lambda protocol, value: dataclasses.replace(protocol, max_angle_deg=float(value)),
    ),
    "points": Sweep(
        "points before the crop, drawn from a shape's 2,048",
        (256, 512, 1024, 2048, 4096),
        lambda protocol, value: dataclasses.replace(protocol, points=int(value)),
    ),
    "disjoint": Sweep(
        "no point in both clouds: 0 no, 1 yes",
        (0, 1),
        lambda protocol, value: dataclasses.replace(protocol, disjoint=bool(value)),
    ),
}


class SweepPoint(NamedTuple):
    """One method at one value."""

    value: float
    row: Row


def sweep(
    name: str,
    data: DataConfig,
    protocol: Protocol,
    weights: Sequence[Weights],
    folder: str | Path,
    *,
    seed: int,
    count: int,
    devices: int = 1,
) -> Iterator[SweepPoint]:
    """Score the networks and the baselines on ``count`` test pairs for each value of a sweep.

    The pairs are those of the data set, drawn anew under each protocol from the same seed, so that
    a pair keeps its shape from one value to the next; ``seed`` is that of untrained weights, and
    ``devices`` are as for `evaluate`.

    Raises:
        ValueError: scans, whose overlap and motion are given.
    """
    if data.name == "threedmatch":
        raise ValueError(
            "a sweep needs shapes, from which pairs are drawn; config.data.name is 'threedmatch'. "
            "Use configs/cad.py or configs/modelnet.py."
        )
    methods = [
        method
        for method in make_methods(weights, seed)
        if method.traits.moves and not (method.traits.untrained or method.traits.aligned)
    ]
    for value in SWEEPS[name].values:
        changed = SWEEPS[name].change(protocol, value)
        pairs = load_test_pairs(data, changed, Path(folder) / "sweep").pairs
        pairs = jax.tree.map(lambda leaf: leaf[:count], pairs)
        normals = bool(pairs.source_normals.any())
        able = possible(methods, normals=normals, unit_sphere=True)
        for row in evaluate_methods(able, pairs, mesh=local_mesh(devices)):
            yield SweepPoint(value, row)


def save_sweep(name: str, points: list[SweepPoint], run_dir: str | Path, command: str) -> Path:
    """Write RUN_DIR/sweep_NAME.csv, one line for each method and value; returns its path.

    ``command`` is what to show as the way to get here; it stands on every line.
    """
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    head = ("vary", "value", "method", "error_r", "error_t", "median_r", "recall", "seconds")
    writer.writerow([*head, "pairs", "command", "learned"])
    for value, row in points:
        if row.summary is not None:
            figures = (
                row.summary.error_rotation_deg,
                row.summary.error_translation,
                row.summary.median_rotation_deg,
                row.summary.recall_5deg_0p1,
                row.seconds_per_pair,
            )
            writer.writerow(
                [
                    name,
                    value,
                    row.method,
                    *(f"{figure:.6g}" for figure in figures),
                    row.summary.pairs,
                    command,
                    int(row.traits.learned),
                ]
            )
    path = Path(run_dir) / f"sweep_{name}.csv"
    path.parent.mkdir(parents=True, exist_ok=True)
    write_atomic(path, text.getvalue().encode())
    return path


def render_sweep(name: str, points: list[SweepPoint], command: str) -> str:
    """A line for each method, its mean and median rotation error in degrees at each value."""
    values = list(dict.fromkeys(point.value for point in points))
    lines = [f"{SWEEPS[name].label:50s}" + "".join(f"{value:>15g}" for value in values)]
    for method in dict.fromkeys(point.row.method for point in points):
        cells = [_cell(row) for _, row in points if row.method == method]
        lines.append(f"{method:50s}" + "".join(f"{cell:>15s}" for cell in cells))
    lines += ["Error R in degrees: mean / median over the pairs of each value.", command]
    return "\n".join(lines)


def _cell(row: Row) -> str:
    if row.summary is None:
        return "-"
    return f"{row.summary.error_rotation_deg:.1f} / {row.summary.median_rotation_deg:.1f}"
