"""MaskNet's stage: the mask of either cloud, given the other."""

from __future__ import annotations

import dataclasses
import functools
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from dbdnet_jax.networks.masknet.network import MaskNet, MaskNetConfig, predict
from dbdnet_jax.networks.params import Params
from dbdnet_jax.networks.stacking import without_padding
from dbdnet_jax.ops.sampling import divisor
from dbdnet_jax.training.task import RunConfig, Task, check_stage
from dbdnet_jax.training.whole import overlap_scores, whole_network_task
from dbdnet_jax.types import Pair


@dataclasses.dataclass(frozen=True)
class MaskNetStage:
    """The authors' settings."""

    epochs: float = 500.0
    batch_size: int = 32
    learning_rate: float = 1e-4

    def __post_init__(self) -> None:
        """Refuse a stage of nothing."""
        check_stage("masknet", self)


class MaskNetTerms(NamedTuple):
    """The only term of the loss."""

    mask: Float[Array, ""]


def mask_loss(
    logits: Float[Array, "*pairs n"],
    labels: Bool[Array, "*pairs n"],
    valid: Bool[Array, "*pairs n"],
) -> Float[Array, ""]:
    """Mean over the points of the squared difference between mask and label."""
    difference = jnp.where(valid, jax.nn.sigmoid(logits) - labels.astype(logits.dtype), 0.0)
    return jnp.sum(difference**2) / divisor(jnp.sum(valid), difference.dtype)


def loss_of_batch(
    model: MaskNetConfig,
    trainable: Any,
    frozen: None,
    pairs: Pair,
    key: PRNGKeyArray,
    batch_stats: Any,
) -> tuple[Float[Array, ""], tuple[MaskNetTerms, Any]]:
    """Of stacked pairs, each cloud in turn the template; both directions are one batch.

    The authors train one direction only: their template is whole.
    """
    # A NaN in the padding would reach the gradient through a weight of zero.
    points = [without_padding(cloud).points for cloud in (pairs.source, pairs.target)]
    logits, changed = MaskNet(model).apply(
        {"params": trainable, "batch_stats": batch_stats},
        jnp.concatenate(points),
        jnp.concatenate(points[::-1]),
        jnp.concatenate([pairs.source.valid, pairs.target.valid]),
        training=True,
        mutable=["batch_stats"],
    )
    loss = mask_loss(
        logits,
        jnp.concatenate([pairs.target_overlap, pairs.source_overlap]),
        jnp.concatenate([pairs.target.valid, pairs.source.valid]),
    )
    return loss, (MaskNetTerms(loss), changed["batch_stats"])


def validate(
    model: MaskNetConfig, weights: Any, frozen: None, pair: Pair
) -> dict[str, Float[Array, ""]]:
    """The share of points of the wrong class, and F1."""
    params = Params({"masknet": weights}, model)
    return overlap_scores(predict(params, pair.source, pair.target), pair)


def masknet_task(config: RunConfig, run_dir: str | Path) -> Task:
    """The whole network, from fresh weights or ``config.train.start``."""
    loss = functools.partial(loss_of_batch, config.model)
    return whole_network_task(config, loss, validate)
