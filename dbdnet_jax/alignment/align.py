"""Two clouds of one's own, of any size, place and unit: the motion between them."""

import dataclasses
import itertools
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from dbdnet_jax.alignment.arguments import MAX_POINTS, check_options
from dbdnet_jax.alignment.mirrored import trust_beside_mirror
from dbdnet_jax.alignment.normalised import (
    NormalisedCloud,
    NormalisedPair,
    as_given,
    as_normalised,
    normalise_pair,
)
from dbdnet_jax.alignment.pose_programs import NetworkPose
from dbdnet_jax.alignment.search import Found, find_pose
from dbdnet_jax.alignment.success import Coefficients, PoseFeatures, load_coefficients
from dbdnet_jax.alignment.validity import Trust, rejection_reason, warnings
from dbdnet_jax.io.forks import require_own_jax
from dbdnet_jax.io.point_files import read_point_file
from dbdnet_jax.io.programs import loading_seconds
from dbdnet_jax.networks.params import Params
from dbdnet_jax.networks.table import DEFAULT_METHOD, method_of, parts_of
from dbdnet_jax.networks.weights import load_once
from dbdnet_jax.types import Transform

LISTED = 1.0  # alternatives whose score, a logarithm of odds, is lower by less are listed


class Matches(NamedTuple):
    """The network's mutually best matches: rows of the clouds as given, and the mass between."""

    source_rows: Int[np.ndarray, " k"]
    target_rows: Int[np.ndarray, " k"]
    confidence: Float[np.ndarray, " k"]


class Alternative(NamedTuple):
    """Another pose that fits about as well.

    ``margin`` is by how much its fit is worse (of the logarithm of the odds; below 0, better), and
    ``inlier_ratio`` the part of the source that comes near the target.
    """

    transform: Transform
    margin: float
    inlier_ratio: float


@dataclasses.dataclass(frozen=True, eq=False)
class Alignment:
    """A pose, ``target ~ rotation @ source + translation``, in the clouds' own units.

    Where ``valid`` is False it is the best pose found, and ``reason`` says why not to trust it.
    ``source_overlap (n,)`` and ``target_overlap (m,)`` are probabilities of the points as given.
    ``success_probability`` is that of a pose right to 5 degrees and 5 % of the extent, fitted on
    pairs whose pose is known; ``evidence`` is what it was made of. ``warnings`` are sentences that
    hold of valid poses too. ``inlier_ratio`` is the part of the moved source that is within
    ``inlier_distance`` of the target, ``rmse`` the root mean square of these points' distances.
    ``matches`` are the network's own. ``information`` (6, 6) is that of the point-to-plane
    residuals for a small rotation (radians) about ``pivot`` and a small translation, in the
    target's frame; its inverse, where it has one, is the covariance. ``alternatives`` are other
    poses that fit about as well, best first: of a symmetric shape its symmetries. ``timings`` are
    seconds; ``programs`` are loading and compiling, which no other counts.
    """

    transform: Transform
    valid: bool
    reason: str
    success_probability: float
    warnings: tuple[str, ...]
    inlier_ratio: float
    inlier_distance: float
    rmse: float
    source_overlap: Float[np.ndarray, " n"] = dataclasses.field(repr=False)
    target_overlap: Float[np.ndarray, " m"] = dataclasses.field(repr=False)
    matches: Matches = dataclasses.field(repr=False)
    information: Float[np.ndarray, "6 6"] = dataclasses.field(repr=False)
    pivot: Float[np.ndarray, "3"] = dataclasses.field(repr=False)
    evidence: PoseFeatures
    timings: dict[str, float]
    alternatives: tuple[Alternative, ...] = dataclasses.field(default=(), repr=False)

    @property
    def verdict(self) -> str:
        """In a few words whether to trust the pose."""
        return "aligned" if self.valid else "not aligned with confidence"

    @property
    def rotation(self) -> Float[np.ndarray, "3 3"]:
        """The rotation of ``transform``."""
        return self.transform[:3, :3]

    @property
    def translation(self) -> Float[np.ndarray, "3"]:
        """The translation of ``transform``."""
        return self.transform[:3, 3]


def align(
    source: Any,
    target: Any,
    params: Params | str | Path | None = None,
    *,
    refine: bool = True,
    search: str = "auto",
    scale: float | str = "auto",
    overlap_threshold: float | None = None,
    max_points: int = MAX_POINTS,
    seed: int = 0,
    initial: Any = None,
    proposals: Any = (),
) -> Alignment:
    """Find the motion that brings ``source`` onto ``target``.

    Args:
      source: (n, 3) numbers, n >= 16, or a file; see `point_files.read_point_file`.
      target: the same, (m, 3), in the same unit.
      params: the network, or the name or ``.npz`` file of one; that of the package, if None.
      refine: refine poses; else the best of the network's and those given is the answer.
      search: "near" for poses near the given orientation (or ``initial``), "any" for all rotations,
        "auto" for these only where the former leave a doubt. Of poses that fit alike the one
        nearest to the given orientation is the answer.
      scale: factor from the clouds' unit to the weights'; "auto" brings the larger cloud to the
        size of a partial scan of a shape in the unit sphere.
      overlap_threshold: probability above which a point enters the registration; the network's
        own, if None.
      max_points: of each cloud, for the network.
      seed: of the points drawn on a mesh; nothing else is random.
      initial: a guess of the transform (4, 4), left only where another pose fits clearly better.
      proposals: transforms (k, 4, 4) of anyone's making, judged as the network's own pose is.

    Raises:
      ValueError: points or arguments of no use, or weights that are not there.
      OSError: a file that cannot be read.
      RuntimeError: the process was forked after JAX was used, and would hang; spawn it.
    """
    require_own_jax("align")
    guess, proposed = check_options(
        refine, search, scale, overlap_threshold, max_points, initial, proposals
    )
    laps, loaded = {"start": _clock()}, loading_seconds()
    source = read_point_file(source, "source", seed=seed)
    target = read_point_file(target, "target", seed=seed + 1)
    laps["read"] = _clock()
    params = _network(params, overlap_threshold)
    coefficients = load_coefficients()
    laps["weights"] = _clock()
    scene = normalise_pair(source.points, target.points, scale, max_points, guess)
    laps["downsample"] = _clock()
    guess = None if guess is None else as_normalised(guess, scene)
    proposed = [as_normalised(transform, scene) for transform in proposed]
    found = find_pose(
        params, scene, coefficients, search, refine=refine, guess=guess, proposals=proposed
    )
    laps["search"] = _clock()
    trust = _judge(scene, found, coefficients, refine)
    laps["quality"] = _clock()
    return _report(scene, found, trust, (*source.notes, *target.notes), laps, loaded)


def _network(params: Params | str | Path | None, overlap_threshold: float | None) -> Params:
    """The network that is given, named or in the package, perhaps with another threshold."""
    if not isinstance(params, Params):
        params = load_once(str(params or "cad"))
    if (method := method_of(params.config)) != DEFAULT_METHOD:
        raise ValueError(
            f"params must be weights of {DEFAULT_METHOD}; got those of {method}. Leave params out "
            "for the weights in the package."
        )
    if not set(parts_of(params.config)) <= params.networks.keys():
        raise ValueError(
            f"params must hold both networks; got {', '.join(params.networks) or 'none'}. Load a "
            "full set of weights."
        )
    if overlap_threshold is None:
        return params
    config = dataclasses.replace(params.config, overlap_threshold=float(overlap_threshold))
    return dataclasses.replace(params, config=config)


def _judge(scene: NormalisedPair, found: Found, coefficients: Coefficients, refine: bool) -> Trust:
    """Whether the pose is to be trusted; mirrored ones, if refined, are held against it."""
    if (reason := rejection_reason(scene, found)) or not refine:
        return Trust(found.probability, reason, ())
    return trust_beside_mirror(scene, found, coefficients)


def _report(
    scene: NormalisedPair,
    found: Found,
    trust: Trust,
    notes: tuple[str, ...],
    laps: dict[str, float],
    loaded: float,
) -> Alignment:
    """Everything that is known of a pose, in the units and rows of the clouds as given."""
    quality = found.quality
    overlap = (
        _everywhere(scene.source, found.predicted.source_overlap),
        _everywhere(scene.target, found.predicted.target_overlap),
    )
    laps["overlap"] = _clock()
    unit = np.repeat([1.0, scene.factor], 3)
    return Alignment(
        transform=as_given(found.pose, scene),
        valid=not trust.reason,
        reason=trust.reason,
        success_probability=trust.probability,
        warnings=(*notes, *trust.warnings, *warnings(scene, found)),
        inlier_ratio=float(quality.inlier.mean()),
        inlier_distance=quality.distance / scene.factor,
        rmse=quality.rmse / scene.factor,
        source_overlap=overlap[0],
        target_overlap=overlap[1],
        matches=_matches(found.predicted, scene),
        information=quality.information * unit * unit[:, None],
        pivot=quality.pivot / scene.factor + scene.target.downsampled.centre,
        alternatives=tuple(_alternatives(found, scene)),
        evidence=found.evidence,
        timings={
            "programs": loading_seconds() - loaded,
            **{name: end - start for (_, start), (name, end) in itertools.pairwise(laps.items())},
        },
    )


def _clock() -> float:
    """Seconds but for what loading or compiling programs takes: the first call's alone."""
    return time.perf_counter() - loading_seconds()


def _alternatives(found: Found, scene: NormalisedPair) -> Iterator[Alternative]:
    """What fits about as well, as transforms of the clouds as given."""
    for other in found.others:
        if (margin := found.score - other.score) < LISTED:
            yield Alternative(as_given(other.pose, scene), margin, other.fit.source_inliers)


def _everywhere(side: NormalisedCloud, values: Float[np.ndarray, " s"]) -> Float[np.ndarray, " n"]:
    """Every given point gets the value of the nearest point that the network saw."""
    from scipy.spatial import cKDTree

    tree = cKDTree(side.points[side.downsampled.sparse] - side.downsampled.centre)
    blocks = np.array_split(side.points, len(side.points) // 1_000_000 + 1)
    rows = [tree.query(block - side.downsampled.centre, workers=-1)[1] for block in blocks]
    return values[np.concatenate(rows)]


def _matches(predicted: NetworkPose, scene: NormalisedPair) -> Matches:
    """Pairs of points that are each other's heaviest, heaviest first."""
    forth, back = predicted.mass.argmax(axis=1), predicted.mass.argmax(axis=0)
    mutual = (back[forth] == np.arange(len(forth))) & (predicted.mass.max(axis=1) > 0)
    rows = np.flatnonzero(mutual)
    rows = rows[np.argsort(-predicted.mass[rows, forth[rows]], kind="stable")]
    return Matches(
        scene.source.downsampled.sparse[rows],
        scene.target.downsampled.sparse[forth[rows]],
        predicted.mass[rows, forth[rows]],
    )
