"""What the stages share that train a method's one network as a whole."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

from jaxtyping import Array, Float

from dbdnet_jax.metrics.pose import overlap_error, overlap_f1, pair_confusion
from dbdnet_jax.networks.batch_norm import split_batch_stats
from dbdnet_jax.training.start import initial_params
from dbdnet_jax.training.task import RunConfig, Task
from dbdnet_jax.types import Answer, Pair


def whole_network_task(
    config: RunConfig, loss: Callable[..., Any], validate: Callable[..., Any]
) -> Task:
    """The whole network, from fresh weights or ``config.train.start``.

    ``loss`` is a `Task`'s; so is ``validate``, with the model's configuration before the weights.
    """
    (network,) = initial_params(config).networks.values()
    trainable, batch_stats = split_batch_stats(network)
    judge = functools.partial(validate, config.model)
    return Task(trainable, None, loss, judge, batch_stats=batch_stats)


def overlap_scores(answer: Answer, pair: Pair) -> dict[str, Float[Array, ""]]:
    """The share of points of the wrong class, and F1."""
    assert answer.source_overlap is not None and answer.target_overlap is not None  # its whole work
    counts = pair_confusion(answer.source_overlap, answer.target_overlap, pair)
    return {"error": overlap_error(counts), "f1": overlap_f1(counts)}
