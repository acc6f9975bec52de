"""INENet's stage: the mask of either cloud, given the other."""

from __future__ import annotations

import dataclasses
import functools
from pathlib import Path
from typing import Any, NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from dbdnet_jax.networks.inenet.network import INENet, INENetConfig, as_channels, predict
from dbdnet_jax.networks.params import Params
from dbdnet_jax.ops.sampling import divisor
from dbdnet_jax.training.task import RunConfig, Task, check_stage
from dbdnet_jax.training.whole import overlap_scores, whole_network_task
from dbdnet_jax.types import Cloud, Pair

HUBER = 0.4  # where the loss turns from a parabola to a line


@dataclasses.dataclass(frozen=True)
class INENetStage:
    """The authors' settings."""

    epochs: float = 300.0
    batch_size: int = 32
    learning_rate: float = 1e-3

    def __post_init__(self) -> None:
        """Refuse a stage of nothing."""
        check_stage("inenet", self)


class INENetTerms(NamedTuple):
    """The only term of the loss."""

    mask: Float[Array, ""]


def margin_loss(
    margin: Float[Array, "*pairs n"],
    labels: Bool[Array, "*pairs n"],
    valid: Bool[Array, "*pairs n"],
) -> Float[Array, ""]:
    """Mean Huber loss between mask minus threshold and +1 or -1.

    The margin lies in (-1, 1), so the loss is a line until it exceeds 0.6 on the right side.
    """
    miss = jnp.abs(margin - jnp.where(labels, 1.0, -1.0))
    loss = jnp.where(miss < HUBER, 0.5 * miss * miss, HUBER * (miss - 0.5 * HUBER))
    return jnp.sum(jnp.where(valid, loss, 0.0)) / divisor(jnp.sum(valid), loss.dtype)


def loss_of_batch(
    model: INENetConfig,
    trainable: Any,
    frozen: None,
    pairs: Pair,
    key: PRNGKeyArray,
    batch_stats: Any,
) -> tuple[Float[Array, ""], tuple[INENetTerms, Any]]:
    """Of stacked pairs, each cloud in turn the source; both directions are one batch.

    The authors train one direction only: their source is whole.
    """
    there, back = pairs.source, pairs.target
    masked, channels = (
        Cloud(jnp.concatenate([a.points, b.points]), jnp.concatenate([a.count, b.count]))
        for a, b in ((there, back), (as_channels(back, model), as_channels(there, model)))
    )
    found, changed = INENet(model).apply(
        {"params": trainable, "batch_stats": batch_stats},
        masked,
        channels,
        training=True,
        mutable=["batch_stats"],
    )
    labels = jnp.concatenate([pairs.source_overlap, pairs.target_overlap])
    loss = margin_loss(found.margin, labels, masked.valid)
    return loss, (INENetTerms(loss), changed["batch_stats"])


def validate(
    model: INENetConfig, weights: Any, frozen: None, pair: Pair
) -> dict[str, Float[Array, ""]]:
    """The share of points of the wrong class, and F1."""
    params = Params({"inenet": weights}, model)
    return overlap_scores(predict(params, pair.source, pair.target), pair)


def inenet_task(config: RunConfig, run_dir: str | Path) -> Task:
    """The whole network, from fresh weights or ``config.train.start``."""
    loss = functools.partial(loss_of_batch, config.model)
    return whole_network_task(config, loss, validate)
