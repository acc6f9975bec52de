"""What training lowers: pure functions on one pair (the paper's section III-E).

Every mean goes over valid rows only, so what stands in the padding never counts; where a mean
has no rows it is 0. A NaN in a valid row gives NaN: the training loop must see it.
"""

import dataclasses
from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from dbdnet_jax.networks.dbdnet.matching import SoftMatches
from dbdnet_jax.ops.grouping import squared_distances
from dbdnet_jax.ops.rigid import HIGHEST, apply
from dbdnet_jax.ops.sampling import divisor
from dbdnet_jax.types import Branch, Cloud, Pair, Registration, Rigid

SMALLEST_PROBABILITY = 1e-12  # keeps log finite once a float32 sigmoid has saturated
SMALLEST_SLACK = 1e-3  # the same for the mass that a row without a match keeps back
MATCH_WIDTH = 0.06  # of the labels of soft matches: half the spacing of 256 points of a shape


@dataclasses.dataclass(frozen=True)
class LossWeights:
    """Weights of the registration loss's terms.

    The paper's numbers for ModelNet40 (rotation 5 on 3DMatch). It states 10 for the
    correspondences; the authors' discount over their single iteration makes that 5.
    """

    correspondence: float = 5.0
    rotation: float = 1.0
    translation: float = 1.0
    distance: float = 1.0


class OverlapTerms(NamedTuple):
    """The terms of the overlap loss; the loss is their sum."""

    source_focal: Float[Array, ""]
    target_focal: Float[Array, ""]
    matching: Float[Array, ""]


class RegistrationTerms(NamedTuple):
    """The weighted terms of the registration loss; the loss is their sum."""

    correspondence: Float[Array, ""]
    rotation: Float[Array, ""]
    translation: Float[Array, ""]
    distance: Float[Array, ""]


class JointTerms(NamedTuple):
    """The terms of both losses together; the loss is their sum."""

    source_focal: Float[Array, ""]
    target_focal: Float[Array, ""]
    matching: Float[Array, ""]
    correspondence: Float[Array, ""]
    rotation: Float[Array, ""]
    translation: Float[Array, ""]
    distance: Float[Array, ""]


def focal_loss(
    probability: Float[Array, " n"],
    label: Bool[Array, " n"],
    valid: Bool[Array, " n"],
    gamma: float = 4.0,
) -> Float[Array, ""]:
    """Mean over valid points of ``-(1 - p_t)^gamma log(p_t)``, p_t the true class's probability.

    Focal loss (Lin et al. 2017) with both classes weighted alike, as the authors' code does; the
    paper's formula with its alpha = 1 would erase the negative class. Finite for p_t = 0; for
    p_t = 1 loss and gradient are 0, whatever the gamma.
    """
    p_true = jnp.where(label, probability, 1 - probability)
    p_true = jnp.where(valid, p_true, 1.0)  # before the log: padding may hold anything
    certain = p_true == 1
    missing = jnp.where(certain, 1.0, 1 - p_true)  # 0^gamma has no derivative for gamma < 1, 0 too
    weight = jnp.where(certain, 0.0, missing**gamma)
    loss = weight * -jnp.log(jnp.maximum(p_true, SMALLEST_PROBABILITY))
    return jnp.sum(loss) / divisor(jnp.sum(valid), loss.dtype)


def rotation_loss(
    rotation: Float[Array, "3 3"], true_rotation: Float[Array, "3 3"]
) -> Float[Array, ""]:
    """Mean absolute entry of ``true_rotation^T rotation - I``."""
    delta = jnp.matmul(true_rotation.T, rotation, precision=HIGHEST)
    return jnp.mean(jnp.abs(delta - jnp.eye(3, dtype=delta.dtype)))


def translation_loss(
    translation: Float[Array, "3"], true_translation: Float[Array, "3"]
) -> Float[Array, ""]:
    """Mean squared difference of the components (the authors' code; the paper writes l2)."""
    return jnp.mean((translation - true_translation) ** 2)


def mean_l1(
    predicted: Float[Array, "n 3"], truth: Float[Array, "n 3"], rows: Bool[Array, " n"]
) -> Float[Array, ""]:
    """Mean absolute difference over the coordinates of ``rows``; 0 when there are none."""
    difference = jnp.where(rows[:, None], predicted - truth, 0.0)
    return jnp.sum(jnp.abs(difference)) / divisor(3 * jnp.sum(rows), difference.dtype)


def correspondence_loss(
    rotation_branch: Branch,
    translation_branch: Branch,
    true_targets: Float[Array, "n 3"],
    kept: Bool[Array, " n"],
) -> Float[Array, ""]:
    """Mean L1 from each kept source point's soft target to its true place, over both branches."""
    return (
        mean_l1(rotation_branch.target, true_targets, kept)
        + mean_l1(translation_branch.target, true_targets, kept)
    ) / 2


def distance_loss(
    registered: Float[Array, "n 3"], true_targets: Float[Array, "n 3"], valid: Bool[Array, " n"]
) -> Float[Array, ""]:
    """Mean L1 between the predicted and the true registration of all valid source points."""
    return mean_l1(registered, true_targets, valid)


def matching_loss(
    log_matrix: Float[Array, "n m"], source: Cloud, target: Cloud, truth: Rigid
) -> Float[Array, ""]:
    """Mean cross-entropy of soft matches, over the points of both clouds.

    A point's label is a bell of `MATCH_WIDTH` around its true place in the other cloud; without a
    point there, the label is to keep its mass back.
    """
    valid = source.valid, target.valid
    both = valid[0][:, None] & valid[1][None, :]
    distance = squared_distances(apply(truth, source.points), target.points)
    near = both & (distance < (2.5 * MATCH_WIDTH) ** 2)
    label = jnp.where(near, jnp.exp(-distance / (2 * MATCH_WIDTH**2)), 0.0)
    log_matrix = jnp.where(both, log_matrix, 0.0)
    mass = jnp.where(both, jnp.exp(log_matrix), 0.0)
    means = []
    for axis, rows in ((1, valid[0]), (0, valid[1])):
        total = jnp.sum(label, axis=axis)
        matched = -jnp.sum(label * log_matrix, axis=axis) / jnp.where(total > 0, total, 1.0)
        slack = jnp.maximum(1 - jnp.sum(mass, axis=axis), SMALLEST_SLACK)
        loss = jnp.where(rows, jnp.where(total > 0, matched, -jnp.log(slack)), 0.0)
        means.append(jnp.sum(loss) / divisor(jnp.sum(rows), loss.dtype))
    return (means[0] + means[1]) / 2


def overlap_loss(
    source_probability: Float[Array, " n"],
    target_probability: Float[Array, " m"],
    pair: Pair,
    gamma: float = 4.0,
    matched: SoftMatches | None = None,
) -> tuple[Float[Array, ""], OverlapTerms]:
    """Focal loss of both clouds' overlap probabilities, each cloud counting half.

    A network that also matches is judged by its matches and by the rotation they ask for.
    """
    source = focal_loss(source_probability, pair.source_overlap, pair.source.valid, gamma)
    target = focal_loss(target_probability, pair.target_overlap, pair.target.valid, gamma)
    matching = jnp.zeros_like(source)
    if matched is not None:
        own, other = (Cloud(*cloud) for cloud in zip(*matched.clouds, strict=True))
        truth = pair.target_from_source
        matching = matching_loss(matched.log_matrix, own, other, truth)
        matching += rotation_loss(matched.motion.rotation, truth.rotation)
    terms = OverlapTerms(source / 2, target / 2, matching)
    return jnp.stack(terms).sum(), terms


def registration_loss(
    answer: Registration, pair: Pair, weights: LossWeights
) -> tuple[Float[Array, ""], RegistrationTerms]:
    """The weighted sum of correspondence, rotation, translation and distance losses."""
    truth = pair.target_from_source
    valid = pair.source.valid
    # Zeroed before the product: a NaN in the padding would reach the motion's gradient through it.
    source = jnp.where(valid[:, None], pair.source.points, 0.0)
    true_targets = apply(truth, source)
    registered = apply(answer.motion, source)
    terms = RegistrationTerms(
        correspondence=weights.correspondence
        * correspondence_loss(
            answer.rotation_branch, answer.translation_branch, true_targets, answer.src_kept
        ),
        rotation=weights.rotation * rotation_loss(answer.rotation, truth.rotation),
        translation=weights.translation * translation_loss(answer.translation, truth.translation),
        distance=weights.distance * distance_loss(registered, true_targets, valid),
    )
    return jnp.stack(terms).sum(), terms
