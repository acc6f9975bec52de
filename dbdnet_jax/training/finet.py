"""FINet's stage: the pose after every turn, and what each branch should and should not notice."""

from __future__ import annotations

import dataclasses
import functools
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from dbdnet_jax.metrics.pose import rotation_error_deg, translation_error
from dbdnet_jax.networks.chains import pose_terms, quaternion_pose
from dbdnet_jax.networks.finet.network import SENSITIVE, FINet, FINetConfig, Turn, predict_pose
from dbdnet_jax.networks.params import Params
from dbdnet_jax.training.task import RunConfig, Task, check_stage
from dbdnet_jax.training.whole import whole_network_task
from dbdnet_jax.types import Pair, Rigid

TRANSLATION_WEIGHT = 4.0
DROPOUT_WEIGHT = 0.0025
DROPPED = 0.3  # of the points


@dataclasses.dataclass(frozen=True)
class FINetStage:
    """The settings of the authors' PyTorch code; they train for 10,000 epochs.

    ``sensitivity`` is 0.001 in their MegEngine code.
    """

    epochs: float = 10_000.0
    batch_size: int = 64
    learning_rate: float = 1e-4
    sensitivity: float = 5e-4
    margin: float = 0.01

    def __post_init__(self) -> None:
        """Refuse a stage of nothing."""
        check_stage("finet", self)


class FINetTerms(NamedTuple):
    """The terms of the loss, weighted; the last two are of both branches."""

    rotation: Float[Array, ""]
    translation: Float[Array, ""]
    sensitivity: Float[Array, ""]
    dropout: Float[Array, ""]


def _mse(a: Array, b: Array) -> Array:
    return jnp.mean((a - b) ** 2)


def sensitivity_losses(turn: Turn, margin: float) -> tuple[Array, Array]:
    """For each branch: the source's feature moves with its half of the motion, and only with it."""
    if turn.rotated is None or turn.translated is None:
        raise ValueError("The turn must hold features of moved sources. Ask with sensitive=True.")
    of, turned, shifted = (
        [x[..., 0, :] for x in features]
        for features in (turn.features, turn.rotated, turn.translated)
    )
    rotation = jnp.maximum(0.0, margin - _mse(of[0], turned[0])) + _mse(of[1], turned[1])
    translation = jnp.maximum(0.0, margin - _mse(of[1], shifted[1])) + _mse(of[0], shifted[0])
    return rotation, translation


def dropout_losses(turn: Turn) -> Float[Array, "2 2"]:
    """Mean squared change of the pooled features by the drop: branch, then source and target."""
    if turn.dropped is None:
        return jnp.zeros((2, 2), turn.centres.dtype)
    return jnp.stack(
        [
            jnp.stack([_mse(a[..., c, :], b[..., c, :]) for c in (0, 1)])
            for a, b in zip(turn.features, turn.dropped, strict=True)
        ]
    )


def turn_losses(turn: Turn, number: int, truth: Rigid, stage: FINetStage) -> FINetTerms:
    """The terms of one turn."""
    rotation, translation = pose_terms(turn.pose, quaternion_pose(truth))
    sensitivity = jnp.zeros_like(rotation)
    if number < SENSITIVE:
        losses = jnp.stack(sensitivity_losses(turn, stage.margin))
        sensitivity = stage.sensitivity * jnp.sum(losses)
    dropout = DROPOUT_WEIGHT * jnp.sum(dropout_losses(turn))
    return FINetTerms(rotation, TRANSLATION_WEIGHT * translation, sensitivity, dropout)


def loss_of_batch(
    model: FINetConfig,
    stage: FINetStage,
    trainable: Any,
    frozen: None,
    pairs: Pair,
    key: PRNGKeyArray,
    batch_stats: Any,
) -> tuple[Float[Array, ""], tuple[FINetTerms, Any]]:
    """Of stacked pairs, in one batch: the sum over the turns."""
    rows = pairs.source.points.shape[-2] + pairs.target.points.shape[-2]
    draw = jax.random.uniform(key, (model.turns, *pairs.source.points.shape[:-2], rows))
    turns, changed = FINet(model).apply(
        {"params": trainable, "batch_stats": batch_stats},
        pairs.source,
        pairs.target,
        draw > DROPPED,
        training=True,
        sensitive=True,
        mutable=["batch_stats"],
    )
    terms = [turn_losses(turn, i, pairs.target_from_source, stage) for i, turn in enumerate(turns)]
    total = FINetTerms(*(jnp.sum(jnp.stack(term)) for term in zip(*terms, strict=True)))
    return jnp.sum(jnp.stack(total)), (total, changed["batch_stats"])


def validate(
    model: FINetConfig, weights: Any, frozen: None, pair: Pair
) -> dict[str, Float[Array, ""]]:
    """The authors' score: angle in degrees / 100 plus distance."""
    pose = predict_pose(Params({"finet": weights}, model), pair.source, pair.target)
    degrees = rotation_error_deg(pose.rotation, pair.target_from_source.rotation)
    distance = translation_error(pose, pair.target_from_source)
    return {"error": 0.01 * degrees + distance, "rotation_deg": degrees, "translation": distance}


def finet_task(config: RunConfig, run_dir: str | Path) -> Task:
    """The whole network, from fresh weights or ``config.train.start``."""
    loss = functools.partial(loss_of_batch, config.model, config.stages["finet"])
    return whole_network_task(config, loss, validate)
