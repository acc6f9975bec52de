"""Tables of results: as text for people, as CSV and JSON for programs.

Every column head carries its definition and unit, and every table the command, the seed and the
hash of the test pairs that it came from.
"""

import csv
import io
import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from dbdnet_jax.evaluation.run import Evaluation, Row
from dbdnet_jax.io.files import write_atomic
from dbdnet_jax.metrics.pose import OverlapSummary, Summary
from dbdnet_jax.metrics.recall import ScanRecall

CONSTANT_NAME = "all points overlapping (constant)"


class Column(NamedTuple):
    """Three lines of head (name, definition, unit) and how a cell is written."""

    head: tuple[str, str, str]
    cell: Callable[[Row], str]


def _figure(field: str, digits: int) -> Callable[[Row], str]:
    def cell(row: Row) -> str:
        return "-" if row.summary is None else f"{getattr(row.summary, field):.{digits}f}"

    return cell


def _percent(part: str, field: str) -> Callable[[Row], str]:
    def cell(row: Row) -> str:
        record = getattr(row, part)
        share = None if record is None else getattr(record, field)
        return "-" if share is None else f"{100 * share:.1f} %"

    return cell


def _seconds(row: Row) -> str:
    return "-" if row.seconds_per_pair is None else f"{row.seconds_per_pair:.3f}"


MOTION_COLUMNS = (
    Column(("RMSE R", "Euler", "deg"), _figure("rmse_euler_deg", 3)),
    Column(("RMSE t", "x, y, z", "unit"), _figure("rmse_translation", 4)),
    Column(("MAE R", "Euler", "deg"), _figure("mae_euler_deg", 3)),
    Column(("MAE t", "x, y, z", "unit"), _figure("mae_translation", 4)),
    Column(("Error R", "mean", "deg"), _figure("error_rotation_deg", 3)),
    Column(("Error t", "mean", "unit"), _figure("error_translation", 4)),
    Column(("Error R", "median", "deg"), _figure("median_rotation_deg", 3)),
    Column(("Error t", "median", "unit"), _figure("median_translation", 4)),
    Column(("Recall", "< 5 deg", "& < 0.1"), _percent("summary", "recall_5deg_0p1")),
    Column(("Recall", "< 15 deg", "& < 0.3"), _percent("summary", "recall_15deg_0p3")),
    Column(("Time", "median", "s/pair"), _seconds),
)
RECALL_COLUMNS = tuple(
    Column(head, _percent("recall", field))
    for field, head in {
        "recall_15deg_30cm_pair_mean": ("R < 15 deg", "t < 0.3 m", "pair mean"),
        "recall_15deg_30cm_scene_mean": ("R < 15 deg", "t < 0.3 m", "scene mean"),
        "recall_rmse_20cm_pair_mean": ("RMSE", "< 0.2 m", "pair mean"),
        "recall_rmse_20cm_scene_mean": ("RMSE", "< 0.2 m", "scene mean"),
        "recall_rmse_20cm_scene_mean_apart": ("RMSE, apart", "< 0.2 m", "scene mean"),
    }.items()
)
OVERLAP_HEADS = (
    ("Accuracy", "right /", "all points"),
    ("Precision", "TP /", "(TP + FP)"),
    ("Recall", "TP /", "(TP + FN)"),
    ("F1", "2 TP /", "(2 TP+FP+FN)"),
)
DEFINITIONS = """\
RMSE, MAE: over all pairs and the three components of the predicted minus the true Euler angles
(xyz, extrinsic, not wrapped) and translation. Error R: angle of R_true^T R (geodesic). Error t:
norm of the translation of T_true^-1 T. Recall: share of pairs with both errors below. Unit: that of
the clouds. An answer that is not finite counts as 180 deg and 2 |t_true|. Time: wall clock, one
pair at a time on one device, compilation excluded; of 20 pairs where devices share them."""
RECALL_DEFINITIONS = """\
Share of pairs with a rotation error < 15 deg and a translation error < 0.3 m, or with an RMSE
< 0.2 m: that of all true correspondences, the points of the whole source fragment whose nearest
target point under the true pose is closer than config.protocol.overlap_radius. Pair mean: every
pair counts alike; scene mean: every scene does. Apart: without pairs of consecutive fragments, as
3DMatch's benchmark counts."""
OVERLAP_DEFINITIONS = """\
Probability > 0.5 counts as overlapping; TP, FP, FN pooled over the points of both clouds of all
pairs."""


SYMMETRY_HEADS = (
    ("Error R", "mean", "deg"),
    ("Error R", "median", "deg"),
    ("Error t", "mean", "unit"),
    ("Points", "mean", "unit"),
)
SYMMETRY_DEFINITIONS = """\
A shape is symmetric when a turn of 30 degrees or more about its main axes brings it onto itself:
its rotation has no single right answer. Points: mean distance from the moved source points to the
nearest point of both clouds in their true places, which forgives such a turn."""


class Table(NamedTuple):
    """Heads of three lines, a line of cells for each method, and what to read below them."""

    title: str
    heads: Sequence[tuple[str, str, str]]
    body: Sequence[Sequence[str]]
    notes: Sequence[str]


def tables(evaluation: Evaluation) -> list[Table]:
    """Errors of the motion; then, where there are any, recall, symmetric shapes apart, overlap."""
    rows = evaluation.rows
    notes = [DEFINITIONS, *_remarks(rows)]
    found = [_of_columns("Errors", "method", MOTION_COLUMNS, rows, notes)]
    if any(row.recall for row in rows):
        head, notes = "registration recall", [RECALL_DEFINITIONS]
        found.append(_of_columns("Registration recall", head, RECALL_COLUMNS, rows, notes))
    if evaluation.symmetric is not None:
        found.append(_by_symmetry(rows, np.asarray(evaluation.symmetric)))
    predicted = [(row.method, row.overlap) for row in rows if row.overlap is not None]
    if predicted:
        constant = evaluation.constant_overlap
        body = [
            [name, *(f"{value:.4f}" for value in overlap)]
            for name, overlap in [*predicted, (CONSTANT_NAME, constant)]
        ]
        unskilled = [
            f"{name}: accuracy and F1 are not both above those of the constant answer, so they "
            "show no skill at finding the overlap."
            for name, overlap in predicted
            if overlap.accuracy <= constant.accuracy or overlap.f1 <= constant.f1
        ]
        heads = [("overlap prediction", "", ""), *OVERLAP_HEADS]
        found.append(Table("Overlap prediction", heads, body, [OVERLAP_DEFINITIONS, *unskilled]))
    return found


def _by_symmetry(rows: Sequence[Row], symmetric: np.ndarray) -> Table:
    """Errors on the pairs of shapes without a symmetry, and on the others."""
    kinds = {"plain": ~symmetric, "symmetric": symmetric}
    kinds = {kind: chosen for kind, chosen in kinds.items() if chosen.any()}
    heads = [("by symmetry", "", "")]
    for kind in kinds:
        heads += [(f"{name} {kind}", of, unit) for name, of, unit in SYMMETRY_HEADS]
    body = []
    for row in rows:
        if row.errors is None or row.point_distance is None:
            continue
        cells = [row.method]
        for chosen in kinds.values():
            rotation = row.errors.rotation_deg[chosen]
            translation = row.errors.translation[chosen]
            cells += [
                f"{rotation.mean():.3f}",
                f"{np.median(rotation):.3f}",
                f"{translation.mean():.4f}",
                f"{row.point_distance[chosen].mean():.4f}",
            ]
        body.append(cells)
    counts = ", ".join(f"{chosen.sum()} {kind}" for kind, chosen in kinds.items())
    return Table(
        "Symmetric shapes apart", heads, body, [f"Pairs: {counts}. " + SYMMETRY_DEFINITIONS]
    )


def render(evaluation: Evaluation) -> str:
    """The tables as fixed-width text, with the definitions and where the figures come from."""
    parts = [
        part
        for table in tables(evaluation)
        for part in (_fixed_width(table.heads, table.body), *table.notes, "")
    ]
    return "\n".join([*parts, _provenance(evaluation)])


def save(evaluation: Evaluation, folder: str | Path) -> None:
    """Write ``evaluation_SET.csv`` and ``.json`` into ``folder``, named by the set of pairs."""
    Path(folder).mkdir(parents=True, exist_ok=True)
    stem = Path(folder) / f"evaluation_{evaluation.pair_set}"
    write_csv(stem.with_suffix(".csv"), evaluation)
    write_json(stem.with_suffix(".json"), evaluation)


def write_csv(path: str | Path, evaluation: Evaluation) -> None:
    """One line per method (and one for the constant overlap), a column per figure; atomic.

    A figure that does not exist is an empty cell. The provenance stands on every line.
    """
    text = io.StringIO()
    lines = [*(_flat(row) for row in evaluation.rows), _flat_constant(evaluation)]
    provenance = _provenance_fields(evaluation)
    writer = csv.DictWriter(text, [*lines[0], *provenance], lineterminator="\n")
    writer.writeheader()
    writer.writerows(line | provenance for line in lines)
    write_atomic(Path(path), text.getvalue().encode())


def write_json(path: str | Path, evaluation: Evaluation) -> None:
    """The same figures as one JSON object: provenance, then ``rows``; atomic."""
    lines = [*(_flat(row) for row in evaluation.rows), _flat_constant(evaluation)]
    content = _provenance_fields(evaluation) | {"rows": lines}
    text = json.dumps(content, indent=1, allow_nan=False) + "\n"
    write_atomic(Path(path), text.encode())


def _of_columns(
    title: str, first: str, columns: Sequence[Column], rows: Sequence[Row], notes: Sequence[str]
) -> Table:
    """A table of one line for each method."""
    heads = [(first, "", ""), *(column.head for column in columns)]
    body = [[row.method, *(column.cell(row) for column in columns)] for row in rows]
    return Table(title, heads, body, notes)


def _fixed_width(heads: Sequence[tuple[str, str, str]], body: Sequence[Sequence[str]]) -> str:
    """Fixed-width columns two spaces apart, the first to the left, the others to the right."""
    lines = [list(line) for line in zip(*heads, strict=True)]
    widths = [max(map(len, cells)) for cells in zip(*lines, *body, strict=True)]
    rule = "-" * (sum(widths) + 2 * (len(widths) - 1))

    def line(cells: Sequence[str]) -> str:
        first, *rest = zip(cells, widths, strict=True)
        return "  ".join([first[0].ljust(first[1]), *(c.rjust(w) for c, w in rest)]).rstrip()

    return "\n".join([*map(line, lines), rule, *map(line, body), rule])


def _remarks(rows: Sequence[Row]) -> list[str]:
    remarks = [f"{row.method}: {row.note}" for row in rows if row.note]
    return remarks + [
        f"{row.method}: {row.summary.non_finite} of {row.summary.pairs} answers were not finite."
        for row in rows
        if row.summary is not None and row.summary.non_finite
    ]


def _provenance(evaluation: Evaluation) -> str:
    return (
        f"{evaluation.pairs} pairs of {evaluation.pair_set}, sha256 {evaluation.pairs_hash}; "
        f"seed {evaluation.seed}; {evaluation.device}\n{evaluation.command}"
    )


def _provenance_fields(evaluation: Evaluation) -> dict[str, Any]:
    return {
        key: value
        for key, value in evaluation._asdict().items()
        if key not in ("rows", "constant_overlap", "test_pairs", "symmetric")
    }


def _flat(row: Row) -> dict[str, Any]:
    summary = dict.fromkeys(Summary._fields) if row.summary is None else row.summary._asdict()
    recall = dict.fromkeys(ScanRecall._fields) if row.recall is None else row.recall._asdict()
    del summary["pairs"]  # the report's own figure
    return (
        {"method": row.method}
        | summary
        | _flat_overlap(row.overlap)
        | recall
        | {"point_distance": _mean(row.point_distance)}
        | {"seconds_per_pair": row.seconds_per_pair, "note": row.note}
    )


def _mean(values: np.ndarray | None) -> float | None:
    return None if values is None else float(values.mean())


def _flat_overlap(overlap: OverlapSummary | None) -> dict[str, Any]:
    values = overlap or (None,) * len(OverlapSummary._fields)
    return {
        f"overlap_{field}": value
        for field, value in zip(OverlapSummary._fields, values, strict=True)
    }


def _flat_constant(evaluation: Evaluation) -> dict[str, Any]:
    return _flat(Row(CONSTANT_NAME)) | _flat_overlap(evaluation.constant_overlap)
