"""Every method on the same test pairs, one pair at a time: errors and wall time."""

import os
import time
from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float
from tqdm import tqdm

from dbdnet_jax.data.test_pairs import PairSet
from dbdnet_jax.errors import MissingExtraError
from dbdnet_jax.evaluation.methods import Method, Traits, Weights, make_methods, possible
from dbdnet_jax.metrics.pose import (
    Confusion,
    OverlapSummary,
    PairErrors,
    Summary,
    motion_errors,
    pair_confusion,
    point_distance,
    summarise,
    summarise_overlap,
)
from dbdnet_jax.metrics.recall import ScanRecall, Scans, correspondence_rmse_m, scan_recall
from dbdnet_jax.types import Answer, Pair, Rigid


class Row(NamedTuple):
    """One method's line of a table.

    Without a summary the method gives no motion, without an overlap it predicts none; without
    both, the note says why it could not run. ``recall`` is there for pairs of scans only.
    ``errors``, ``motions`` and the `point_distance` have a leading axis of pairs.
    """

    method: str
    summary: Summary | None = None
    seconds_per_pair: float | None = None
    note: str = ""
    recall: ScanRecall | None = None
    errors: PairErrors | None = None
    motions: Rigid | None = None
    point_distance: Float[np.ndarray, " pairs"] | None = None
    overlap: OverlapSummary | None = None
    traits: Traits = Traits()


class Evaluation(NamedTuple):
    """Rows, what a constant scores beside them, and all that is needed to get them again."""

    rows: Sequence[Row]
    constant_overlap: OverlapSummary
    pair_set: str
    pairs: int
    pairs_hash: str
    seed: int
    command: str
    device: str
    test_pairs: Pair | None = None
    symmetric: Bool[np.ndarray, " pairs"] | None = None  # whether a turn keeps the pair's shape


def evaluate(
    weights: Sequence[Weights], test: PairSet, *, seed: int, command: str, count: int | None = None
) -> Evaluation:
    """Score networks, the same untrained (from ``seed``), and the baselines on test pairs.

    ``count`` keeps the first pairs only, which the name then says (the hash stays that of the
    whole set); ``command`` is what to show as the way to get here.

    Raises:
        ValueError: params without the networks that their method needs.
    """
    name, pairs, digest, scans, symmetric = test
    if count is not None and count < len(pairs.source.count):
        name = f"{name}_first_{count}"
        pairs = jax.tree.map(lambda leaf: leaf[:count], pairs)
        scans = scans and scans.first(count)
        symmetric = symmetric if symmetric is None else symmetric[:count]
    methods = possible(
        make_methods(weights, seed),
        normals=bool(pairs.source_normals.any()),
        unit_sphere=scans is None,
    )
    return Evaluation(
        rows=evaluate_methods(methods, pairs, scans),
        constant_overlap=constant_overlap(pairs),
        pair_set=name,
        pairs=len(pairs.source.count),
        pairs_hash=digest,
        seed=seed,
        command=command,
        device=f"{jax.devices()[0].device_kind}, {os.cpu_count()} cores",
        test_pairs=pairs,
        symmetric=symmetric,
    )


class _Scored(NamedTuple):
    """What is kept of one answer; None for what the method does not say."""

    errors: PairErrors | None
    motion: Rigid | None
    overlap: Confusion | None


def evaluate_method(method: Method, pairs: Pair, scans: Scans | None = None) -> Row:
    """One method over stacked NumPy pairs (leading axis on every field).

    With ``scans``, those of the same pairs, the row has their registration recall too.

    The time is the median over the pairs of the wall seconds until the answer is there. The
    method is called once on the first pair beforehand, so that no compilation is in it. A method
    whose library is missing gives a row with a note instead of figures.
    """
    score = jax.jit(_score)
    scores: list[_Scored] = []
    seconds: list[float] = []
    rmse_m: list[float] = []
    row = Row(method.name, traits=method.traits)
    try:
        jax.block_until_ready(method.answer(_pair(pairs, 0)))
        for i in range(len(pairs.source.count)):
            pair = _pair(pairs, i)
            start = time.perf_counter()
            answer = jax.block_until_ready(method.answer(pair))
            seconds.append(time.perf_counter() - start)
            scores.append(jax.device_get(score(answer, pair)))
            if scans is not None and answer.motion is not None:
                rmse_m.append(correspondence_rmse_m(answer.motion, *scans.correspondences[i]))
    except MissingExtraError as error:
        return row._replace(note=str(error))
    errors, motions, overlap = jax.tree.map(lambda *leaves: np.stack(leaves), *scores)
    row = row._replace(
        seconds_per_pair=float(np.median(seconds)),
        overlap=None if overlap is None else summarise_overlap(overlap),
    )
    if errors is None:
        return row
    row = row._replace(summary=summarise(errors), errors=errors, motions=motions)
    if scans is None:
        return row._replace(point_distance=np.asarray(_point_distances(motions, pairs)))
    recall = scan_recall(errors.rotation_deg, errors.translation, np.array(rmse_m), scans)
    return row._replace(recall=recall)


@jax.jit
def _point_distances(motions: Rigid, pairs: Pair) -> Float[Array, " pairs"]:
    return jax.lax.map(lambda pair: point_distance(*pair), (motions, pairs))


def evaluate_methods(
    methods: Sequence[Method], pairs: Pair, scans: Scans | None = None
) -> list[Row]:
    """One row per method, in the given order, all on the same pairs; shows its progress."""
    bar = tqdm(methods, desc="evaluating", unit="method", leave=False, disable=None)
    return [evaluate_method(method, pairs, scans) for method in bar]


def constant_overlap(pairs: Pair) -> OverlapSummary:
    """What the answer "all points overlap" scores on stacked pairs, for comparison."""
    ones = jnp.ones(pairs.source_overlap.shape), jnp.ones(pairs.target_overlap.shape)
    summary = summarise_overlap(jax.vmap(pair_confusion)(*ones, pairs))
    assert summary is not None  # a pair has points
    return summary


def _pair(pairs: Pair, i: int) -> Pair:
    return jax.tree.map(lambda leaf: leaf[i], pairs)


def _score(answer: Answer, pair: Pair) -> _Scored:
    motion, source, target = answer
    errors = None if motion is None else motion_errors(motion, pair.target_from_source)
    if source is None or target is None:
        return _Scored(errors, motion, None)
    return _Scored(errors, motion, pair_confusion(source, target, pair))
