"""RIENet's stage: aligned clouds, consistent neighbourhoods; neither pose nor overlap is told."""

from __future__ import annotations

import dataclasses
import functools
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PRNGKeyArray

from dbdnet_jax.metrics.pose import rotation_error_deg, translation_error
from dbdnet_jax.networks.params import Params
from dbdnet_jax.networks.rienet.network import RIENet, RIENetConfig, Turn, predict_pose
from dbdnet_jax.networks.stacking import move, over_pairs, rows
from dbdnet_jax.ops.grouping import squared_distances
from dbdnet_jax.training.task import RunConfig, Task, check_stage
from dbdnet_jax.training.whole import whole_network_task
from dbdnet_jax.types import Cloud, Pair

SMALLEST_SCORE = 1e-15  # its logarithm is finite


@dataclasses.dataclass(frozen=True)
class RIENetStage:
    """The authors' settings. The losses are sums over the batch, so its size changes the step."""

    epochs: float = 50.0
    batch_size: int = 16
    learning_rate: float = 1e-3
    keypoints: int = 256
    huber: float = 0.01

    def __post_init__(self) -> None:
        """Refuse a stage of nothing."""
        check_stage("rienet", self)
        if self.keypoints < 1 or self.huber <= 0:
            raise ValueError(
                "config.rienet must have keypoints >= 1 and huber > 0; got "
                f"keypoints={self.keypoints}, huber={self.huber}."
            )


class RIENetTerms(NamedTuple):
    """The three terms of the loss."""

    alignment: Float[Array, ""]
    neighbourhood: Float[Array, ""]
    consistency: Float[Array, ""]


def alignment_loss(
    moved: Float[Array, "*pairs n 3"], source: Cloud, target: Cloud, huber: float
) -> Float[Array, ""]:
    """Huber of the squared distance to the nearest point, of all points of both clouds."""
    square = over_pairs(squared_distances, moved)(moved, target.points)
    present = source.valid[..., :, None] & target.valid[..., None, :]
    far = jnp.where(present, square, jnp.inf)
    total = jnp.zeros((), moved.dtype)
    for axis, valid in ((-1, source.valid), (-2, target.valid)):
        x = jnp.where(valid, jnp.min(far, axis=axis), 0.0)
        total += jnp.sum(jnp.where(x < huber, 0.5 * x * x, huber * x - 0.5 * huber * huber))
    return total


def turn_losses(
    turn: Turn,
    index: Int[Array, "*pairs n k"],
    source: Cloud,
    target: Cloud,
    *,
    stage: RIENetStage,
    k2: int,
) -> RIENetTerms:
    """The terms of one turn; the choice of the keypoints passes no gradient.

    The first two are sums over all pairs, the last is a mean.
    """
    moved = move(turn.increment, turn.points)
    alignment = alignment_loss(moved, source, target, stage.huber)
    confidence = jax.lax.stop_gradient(turn.confidence)
    count = min(stage.keypoints, confidence.shape[-1])
    key_rows = jax.lax.top_k(confidence, count)[1]

    def at_keys(x: Array) -> Array:
        return over_pairs(lambda x, key: x[key], x)(x, key_rows)

    neighbourhood = jnp.sum((at_keys(moved) - at_keys(turn.correspondence)) ** 2)
    edges = [rows(points, index) - points[..., None, :] for points in (moved, turn.correspondence)]
    difference = (edges[0] - edges[1]) ** 2
    difference = jnp.sum(difference, axis=-1)
    neighbourhood += jnp.sum(at_keys(difference)) / k2
    best = jnp.max(at_keys(turn.maps.refined), axis=-1)
    return RIENetTerms(alignment, neighbourhood, -jnp.mean(jnp.log(best + SMALLEST_SCORE)))


def total_terms(terms: list[RIENetTerms]) -> RIENetTerms:
    """The terms of all turns."""
    return RIENetTerms(*(jnp.sum(jnp.stack(term)) for term in zip(*terms, strict=True)))


def loss_of_batch(
    model: RIENetConfig,
    stage: RIENetStage,
    trainable: Any,
    frozen: None,
    pairs: Pair,
    key: PRNGKeyArray,
    batch_stats: Any,
) -> tuple[Float[Array, ""], tuple[RIENetTerms, Any]]:
    """Of stacked pairs, in one batch."""
    (turns, index), changed = RIENet(model).apply(
        {"params": trainable, "batch_stats": batch_stats},
        pairs.source,
        pairs.target,
        training=True,
        mutable=["batch_stats"],
    )
    terms = total_terms(
        [
            turn_losses(turn, index, pairs.source, pairs.target, stage=stage, k2=model.k2)
            for turn in turns
        ]
    )
    return jnp.sum(jnp.stack(terms)), (terms, changed["batch_stats"])


def validate(
    model: RIENetConfig, weights: Any, frozen: None, pair: Pair
) -> dict[str, Float[Array, ""]]:
    """Angle in radians plus distance."""
    pose = predict_pose(Params({"rienet": weights}, model), pair.source, pair.target)
    degrees = rotation_error_deg(pose.rotation, pair.target_from_source.rotation)
    distance = translation_error(pose, pair.target_from_source)
    return {
        "error": jnp.deg2rad(degrees) + distance,
        "rotation_deg": degrees,
        "translation": distance,
    }


def rienet_task(config: RunConfig, run_dir: str | Path) -> Task:
    """The whole network, from fresh weights or ``config.train.start``."""
    loss = functools.partial(loss_of_batch, config.model, config.stages["rienet"])
    return whole_network_task(config, loss, validate)
