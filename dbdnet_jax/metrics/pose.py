"""How wrong an answer is: errors of one pair, and their summary over a test set.

The functions on one pair are pure and work under jit and vmap; `summarise` runs on the host in
float64. Angles that leave this file are degrees, and say so in their names.

Non-finite answers are errors, never dropped and never lucky: a predicted motion with any NaN or
infinity is scored as 180 degrees for the rotation and for every Euler angle, and as the opposite
of the true translation (error 2 |t|, twice what no motion costs). A non-finite probability counts
as the wrong class. `Summary.non_finite` says how many motions there were.
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from dbdnet_jax.ops import rigid
from dbdnet_jax.ops.grouping import squared_distances
from dbdnet_jax.ops.rigid import HIGHEST
from dbdnet_jax.ops.sampling import divisor
from dbdnet_jax.types import Pair, Rigid

GIMBAL_COSINE = 1e-6  # below: x and z turn about one axis; float32 cannot tell them apart
OVERLAP_THRESHOLD = 0.5


class Confusion(NamedTuple):
    """Points by predicted and true overlap."""

    true_positive: Int[Array, "*pairs"]
    false_positive: Int[Array, "*pairs"]
    true_negative: Int[Array, "*pairs"]
    false_negative: Int[Array, "*pairs"]


class PairErrors(NamedTuple):
    """Errors of one pair; with a leading axis, of many pairs."""

    rotation_deg: Float[Array, "*pairs"]
    translation: Float[Array, "*pairs"]
    euler_difference_deg: Float[Array, "*pairs 3"]
    translation_difference: Float[Array, "*pairs 3"]
    finite: Bool[Array, "*pairs"]


class OverlapSummary(NamedTuple):
    """Overlap prediction pooled over the points of both clouds of all pairs; each in 0..1."""

    accuracy: float
    precision: float
    recall: float
    f1: float


class Summary(NamedTuple):
    """A test set in one row. Translations in the units of the clouds; recalls in 0..1.

    RMSE and MAE go over all pairs and all three components: Euler angles "xyz" (extrinsic) for
    the rotation. ``error_*`` and ``median_*`` are over pairs, of the isotropic errors.
    """

    pairs: int
    non_finite: int
    rmse_euler_deg: float
    rmse_translation: float
    mae_euler_deg: float
    mae_translation: float
    error_rotation_deg: float
    error_translation: float
    median_rotation_deg: float
    median_translation: float
    recall_5deg_0p1: float
    recall_15deg_0p3: float


def rotation_error_deg(
    predicted: Float[Array, "3 3"], truth: Float[Array, "3 3"]
) -> Float[Array, ""]:
    """Angle in degrees of the rotation between two rotations (the geodesic distance).

    atan2 of sine and cosine: accurate at 0, where arccos loses half of the digits, and at 180.
    """
    delta = jnp.matmul(truth.T, predicted, precision=HIGHEST)
    axis = jnp.stack(
        [delta[2, 1] - delta[1, 2], delta[0, 2] - delta[2, 0], delta[1, 0] - delta[0, 1]]
    )
    return jnp.rad2deg(jnp.arctan2(jnp.linalg.norm(axis), jnp.trace(delta) - 1))


def translation_error(predicted: Rigid, truth: Rigid) -> Float[Array, ""]:
    """Norm of the translation of ``truth^-1 predicted``, in the units of the clouds.

    That translation is ``R_truth^T (t_predicted - t_truth)``; the rotation keeps its norm, but is
    written out because it is what the paper measures.
    """
    difference = predicted.translation - truth.translation
    return jnp.linalg.norm(jnp.matmul(truth.rotation.T, difference, precision=HIGHEST))


def euler_xyz_deg(rotation: Float[Array, "3 3"]) -> Float[Array, "3"]:
    """Angles (x, y, z) in degrees with ``rotation = Rz Ry Rx``; SciPy's ``as_euler("xyz")``.

    x and z lie in [-180, 180], y in [-90, 90]. At y = +-90 only x -+ z is determined: z is 0.
    """
    cos_y = jnp.hypot(rotation[0, 0], rotation[1, 0])
    locked = cos_y < GIMBAL_COSINE
    x = jnp.where(
        locked,
        jnp.arctan2(-rotation[1, 2], rotation[1, 1]),
        jnp.arctan2(rotation[2, 1], rotation[2, 2]),
    )
    y = jnp.arctan2(-rotation[2, 0], cos_y)
    z = jnp.where(locked, 0.0, jnp.arctan2(rotation[1, 0], rotation[0, 0]))
    return jnp.rad2deg(jnp.stack([x, y, z]))


def overlap_confusion(
    probability: Float[Array, " n"], truth: Bool[Array, " n"], mask: Bool[Array, " n"]
) -> Confusion:
    """Counts of the points under ``mask`` by ``probability > 0.5`` and truth.

    A non-finite probability counts as the wrong class.
    """
    predicted = jnp.where(jnp.isfinite(probability), probability > OVERLAP_THRESHOLD, ~truth)
    return Confusion(
        true_positive=jnp.sum(mask & predicted & truth),
        false_positive=jnp.sum(mask & predicted & ~truth),
        true_negative=jnp.sum(mask & ~predicted & ~truth),
        false_negative=jnp.sum(mask & ~predicted & truth),
    )


def motion_errors(predicted: Rigid, truth: Rigid) -> PairErrors:
    """Errors of a predicted motion of one pair.

    An answer that says ``valid=False`` is scored as the identity it holds.
    Euler differences are plain differences of the angles, not wrapped, as in the paper.
    """
    scored, finite = _scored(predicted, truth)
    euler = jnp.abs(euler_xyz_deg(scored.rotation) - euler_xyz_deg(truth.rotation))
    return PairErrors(
        rotation_deg=jnp.where(finite, rotation_error_deg(scored.rotation, truth.rotation), 180.0),
        translation=translation_error(scored, truth),
        euler_difference_deg=jnp.where(finite, euler, 180.0),
        translation_difference=jnp.abs(scored.translation - truth.translation),
        finite=finite,
    )


def point_distance(predicted: Rigid, pair: Pair) -> Float[Array, ""]:
    """Mean distance from the moved source points to the nearest point of both clouds together.

    Both in their true places, in the units of the clouds: what a pose is off by where a symmetry
    of the shape is forgiven. Noise, and how far apart the points are, keep it above zero.
    """
    scored, _ = _scored(predicted, pair.target_from_source)
    rows, columns = pair.source.valid, pair.target.valid
    source = jnp.where(rows[:, None], pair.source.points, 0.0)
    moved, true = rigid.apply(scored, source), rigid.apply(pair.target_from_source, source)
    nearest = jnp.minimum(
        jnp.min(jnp.where(rows[None, :], squared_distances(moved, true), jnp.inf), axis=1),
        jnp.min(
            jnp.where(columns[None, :], squared_distances(moved, pair.target.points), jnp.inf),
            axis=1,
        ),
    )
    total = jnp.sum(jnp.where(rows, jnp.sqrt(nearest), 0.0))
    return total / divisor(jnp.sum(rows), total.dtype)


def _scored(predicted: Rigid, truth: Rigid) -> tuple[Rigid, Bool[Array, ""]]:
    """The motion that is scored, see the top of this file, and whether it is the predicted one."""
    finite = jnp.isfinite(predicted.rotation).all() & jnp.isfinite(predicted.translation).all()
    rotation = jnp.where(finite, predicted.rotation, truth.rotation)
    return Rigid(rotation, jnp.where(finite, predicted.translation, -truth.translation)), finite


def pair_confusion(
    source_probability: Float[Array, " n"], target_probability: Float[Array, " m"], pair: Pair
) -> Confusion:
    """Overlap counts over the valid points of both clouds of one pair."""
    source = overlap_confusion(source_probability, pair.source_overlap, pair.source.valid)
    target = overlap_confusion(target_probability, pair.target_overlap, pair.target.valid)
    return Confusion(*(s + t for s, t in zip(source, target, strict=True)))


def overlap_error(counts: Confusion) -> Float[Array, "*pairs"]:
    """The share of points of the wrong class."""
    wrong = counts.false_positive + counts.false_negative
    return wrong / (wrong + counts.true_positive + counts.true_negative)


def overlap_f1(counts: Confusion) -> Float[Array, "*pairs"]:
    """``2 TP / (2 TP + FP + FN)``; 0 where nothing is or is said to be overlapping."""
    wrong = counts.false_positive + counts.false_negative
    return 2 * counts.true_positive / jnp.maximum(2 * counts.true_positive + wrong, 1)


def summarise_overlap(counts: Confusion) -> OverlapSummary | None:
    """Pooled overlap figures; None when no point was counted, 0 where a ratio is 0/0."""
    tp, fp, tn, fn = (int(np.sum(np.asarray(count, np.int64))) for count in counts)
    if tp + fp + tn + fn == 0:
        return None
    return OverlapSummary(
        accuracy=(tp + tn) / (tp + fp + tn + fn),
        precision=tp / max(tp + fp, 1),
        recall=tp / max(tp + fn, 1),
        f1=2 * tp / max(2 * tp + fp + fn, 1),
    )


def summarise(errors: PairErrors) -> Summary:
    """One row from the errors of many pairs (leading axis), in float64 on the host.

    Raises:
        ValueError: no pairs, or an error that is not finite (then the true motion is not).
    """
    rotation, translation, euler, difference = (
        np.asarray(value, np.float64)
        for value in (
            errors.rotation_deg,
            errors.translation,
            errors.euler_difference_deg,
            errors.translation_difference,
        )
    )
    if rotation.ndim != 1 or not rotation.size:
        raise ValueError(
            f"errors must hold at least one pair along a leading axis; got shape {rotation.shape}. "
            "Stack the errors of the pairs first, or give more pairs."
        )
    broken = ~(np.isfinite(rotation) & np.isfinite(translation) & np.isfinite(euler).all(-1))
    if broken.any():
        raise ValueError(
            f"true motions must be finite; pair {int(broken.argmax())} has NaN or infinity. "
            "Repair or remove it from the test set."
        )
    return Summary(
        pairs=rotation.size,
        non_finite=int((~np.asarray(errors.finite)).sum()),
        rmse_euler_deg=float(np.sqrt(np.mean(euler**2))),
        rmse_translation=float(np.sqrt(np.mean(difference**2))),
        mae_euler_deg=float(np.mean(np.abs(euler))),
        mae_translation=float(np.mean(np.abs(difference))),
        error_rotation_deg=float(rotation.mean()),
        error_translation=float(translation.mean()),
        median_rotation_deg=float(np.median(rotation)),
        median_translation=float(np.median(translation)),
        recall_5deg_0p1=float(np.mean((rotation < 5) & (translation < 0.1))),
        recall_15deg_0p3=float(np.mean((rotation < 15) & (translation < 0.3))),
    )
