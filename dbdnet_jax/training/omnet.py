"""OMNet's stage: the overlap and the pose after every turn."""

from __future__ import annotations

import dataclasses
import functools
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from dbdnet_jax.metrics.pose import (
    overlap_error,
    pair_confusion,
    rotation_error_deg,
    translation_error,
)
from dbdnet_jax.networks.chains import pose_terms, quaternion_pose
from dbdnet_jax.networks.omnet.network import OMNet, OMNetConfig, Turn, predict
from dbdnet_jax.networks.params import Params
from dbdnet_jax.networks.stacking import move, over_pairs
from dbdnet_jax.ops.grouping import squared_distances
from dbdnet_jax.training.task import RunConfig, Task, check_stage
from dbdnet_jax.training.whole import whole_network_task
from dbdnet_jax.types import Cloud, Pair, Rigid

CLASS_WEIGHTS = (0.7, 0.3)  # without and with a counterpart
TRANSLATION_WEIGHT = 4.0
MASKED_OUT = (50.0, 100.0)  # where points already masked out are moved, far from all others


@dataclasses.dataclass(frozen=True)
class OMNetStage:
    """The authors' settings; they train for 10,000 epochs."""

    epochs: float = 10_000.0
    batch_size: int = 64
    learning_rate: float = 1e-4
    overlap_radius: float = 0.1

    def __post_init__(self) -> None:
        """Refuse a stage of nothing."""
        check_stage("omnet", self)
        if self.overlap_radius <= 0:
            raise ValueError(
                f"config.omnet.overlap_radius must be positive; got {self.overlap_radius}."
            )


class OMNetTerms(NamedTuple):
    """The three terms of the loss, weighted."""

    overlap: Float[Array, ""]
    rotation: Float[Array, ""]
    translation: Float[Array, ""]


def labels(
    source: Cloud,
    target: Cloud,
    truth: Rigid,
    masks: tuple[Bool[Array, "*pairs n"], Bool[Array, "*pairs m"]],
    radius: float,
) -> tuple[Bool[Array, "*pairs n"], Bool[Array, "*pairs m"]]:
    """Which points have a counterpart under the true pose, given what is masked out already.

    Points masked out are nobody's counterpart, and have none.
    """
    points = move(truth, source.points), target.points
    of_source, of_target = (
        jnp.where(mask[..., None], x, place)
        for x, mask, place in zip(points, masks, MASKED_OUT, strict=True)
    )
    near = over_pairs(squared_distances, of_source)(of_source, of_target) < radius**2
    return jnp.any(near, axis=-1), jnp.any(near, axis=-2)


def class_loss(
    logits: Float[Array, "*pairs n 2"], overlap: Bool[Array, "*pairs n"]
) -> Float[Array, ""]:
    """Cross-entropy, points weighted by their class and the weights' sum divided out."""
    chosen = jax.nn.log_softmax(logits, axis=-1)
    chosen = jnp.where(overlap, chosen[..., 1], chosen[..., 0])
    weight = jnp.where(overlap, CLASS_WEIGHTS[1], CLASS_WEIGHTS[0]).astype(logits.dtype)
    return -jnp.sum(weight * chosen) / jnp.sum(weight)


def turn_losses(
    turn: Turn, source: Cloud, target: Cloud, truth: Rigid, radius: float
) -> OMNetTerms:
    """The terms of one turn."""
    overlaps = labels(source, target, truth, turn.masks, radius)
    of_classes = [
        class_loss(logits, overlap) for logits, overlap in zip(turn.logits, overlaps, strict=True)
    ]
    rotation, translation = pose_terms(turn.pose, quaternion_pose(truth))
    return OMNetTerms(
        (of_classes[0] + of_classes[1]) / 2, rotation, TRANSLATION_WEIGHT * translation
    )


def loss_of_batch(
    model: OMNetConfig,
    stage: OMNetStage,
    trainable: Any,
    frozen: None,
    pairs: Pair,
    key: PRNGKeyArray,
    batch_stats: Any,
) -> tuple[Float[Array, ""], tuple[OMNetTerms, Any]]:
    """Of stacked pairs, in one batch: the sum over the turns."""
    turns, changed = OMNet(model).apply(
        {"params": trainable, "batch_stats": batch_stats},
        pairs.source,
        pairs.target,
        training=True,
        mutable=["batch_stats"],
    )
    truth = pairs.target_from_source
    terms = [
        turn_losses(turn, pairs.source, pairs.target, truth, stage.overlap_radius) for turn in turns
    ]
    total = OMNetTerms(*(jnp.sum(jnp.stack(term)) for term in zip(*terms, strict=True)))
    return jnp.sum(jnp.stack(total)), (total, changed["batch_stats"])


def validate(
    model: OMNetConfig, weights: Any, frozen: None, pair: Pair
) -> dict[str, Float[Array, ""]]:
    """The authors' score: angle in degrees / 100 plus distance; and the overlap's error."""
    answer = predict(Params({"omnet": weights}, model), pair.source, pair.target)
    assert answer.motion is not None  # OMNet's answers are whole
    assert answer.source_overlap is not None and answer.target_overlap is not None
    degrees = rotation_error_deg(answer.motion.rotation, pair.target_from_source.rotation)
    distance = translation_error(answer.motion, pair.target_from_source)
    counts = pair_confusion(answer.source_overlap, answer.target_overlap, pair)
    return {
        "error": 0.01 * degrees + distance,
        "rotation_deg": degrees,
        "translation": distance,
        "overlap_error": overlap_error(counts),
    }


def omnet_task(config: RunConfig, run_dir: str | Path) -> Task:
    """The whole network, from fresh weights or ``config.train.start``."""
    loss = functools.partial(loss_of_batch, config.model, config.stages["omnet"])
    return whole_network_task(config, loss, validate)
