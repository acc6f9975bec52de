"""Every method on the same test pairs, one pair at a time: errors and wall time."""

import dataclasses
import os
import time
from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float
from tqdm import tqdm

from dbdnet_jax.classical.open3d import (
    fgr,
    fgr_estimated,
    icp,
    icp_centred,
    identity,
)
from dbdnet_jax.classical.refine import refine_multistart
from dbdnet_jax.data.test_pairs import PairSet
from dbdnet_jax.errors import MissingExtraError
from dbdnet_jax.metrics.pose import (
    OverlapSummary,
    PairErrors,
    Summary,
    motion_errors,
    pair_confusion,
    point_distance,
    registration_errors,
    summarise,
    summarise_overlap,
)
from dbdnet_jax.metrics.recall import ScanRecall, Scans, correspondence_rmse_m, scan_recall
from dbdnet_jax.networks.dbdnet.register import register_clouds, register_given_overlap
from dbdnet_jax.networks.params import Params, init_params
from dbdnet_jax.types import Pair, Registration, Rigid

TRUE_NORMALS = "FGR, true normals"
Method = Callable[[Pair], Rigid | Registration]


class Row(NamedTuple):
    """One method's line of a table; without a summary, the note says why it could not run.

    ``recall`` is there for pairs of scans only. ``errors``, ``motions`` and the `point_distance`
    have a leading axis of pairs.
    """

    method: str
    summary: Summary | None
    seconds_per_pair: float | None
    note: str = ""
    recall: ScanRecall | None = None
    errors: PairErrors | None = None
    motions: Rigid | None = None
    point_distance: Float[np.ndarray, " pairs"] | None = None


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
    params: Params, test: PairSet, *, seed: int, command: str, count: int | None = None
) -> Evaluation:
    """Score the network, itself untrained (from ``seed``), and the baselines on test pairs.

    ``count`` keeps the first pairs only, which the name then says (the hash stays that of the
    whole set); ``command`` is what to show as the way to get here.

    Raises:
        ValueError: params without a registration network.
    """
    if params.registration is None:
        raise ValueError(
            "an evaluation needs a registration network; these params hold only the overlap "
            "network. Train it too: python train.py --stage=registration"
        )
    name, pairs, digest, scans, symmetric = test
    if count is not None and count < len(pairs.source.count):
        name = f"{name}_first_{count}"
        pairs = jax.tree.map(lambda leaf: leaf[:count], pairs)
        scans = scans and scans.first(count)
        symmetric = symmetric if symmetric is None else symmetric[:count]
    methods = make_methods(params, seed)
    if scans is not None:  # the lengths of `refine` are those of a shape in the unit sphere
        methods.pop("DBDNet, refined", None)
    return Evaluation(
        rows=evaluate_methods(possible(methods, pairs), pairs, scans),
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


def make_methods(params: Params, seed: int) -> dict[str, Method]:
    """The rows of the table by name; ``seed`` is that of the untrained weights.

    Params without an overlap network are given the true overlap, and the name says so.
    """
    untrained = init_params(jax.random.key(seed), params.config)
    network, name = from_network, "DBDNet"
    if params.overlap is None:
        network, name = from_true_overlap, "DBDNet, true overlap given"
    methods = {
        "identity": from_points(identity),
        "ICP": from_points(icp),
        "ICP, centroids first": from_points(icp_centred),
        TRUE_NORMALS: from_normals(fgr),
        "FGR, estimated normals": from_points(fgr_estimated),
        f"{name} (untrained)": network(untrained),
        name: network(params),
    }
    if params.overlap is not None:
        methods["DBDNet, refined"] = from_refined_network(params)
    return methods


def possible(methods: Mapping[str, Method], pairs: Pair) -> dict[str, Method]:
    """The methods without those that need normals, where the pairs, as of scans, have none."""
    if pairs.source_normals.any():
        return dict(methods)
    return {name: method for name, method in methods.items() if name != TRUE_NORMALS}


def from_points(baseline: Callable[..., Rigid]) -> Method:
    """A baseline ``(source, target) -> Rigid`` as a method on pairs; padding is cut off."""

    def method(pair: Pair) -> Rigid:
        return baseline(
            pair.source.points[: pair.source.count], pair.target.points[: pair.target.count]
        )

    return method


def from_normals(baseline: Callable[..., Rigid]) -> Method:
    """A baseline that also takes ``source_normals=, target_normals=`` as a method on pairs."""

    def method(pair: Pair) -> Rigid:
        rows, columns = slice(pair.source.count), slice(pair.target.count)
        return baseline(
            pair.source.points[rows],
            pair.target.points[columns],
            source_normals=pair.source_normals[rows],
            target_normals=pair.target_normals[columns],
        )

    return method


def from_network(params: Params) -> Method:
    """The network as a method on pairs; compiled once per shape and model configuration."""
    compiled = jax.jit(_register)
    return lambda pair: compiled(params, pair)


def from_refined_network(params: Params) -> Method:
    """The network's pose after `refine_multistart`: no ground truth, no normals given."""
    compiled = jax.jit(_register_and_refine)
    return lambda pair: compiled(params, pair)


def from_true_overlap(params: Params) -> Method:
    """The registration network behind the true overlap labels: a bound, since it is told them.

    It solves as often as `register` does. Its row has no overlap figures.
    """
    config = dataclasses.replace(params.config, iterations=params.config.solves)
    params = Params(params.overlap, params.registration, config)
    compiled = jax.jit(_register_given_labels)
    return lambda pair: compiled(params, pair)


def evaluate_method(name: str, method: Method, pairs: Pair, scans: Scans | None = None) -> Row:
    """One method over stacked NumPy pairs (leading axis on every field).

    With ``scans``, those of the same pairs, the row has their registration recall too.

    The time is the median over the pairs of the wall seconds until the answer is there. The
    method is called once on the first pair beforehand, so that no compilation is in it. A method
    whose library is missing gives a row with a note instead of figures.
    """
    score = jax.jit(_score)
    errors: list[PairErrors] = []
    motions: list[Rigid] = []
    seconds: list[float] = []
    rmse_m: list[float] = []
    try:
        jax.block_until_ready(method(_pair(pairs, 0)))
        for i in range(len(pairs.source.count)):
            pair = _pair(pairs, i)
            start = time.perf_counter()
            answer = jax.block_until_ready(method(pair))
            seconds.append(time.perf_counter() - start)
            motions.append(Rigid(answer.rotation, answer.translation))
            errors.append(jax.device_get(score(answer, pair)))
            if scans is not None:
                rmse_m.append(correspondence_rmse_m(answer, *scans.correspondences[i]))
    except MissingExtraError as error:
        return Row(name, None, None, str(error))
    stacked, moved = (
        jax.tree.map(lambda *leaves: np.stack(leaves), *found) for found in (errors, motions)
    )
    row = Row(name, summarise(stacked), float(np.median(seconds)), errors=stacked, motions=moved)
    if scans is None:
        return row._replace(point_distance=np.asarray(_point_distances(moved, pairs)))
    recall = scan_recall(stacked.rotation_deg, stacked.translation, np.array(rmse_m), scans)
    return row._replace(recall=recall)


@jax.jit
def _point_distances(motions: Rigid, pairs: Pair) -> Float[Array, " pairs"]:
    return jax.lax.map(lambda pair: point_distance(*pair), (motions, pairs))


def evaluate_methods(
    methods: Mapping[str, Method], pairs: Pair, scans: Scans | None = None
) -> list[Row]:
    """One row per method, in the given order, all on the same pairs; shows its progress."""
    bar = tqdm(methods.items(), desc="evaluating", unit="method", leave=False, disable=None)
    return [evaluate_method(name, method, pairs, scans) for name, method in bar]


def constant_overlap(pairs: Pair) -> OverlapSummary:
    """What the answer "all points overlap" scores on stacked pairs, for comparison."""
    ones = jnp.ones(pairs.source_overlap.shape), jnp.ones(pairs.target_overlap.shape)
    summary = summarise_overlap(jax.vmap(pair_confusion)(*ones, pairs))
    assert summary is not None  # a pair has points
    return summary


def _pair(pairs: Pair, i: int) -> Pair:
    return jax.tree.map(lambda leaf: leaf[i], pairs)


def _register(params: Params, pair: Pair) -> Registration:
    return register_clouds(params, pair.source, pair.target)


def _register_and_refine(params: Params, pair: Pair) -> Rigid:
    answer = _register(params, pair)
    motion = Rigid(answer.rotation, answer.translation)
    return refine_multistart(pair.source, pair.target, motion).target_from_source


def _register_given_labels(params: Params, pair: Pair) -> Rigid:
    labels = (x.astype(jnp.float32) for x in (pair.source_overlap, pair.target_overlap))
    answer = register_given_overlap(params, pair.source, pair.target, *labels)
    return Rigid(answer.rotation, answer.translation)


def _score(answer: Rigid | Registration, pair: Pair) -> PairErrors:
    if isinstance(answer, Registration):
        return registration_errors(answer, pair)
    return motion_errors(answer, pair.target_from_source)
