"""The two stages of training: what each one trains, behind what, and how it is judged.

"overlap" trains the overlap network; "registration" trains the registration network behind it,
frozen and deterministic (the released code leaves the frozen network's dropout on).
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from dbdnet_jax.checkpoint import load_best
from dbdnet_jax.losses import overlap_loss, registration_loss
from dbdnet_jax.metrics import pair_confusion, registration_errors
from dbdnet_jax.model.config import ModelConfig
from dbdnet_jax.model.dbdnet import predict_overlap, register_given_overlap
from dbdnet_jax.model.params import Params, init_params
from dbdnet_jax.safe_pickle import CheckpointError
from dbdnet_jax.settings import Settings
from dbdnet_jax.types import Pair

# (trainable, frozen, pair, key) -> (loss, NamedTuple of its terms)
LossFunction = Callable[[Any, Any, Pair, PRNGKeyArray], tuple[Float[Array, ""], Any]]
# (trainable, frozen, pair) -> scalars by name; "error", the smaller the better, chooses the best
Validation = Callable[[Any, Any, Pair], dict[str, Float[Array, ""]]]


class Task(NamedTuple):
    """One stage: the parameters it trains and those it leaves alone, its loss, its judge."""

    trainable: Any
    frozen: Any
    loss: LossFunction
    validate: Validation


def make_task(settings: Settings, stage: str, run_dir: str | Path) -> Task:
    """The task of a stage, from fresh parameters.

    Raises:
        CheckpointError: "registration" without a trained overlap network in ``run_dir``.
    """
    model = settings.model
    fresh = init_params(jax.random.key(settings.train.seed), model)
    if stage == "overlap":
        loss, validate = _overlap_functions(settings)
        return Task(fresh.overlap, None, loss, validate)
    loss, validate = _registration_functions(settings)
    frozen = None if settings.registration.true_masks else _trained_overlap(model, run_dir)
    return Task(fresh.registration, frozen, loss, validate)


def _trained_overlap(model: ModelConfig, run_dir: str | Path) -> Any:
    params = load_best(run_dir) if (Path(run_dir) / "overlap").is_dir() else None
    if params is None or params.overlap is None:
        raise CheckpointError(
            f"the registration stage needs a trained overlap network; {run_dir} has none. Train "
            "it first (--stage=overlap or both), or set config.registration.true_masks=True."
        )
    if params.config != model:
        raise CheckpointError(
            f"both networks of a run must be of one configuration; the overlap network in "
            f"{run_dir} is {params.config}, config.model is {model}. Give another --run_dir."
        )
    return params.overlap


def _overlap_functions(settings: Settings) -> tuple[LossFunction, Validation]:
    model, gamma = settings.model, settings.overlap.gamma

    def loss(trainable, frozen, pair, key):
        params = Params(trainable, None, model)
        key = key if model.dropout else None
        return overlap_loss(*predict_overlap(params, pair.source, pair.target, key), pair, gamma)

    def validate(trainable, frozen, pair):
        predicted = predict_overlap(Params(trainable, None, model), pair.source, pair.target)
        counts = pair_confusion(*predicted, pair)
        wrong = counts.false_positive + counts.false_negative
        return {
            "error": wrong / (wrong + counts.true_positive + counts.true_negative),
            "loss": overlap_loss(*predicted, pair, gamma)[0],
            "f1": 2 * counts.true_positive / jnp.maximum(2 * counts.true_positive + wrong, 1),
        }

    return loss, validate


def _registration_functions(settings: Settings) -> tuple[LossFunction, Validation]:
    model, stage = settings.model, settings.registration

    def answer(trainable, frozen, pair, key=None):
        if stage.true_masks:
            masks = [pair.source_overlap * 1.0, pair.target_overlap * 1.0]
        else:
            masks = predict_overlap(Params(frozen, None, model), pair.source, pair.target)
        params = Params(None, trainable, model)
        key = key if model.dropout else None
        return register_given_overlap(params, pair.source, pair.target, *masks, key)

    def loss(trainable, frozen, pair, key):
        return registration_loss(answer(trainable, frozen, pair, key), pair, stage.weights)

    def validate(trainable, frozen, pair):
        found = answer(trainable, frozen, pair)
        errors = registration_errors(found, pair)
        return {
            "error": errors.rotation_deg,
            "translation_error": errors.translation,
            "loss": registration_loss(found, pair, stage.weights)[0],
        }

    return loss, validate
