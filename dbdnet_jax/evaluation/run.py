"""Every method on the same test pairs, shared among devices and processes: errors and time."""

import time
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh
from jaxtyping import Array, Bool, Float
from tqdm import tqdm

from dbdnet_jax.data.test_pairs import PairSet
from dbdnet_jax.errors import MissingExtraError
from dbdnet_jax.evaluation.methods import (
    Method,
    Network,
    Traits,
    Weights,
    make_methods,
    possible,
)
from dbdnet_jax.io.workers import available_cores
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
from dbdnet_jax.networks.params import Params
from dbdnet_jax.training.parallel import (
    from_all_processes,
    local_mesh,
    map_over_pairs,
    rows_of_process,
)
from dbdnet_jax.types import Answer, Pair, Rigid

TIMED = 20  # pairs of a method that devices share; those after them are not answered one by one


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
    weights: Sequence[Weights],
    test: PairSet,
    *,
    seed: int,
    command: str,
    count: int | None = None,
    devices: int = 1,
) -> Evaluation:
    """Score networks, the same untrained (from ``seed``), and the baselines on test pairs.

    ``count`` keeps the first pairs only, which the name then says (the hash stays that of the
    whole set); ``command`` is what to show as the way to get here. ``devices`` share the pairs of
    the networks (0: all there are), processes those of every method; each returns the whole.

    Raises:
        ValueError: params without the networks that their method needs, or too few devices.
    """
    mesh = local_mesh(devices)
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
        rows=evaluate_methods(methods, pairs, scans, mesh),
        constant_overlap=constant_overlap(pairs),
        pair_set=name,
        pairs=len(pairs.source.count),
        pairs_hash=digest,
        seed=seed,
        command=command,
        device=_describe(mesh),
        test_pairs=pairs,
        symmetric=symmetric,
    )


def _describe(mesh: Mesh) -> str:
    """The hardware that there was to use; where several devices shared the pairs, how many."""
    kind, sharing = mesh.devices.flat[0].device_kind, jax.process_count() * mesh.size
    return f"{kind}, {len(available_cores())} cores" + (
        f", {sharing} devices" if sharing > 1 else ""
    )


class _Scored(NamedTuple):
    """What is kept of one answer; None for what the method does not say."""

    errors: PairErrors | None
    motion: Rigid | None
    overlap: Confusion | None


def evaluate_method(
    method: Method, pairs: Pair, scans: Scans | None = None, mesh: Mesh | None = None
) -> Row:
    """One method over stacked NumPy pairs (leading axis on every field).

    With ``scans``, those of the same pairs, the row has their registration recall too. The devices
    of a `local_mesh` share the pairs of a network, and processes those of any method; either way
    each pair is answered once, and every process has the whole row.

    The time is the median over the pairs of the wall seconds until the answer is there, one pair
    after another on one device; where several share them, over the first `TIMED` of each process.
    The method is called once on the first pair beforehand, so that no compilation is in it. A
    method whose library is missing gives a row with a note instead of figures.
    """
    row, note, found = Row(method.name, traits=method.traits), "", None
    count = len(pairs.source.count)
    own = rows_of_process(count)
    try:
        found = _score_all(method, jax.tree.map(lambda leaf: leaf[own], pairs), mesh)
    except MissingExtraError as error:
        note = str(error)
    lacking = from_all_processes(np.array([not found]), jax.process_count())
    if found is None or lacking.any():
        return row._replace(note=note or f"process {lacking.argmax()} lacks what it needs.")
    errors, motions, overlap = from_all_processes(found[0], count)
    seconds = from_all_processes(found[1], len(found[1]) * jax.process_count())
    row = row._replace(
        seconds_per_pair=float(np.median(seconds)),
        overlap=None if overlap is None else summarise_overlap(overlap),
    )
    if errors is None:
        return row
    row = row._replace(summary=summarise(errors), errors=errors, motions=motions)
    if scans is None:
        return row._replace(point_distance=np.asarray(_point_distances(motions, pairs)))
    rmse_m = [
        correspondence_rmse_m(_row(motions, i), *points)
        for i, points in enumerate(scans.correspondences)
    ]
    recall = scan_recall(errors.rotation_deg, errors.translation, np.array(rmse_m), scans)
    return row._replace(recall=recall)


def _score_all(
    method: Method, pairs: Pair, mesh: Mesh | None
) -> tuple[_Scored, Float[np.ndarray, " timed"]]:
    """Stacked scores of all pairs, and the wall seconds of those that were answered one by one."""
    answer, score = method.answer, jax.jit(_score)
    count = len(pairs.source.count)
    shared = mesh is not None and mesh.size > 1 and isinstance(answer, Network)
    scores: list[_Scored] = []
    seconds: list[float] = []
    jax.block_until_ready(answer(_row(pairs, 0)))
    for i in range(min(count, TIMED) if shared else count):
        pair = _row(pairs, i)
        start = time.perf_counter()
        found = jax.block_until_ready(answer(pair))
        seconds.append(time.perf_counter() - start)
        scores.append(jax.device_get(score(found, pair)))
    parts = [jax.tree.map(lambda *leaves: np.stack(leaves), *scores)]
    if len(scores) < count:
        assert isinstance(answer, Network) and mesh is not None
        predict, rest = answer.predict, jax.tree.map(lambda leaf: leaf[len(scores) :], pairs)

        def scored(pair: Pair, params: Params) -> _Scored:
            return _score(predict(pair, params), pair)

        parts.append(map_over_pairs(mesh, scored, rest, answer.params))
    return jax.tree.map(lambda *leaves: np.concatenate(leaves), *parts), np.array(seconds)


@jax.jit
def _point_distances(motions: Rigid, pairs: Pair) -> Float[Array, " pairs"]:
    return jax.lax.map(lambda pair: point_distance(*pair), (motions, pairs))


def evaluate_methods(
    methods: Sequence[Method],
    pairs: Pair,
    scans: Scans | None = None,
    mesh: Mesh | None = None,
) -> list[Row]:
    """One row per method, in the given order, all on the same pairs; shows its progress."""
    quiet = True if jax.process_index() else None
    bar = tqdm(methods, desc="evaluating", unit="method", leave=False, disable=quiet)
    return [evaluate_method(method, pairs, scans, mesh) for method in bar]


def constant_overlap(pairs: Pair) -> OverlapSummary:
    """What the answer "all points overlap" scores on stacked pairs, for comparison."""
    ones = jnp.ones(pairs.source_overlap.shape), jnp.ones(pairs.target_overlap.shape)
    summary = summarise_overlap(jax.vmap(pair_confusion)(*ones, pairs))
    assert summary is not None  # a pair has points
    return summary


def _row(stacked: Any, i: int) -> Any:
    return jax.tree.map(lambda leaf: leaf[i], stacked)


def _score(answer: Answer, pair: Pair) -> _Scored:
    motion, source, target = answer
    errors = None if motion is None else motion_errors(motion, pair.target_from_source)
    if source is None or target is None:
        return _Scored(errors, motion, None)
    return _Scored(errors, motion, pair_confusion(source, target, pair))
