"""DCP's stage: the pose of a pair."""

from __future__ import annotations

import dataclasses
import functools
from pathlib import Path
from typing import Any, NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from dbdnet_jax.metrics.pose import rotation_error_deg, translation_error
from dbdnet_jax.networks.dcp.network import DCP, DCPConfig, match, predict_pose
from dbdnet_jax.networks.params import Params
from dbdnet_jax.training.task import RunConfig, Task, check_stage
from dbdnet_jax.training.whole import whole_network_task
from dbdnet_jax.types import Pair, Rigid


@dataclasses.dataclass(frozen=True)
class DCPStage:
    """The authors' settings."""

    epochs: float = 250.0
    batch_size: int = 32
    learning_rate: float = 1e-3

    def __post_init__(self) -> None:
        """Refuse a stage of nothing."""
        check_stage("dcp", self)


class DCPTerms(NamedTuple):
    """The two terms of the loss."""

    rotation: Float[Array, ""]
    translation: Float[Array, ""]


def pose_loss(predicted: Rigid, truth: Rigid) -> DCPTerms:
    """Mean squared entries of ``R_predicted^T R - I`` and of the difference of translations.

    The released code has a cycle term too, off by default and with a transpose where none belongs:
    exact inverses do not make it zero. It is left out.
    """
    turn = jnp.swapaxes(predicted.rotation, -1, -2) @ truth.rotation
    eye = jnp.broadcast_to(jnp.eye(3, dtype=turn.dtype), turn.shape)
    return DCPTerms(
        jnp.mean((turn - eye) ** 2), jnp.mean((predicted.translation - truth.translation) ** 2)
    )


def loss_of_batch(
    model: DCPConfig,
    trainable: Any,
    frozen: None,
    pairs: Pair,
    key: PRNGKeyArray,
    batch_stats: Any,
) -> tuple[Float[Array, ""], tuple[DCPTerms, Any]]:
    """Of stacked pairs, in one batch."""
    features, changed = DCP(model).apply(
        {"params": trainable, "batch_stats": batch_stats},
        pairs.source,
        pairs.target,
        training=True,
        mutable=["batch_stats"],
    )
    source, target = features
    pose = match(source, target, pairs.source, pairs.target).target_from_source
    terms = pose_loss(pose, pairs.target_from_source)
    return jnp.sum(jnp.stack(terms)), (terms, changed["batch_stats"])


def validate(
    model: DCPConfig, weights: Any, frozen: None, pair: Pair
) -> dict[str, Float[Array, ""]]:
    """The loss of one pair, and what it means in degrees."""
    pose = predict_pose(Params({"dcp": weights}, model), pair.source, pair.target)
    return {
        "error": jnp.sum(jnp.stack(pose_loss(pose, pair.target_from_source))),
        "rotation_deg": rotation_error_deg(pose.rotation, pair.target_from_source.rotation),
        "translation": translation_error(pose, pair.target_from_source),
    }


def dcp_task(config: RunConfig, run_dir: str | Path) -> Task:
    """The whole network, from fresh weights or ``config.train.start``."""
    loss = functools.partial(loss_of_batch, config.model)
    return whole_network_task(config, loss, validate)
