"""DBDNet's stages: what each one lowers, and how it is judged.

"overlap" trains the overlap network; "registration" trains the registration network behind it,
frozen and deterministic (the released code leaves the frozen network's dropout on). "joint", which
the paper does not have, then trains both on what they make of a pair together.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
from jaxtyping import Array, Float, PRNGKeyArray

from dbdnet_jax.data.pairs import initial_pose, perturbed_overlap, transform_source
from dbdnet_jax.metrics.pose import (
    motion_errors,
    overlap_error,
    overlap_f1,
    pair_confusion,
)
from dbdnet_jax.networks.dbdnet.config import ModelConfig
from dbdnet_jax.networks.dbdnet.matching import SoftMatches
from dbdnet_jax.networks.dbdnet.register import (
    predict_overlap_and_matches,
    register_clouds,
    register_given_overlap,
)
from dbdnet_jax.networks.params import Params
from dbdnet_jax.ops import rigid
from dbdnet_jax.training.losses import JointTerms, LossWeights, overlap_loss, registration_loss
from dbdnet_jax.training.task import check_stage
from dbdnet_jax.types import Pair, Registration, Rigid

MASKS = ("predicted", "truth", "perturbed")


@dataclasses.dataclass(frozen=True)
class OverlapConfig:
    """Stage 1: the overlap network. The defaults are the paper's for ModelNet40."""

    epochs: float = 300.0
    batch_size: int = 8
    learning_rate: float = 1e-4
    gamma: float = 4.0  # of the focal loss

    def __post_init__(self) -> None:
        """Refuse a stage of nothing."""
        check_stage("overlap", self)


@dataclasses.dataclass(frozen=True)
class RegistrationConfig:
    """Stage 2: the registration network behind the frozen overlap network.

    ``masks`` says which points it is given: those that the overlap network "predicted"; those
    that overlap in "truth"; or "perturbed" ones (`pairs.perturbed_overlap`), with the true ones
    for validation. The last two need no stage 1. Without an overlap network it is given all points,
    and a joint overlap is trained beside it, by a focal loss of ``overlap_gamma``.
    """

    epochs: float = 300.0
    batch_size: int = 8
    learning_rate: float = 1e-4
    masks: str = "predicted"
    weights: LossWeights = LossWeights()
    overlap_gamma: float = 4.0

    def __post_init__(self) -> None:
        """Refuse a stage of nothing, and masks that there are not."""
        check_stage("registration", self)
        if self.masks not in MASKS:
            raise ValueError(
                f"config.registration.masks must be one of {MASKS}; got {self.masks!r}. Choose one."
            )


@dataclasses.dataclass(frozen=True)
class JointConfig:
    """Both networks trained further together, each on what the other one makes of the pair.

    The loss is the sum of both stages' losses, with their gamma and weights.
    """

    epochs: float = 30.0
    batch_size: int = 8
    learning_rate: float = 1e-4

    def __post_init__(self) -> None:
        """Refuse a stage of nothing."""
        check_stage("joint", self)


def overlap_loss_of(
    model: ModelConfig, gamma: float, trainable: Any, frozen: None, pair: Pair, key: PRNGKeyArray
) -> tuple[Float[Array, ""], Any]:
    """The overlap network's loss on one pair; of several passes, one from a start of its own."""
    params = Params({"overlap": trainable}, model)
    start_key, dropout_key = jax.random.split(key)
    # Each pass is trained for itself, from starts such as the passes before it may leave.
    start = initial_pose(start_key, pair) if model.overlap_passes > 1 else None
    source, target, matched = predict_overlap_and_matches(
        params, pair.source, pair.target, dropout_key if model.dropout else None, start
    )
    return overlap_loss(source, target, pair, gamma, matched)


def validate_overlap(
    model: ModelConfig, gamma: float, trainable: Any, frozen: None, pair: Pair
) -> dict[str, Float[Array, ""]]:
    """The share of points of the wrong class after all passes, the loss, and F1."""
    params = Params({"overlap": trainable}, model)
    source, target, matched = predict_overlap_and_matches(params, pair.source, pair.target)
    counts = pair_confusion(source, target, pair)
    loss = overlap_loss(source, target, pair, gamma, matched)[0]
    return {"error": overlap_error(counts), "loss": loss, "f1": overlap_f1(counts)}


def _from_anywhere(model: ModelConfig) -> bool:
    """Whether each turn is trained for itself, from starts such as those before it may leave."""
    return model.overlap_passes > 1


def registration_loss_of(
    model: ModelConfig,
    stage: RegistrationConfig,
    overlap_radius: float,
    trainable: Any,
    frozen: Any,
    pair: Pair,
    key: PRNGKeyArray,
) -> tuple[Float[Array, ""], Any]:
    """The registration network's loss on one pair, given the points that ``stage`` says.

    With a joint overlap, that of both: the terms are then `JointTerms`.
    """
    mask_key, start_key, dropout_key = jax.random.split(key, 3)
    start = initial_pose(start_key, pair) if _from_anywhere(model) else None
    if model.overlap != "prior":
        masks = pair.source.valid, pair.target.valid
    elif stage.masks == "predicted":
        overlap_network = Params({"overlap": frozen}, model)
        masks = predict_overlap_and_matches(overlap_network, pair.source, pair.target, start=start)[
            :2
        ]
    elif stage.masks == "perturbed":
        masks = perturbed_overlap(mask_key, pair, overlap_radius)
    else:
        masks = pair.source_overlap, pair.target_overlap
    if start is not None:
        pair = transform_source(pair, start)
    found = _register_given(model, trainable, pair, masks, dropout_key if model.dropout else None)
    loss, terms = registration_loss(found, pair, stage.weights)
    if model.overlap != "joint":
        return loss, terms
    beside, overlap_terms = overlap_loss(
        found.src_overlap, found.tgt_overlap, pair, stage.overlap_gamma
    )
    return beside + loss, JointTerms(*overlap_terms, *terms)


def validate_registration(
    model: ModelConfig, stage: RegistrationConfig, trainable: Any, frozen: Any, pair: Pair
) -> dict[str, Float[Array, ""]]:
    """Errors of the pose after all turns: behind the overlap network, or given the true overlap."""
    if stage.masks == "predicted":
        networks = {"registration": trainable}
        if frozen is not None:
            networks["overlap"] = frozen
        params = Params(networks, model)
        found = register_clouds(params, pair.source, pair.target)
    else:
        truth = pair.source_overlap, pair.target_overlap
        found = _register_given(model, trainable, pair, truth, solves=model.solves)
    errors = motion_errors(found.motion, pair.target_from_source)
    figures = {
        "error": errors.rotation_deg,
        "translation_error": errors.translation,
        "loss": registration_loss(found, pair, stage.weights)[0],
    }
    if model.overlap == "joint":
        counts = pair_confusion(found.src_overlap, found.tgt_overlap, pair)
        figures["overlap_error"] = overlap_error(counts)
    return figures


def _register_given(
    model: ModelConfig,
    trainable: Any,
    pair: Pair,
    masks: tuple[Array, Array],
    dropout_key: PRNGKeyArray | None = None,
    *,
    solves: int | None = None,
) -> Registration:
    params = Params({"registration": trainable}, model)
    source, target = (mask.astype(pair.source.points.dtype) for mask in masks)
    return register_given_overlap(
        params, pair.source, pair.target, source, target, dropout_key, solves=solves
    )


def joint_turn(
    model: ModelConfig,
    networks: dict[str, Any],
    pair: Pair,
    start: Rigid | None,
    dropout_key: PRNGKeyArray | None = None,
) -> tuple[tuple[Array, Array], SoftMatches | None, Registration, Pair]:
    """One pass, and the registration of what it found: from the start, if there is one.

    Returns both clouds' overlap, the matches, the registration, and the pair it is of.
    """
    params = Params(networks, model)
    # One for each network: from the same key both would drop the same weights.
    keys = (None, None) if dropout_key is None else tuple(jax.random.split(dropout_key))
    source, target, matched = predict_overlap_and_matches(
        params, pair.source, pair.target, keys[0], start
    )
    moved = pair if start is None else transform_source(pair, start)
    found = register_given_overlap(params, moved.source, moved.target, source, target, keys[1])
    return (source, target), matched, found, moved


def joint_start(
    model: ModelConfig,
    networks: dict[str, Any],
    pair: Pair,
    start_key: PRNGKeyArray,
    choice_key: PRNGKeyArray,
) -> Rigid:
    """Half of the pairs go on from where a turn of the networks themselves brings them."""
    networks = jax.lax.stop_gradient(networks)

    def own(start: Rigid) -> Rigid:
        found: Registration = joint_turn(model, networks, pair, start)[2]
        return rigid.compose(found.motion, start)

    given = initial_pose(start_key, pair)
    return jax.lax.cond(jax.random.uniform(choice_key) < 0.5, own, lambda start: start, given)


def joint_loss_of(
    model: ModelConfig,
    gamma: float,
    weights: LossWeights,
    trainable: dict[str, Any],
    frozen: None,
    pair: Pair,
    key: PRNGKeyArray,
) -> tuple[Float[Array, ""], JointTerms]:
    """Both losses of one turn of both networks."""
    start_key, choice_key, dropout_key = jax.random.split(key, 3)
    start = None
    if _from_anywhere(model):
        start = joint_start(model, trainable, pair, start_key, choice_key)
    overlap, matched, found, moved = joint_turn(
        model, trainable, pair, start, dropout_key if model.dropout else None
    )
    source, target = overlap
    first, overlap_terms = overlap_loss(source, target, pair, gamma, matched)
    second, registration_terms = registration_loss(found, moved, weights)
    return first + second, JointTerms(*overlap_terms, *registration_terms)


def validate_joint(
    model: ModelConfig, trainable: dict[str, Any], frozen: None, pair: Pair
) -> dict[str, Float[Array, ""]]:
    """Errors of the pose and of the overlap after all turns."""
    found = register_clouds(Params(trainable, model), pair.source, pair.target)
    errors = motion_errors(found.motion, pair.target_from_source)
    counts = pair_confusion(found.src_overlap, found.tgt_overlap, pair)
    return {
        "error": errors.rotation_deg,
        "translation_error": errors.translation,
        "overlap_error": overlap_error(counts),
    }
