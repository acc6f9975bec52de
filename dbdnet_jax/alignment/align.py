"""Two clouds of one's own, of any size, place and unit: the motion between them."""

import dataclasses
import itertools
import time
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from dbdnet_jax.alignment import search
from dbdnet_jax.alignment.normalised import (
    NormalisedCloud,
    NormalisedPair,
    as_given,
    is_full_resolution,
    normalise_pair,
    normalised_guess,
)
from dbdnet_jax.alignment.quality import assess_pose, inlier_distance, shared_point_score
from dbdnet_jax.alignment.search import NetworkPose, Transform
from dbdnet_jax.alignment.success import (
    PoseFeatures,
    gather,
    load_coefficients,
    success_probability,
)
from dbdnet_jax.alignment.validity import rejection_reason, warnings
from dbdnet_jax.io.point_files import read_point_file
from dbdnet_jax.networks.params import Params
from dbdnet_jax.networks.weights import load_pretrained

MAX_POINTS = 768  # the weights were trained on 717; a little more costs nothing


class Matches(NamedTuple):
    """The network's mutually best matches: rows of the clouds as given, and the mass between."""

    source_rows: Int[np.ndarray, " k"]
    target_rows: Int[np.ndarray, " k"]
    confidence: Float[np.ndarray, " k"]


@dataclasses.dataclass(frozen=True, eq=False)
class Alignment:
    """A pose, ``target ~ rotation @ source + translation``, in the clouds' own units.

    Where ``valid`` is False it is the best pose found, and ``reason`` says why not to trust it.
    ``source_overlap (n,)`` and ``target_overlap (m,)`` are probabilities of the points as given.
    ``inlier_ratio`` is the part of the moved source that is within ``inlier_distance`` of the
    target, ``rmse`` its distance. ``information`` (6, 6) is that of the point-to-plane residuals
    for a small rotation (radians) about ``pivot`` and a small translation, in the target's frame;
    its inverse, where it has one, is the covariance. ``timings`` are seconds.
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
    params: Params | None = None,
    *,
    refine: bool = True,
    scale: float | str = "auto",
    overlap_threshold: float = 0.5,
    max_points: int = MAX_POINTS,
    seed: int = 0,
    initial: Any = None,
) -> Alignment:
    """Find the motion that brings ``source`` onto ``target``.

    Args:
      source: (n, 3) numbers, n >= 16, or a file; see `point_files.read_point_file`.
      target: the same, (m, 3), in the same unit.
      params: the network; the weights in the package, if None.
      refine: refine the network's pose, from it and from near it, on up to 1,024 points of each
        cloud.
      scale: factor from the clouds' unit to the weights'; "auto" brings the larger cloud to the
        size of a partial scan of a shape in the unit sphere.
      overlap_threshold: probability above which a point enters the registration.
      max_points: of each cloud, for the network.
      seed: of the points drawn on a mesh; nothing else is random.
      initial: a guess of the transform (4, 4). The network sees the source turned by it, and the
        guess itself stands for election beside the network's pose.

    Raises:
      ValueError: points or arguments of no use, or weights that are not there.
      OSError: a file that cannot be read.
    """
    laps = {"start": time.perf_counter()}
    _check_arguments(scale, overlap_threshold, max_points)
    guess = np.eye(4) if initial is None else _check_transform(initial)
    source = read_point_file(source, "source", seed=seed)
    target = read_point_file(target, "target", seed=seed + 1)
    laps["read"] = time.perf_counter()
    params = load_pretrained() if params is None else params
    if params.overlap is None or params.registration is None:
        raise ValueError("params must hold both networks; one is None. Load a full set of weights.")
    config = dataclasses.replace(params.config, overlap_threshold=float(overlap_threshold))
    params = dataclasses.replace(params, config=config)
    laps["weights"] = time.perf_counter()
    scene = normalise_pair(source.points, target.points, scale, max_points, guess)
    laps["downsample"] = time.perf_counter()
    predicted = search.predict_pose(params, scene.source.sparse, scene.target.sparse)
    laps["network"] = time.perf_counter()
    distance = inlier_distance(scene.source.dense, scene.target.dense)
    starts = [predicted.transform]
    if initial is not None:
        starts.append(normalised_guess(scene))
    pose = _select_pose(starts, scene, refine)
    laps["refine"] = time.perf_counter()
    found = _report(scene, predicted, pose, distance, laps)
    notes = (*source.notes, *target.notes)
    return dataclasses.replace(found, warnings=(*notes, *found.warnings)) if notes else found


def _select_pose(starts: list[Transform], scene: NormalisedPair, refine: bool) -> Transform:
    """The pose that fits best; if asked for, refined on few points, then on all that are kept."""
    clouds = scene.source.sparse, scene.target.sparse
    if refine:
        best, _ = min(
            (search.refine_multistart(pose, *clouds) for pose in starts), key=lambda found: found[1]
        )
        return search.refine(best, scene.source.dense, scene.target.dense)
    if len(starts) == 1:
        return starts[0]
    return min(starts, key=lambda pose: search.truncated_rmse(pose, *clouds))


def _report(
    scene: NormalisedPair,
    predicted: NetworkPose,
    pose: Transform,
    distance: float,
    laps: dict[str, float],
) -> Alignment:
    """Everything that is known of a pose, in the units and rows of the clouds as given."""
    clouds = scene.source.sparse, scene.target.sparse
    dense = search.move(pose, scene.source.dense), scene.target.dense
    quality = assess_pose(*dense, distance)
    alternative = search.strongest_alternative(pose, *clouds)
    shared = shared_point_score(*dense, distance) if is_full_resolution(scene) else 0.0
    evidence = gather(predicted, pose, quality, alternative, shared)
    probability = success_probability(evidence, load_coefficients())
    reason = rejection_reason(scene, predicted, quality, probability)
    laps["quality"] = time.perf_counter()
    overlap = (
        _everywhere(scene.source, predicted.source_overlap),
        _everywhere(scene.target, predicted.target_overlap),
    )
    laps["overlap"] = time.perf_counter()
    unit = np.repeat([1.0, scene.factor], 3)
    return Alignment(
        transform=as_given(pose, scene),
        valid=not reason,
        reason=reason,
        success_probability=probability,
        warnings=tuple(warnings(scene, quality, alternative)),
        inlier_ratio=float(quality.inlier.mean()),
        inlier_distance=distance / scene.factor,
        rmse=quality.rmse / scene.factor,
        source_overlap=overlap[0],
        target_overlap=overlap[1],
        matches=_matches(predicted, scene),
        information=quality.information * unit * unit[:, None],
        pivot=quality.pivot / scene.factor + scene.target.downsampled.centre,
        evidence=evidence,
        timings={name: end - start for (_, start), (name, end) in itertools.pairwise(laps.items())},
    )


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


def _check_arguments(scale: float | str, overlap_threshold: float, max_points: int) -> None:
    """Refuse numbers of no use."""
    if scale != "auto" and not (isinstance(scale, int | float) and 0 < scale < np.inf):
        raise ValueError(f"scale must be 'auto' or a positive number; got {scale!r}.")
    if not 0 <= overlap_threshold < 1:
        raise ValueError(f"overlap_threshold must be in [0, 1); got {overlap_threshold}. Use 0.5.")
    if max_points < 64:
        raise ValueError(f"max_points must be at least 64; got {max_points}. Use {MAX_POINTS}.")


def _check_transform(values: Any) -> Transform:
    """A 4x4 rigid transform, its rotation made exact, or a ValueError."""
    try:
        transform = np.asarray(values, np.float64)
    except (TypeError, ValueError) as error:
        raise ValueError(f"initial must be a 4x4 array of numbers: {error}.") from error
    if transform.shape != (4, 4) or not np.isfinite(transform).all():
        raise ValueError(f"initial must be 4x4 and finite; got shape {transform.shape}.")
    rotation = transform[:3, :3]
    skew = np.abs(rotation @ rotation.T - np.eye(3)).max()
    if skew > 1e-3 or np.linalg.det(rotation) < 0 or (transform[3] != [0, 0, 0, 1]).any():
        raise ValueError(
            "initial must be a rotation and a translation with a last row of 0 0 0 1; its rotation "
            f"misses orthogonality by {skew:.2g}, with determinant {np.linalg.det(rotation):.3g}. "
            "Remove scale and reflection."
        )
    return search.as_transform(rotation, transform[:3, 3])
