"""The stages of training: what each one trains, behind what, and how it is judged.

"overlap" trains the overlap network; "registration" trains the registration network behind it,
frozen and deterministic (the released code leaves the frozen network's dropout on). "joint", which
the paper does not have, then trains both on what they make of a pair together.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from dbdnet_jax.checkpoint import JOINT, STAGES, load_best
from dbdnet_jax.data.pairs import imperfect_overlap, moved_pair, starting_motion
from dbdnet_jax.losses import JointTerms, overlap_loss, registration_loss
from dbdnet_jax.metrics import pair_confusion, registration_errors
from dbdnet_jax.model.config import ModelConfig
from dbdnet_jax.model.dbdnet import (
    predict_overlap_and_matches,
    register_clouds,
    register_given_overlap,
)
from dbdnet_jax.model.growing import with_local_geometry
from dbdnet_jax.model.params import (
    Params,
    flatten,
    init_params,
    parameter_shapes,
    require_shapes,
)
from dbdnet_jax.ops import rigid
from dbdnet_jax.safe_pickle import CheckpointError
from dbdnet_jax.settings import Settings
from dbdnet_jax.types import Pair, Registration, Rigid
from dbdnet_jax.weights import load_params

# (trainable, frozen, pair, key) -> (loss, NamedTuple of its terms)
LossFunction = Callable[[Any, Any, Pair, PRNGKeyArray], tuple[Float[Array, ""], Any]]
# (trainable, frozen, pair) -> scalars by name; "error", the smaller the better, chooses the best
Validation = Callable[[Any, Any, Pair], dict[str, Float[Array, ""]]]


class Task(NamedTuple):
    """One stage: the parameters it trains and those it leaves alone, its loss, its judge.

    Where it trains several ``networks``, ``trainable`` holds them by these names.
    """

    trainable: Any
    frozen: Any
    loss: LossFunction
    validate: Validation
    networks: tuple[str, ...] = ()


def make_task(settings: Settings, stage: str, run_dir: str | Path) -> Task:
    """The task of a stage, from fresh parameters.

    Raises:
        CheckpointError: "registration" without a trained overlap network in ``run_dir``; "joint"
            without both networks there or in ``config.train.start``.
    """
    model = settings.model
    if stage == JOINT:
        loss, validate = _joint_functions(settings)
        return Task(_both_trained(settings, run_dir), None, loss, validate, STAGES)
    fresh = _first_params(settings)
    if stage == "overlap":
        loss, validate = _overlap_functions(settings)
        return Task(fresh.overlap, None, loss, validate)
    loss, validate = _registration_functions(settings)
    predicted = settings.registration.masks == "predicted"
    frozen = _trained_overlap(model, run_dir) if predicted else None
    return Task(fresh.registration, frozen, loss, validate)


def _first_params(settings: Settings) -> Params:
    """Fresh parameters, or those of ``config.train.start`` where it holds the network."""
    fresh = init_params(jax.random.key(settings.train.seed), settings.model)
    if not settings.train.start:
        return fresh
    start = _start_params(settings)
    return Params(
        start.overlap or fresh.overlap, start.registration or fresh.registration, settings.model
    )


def _start_params(settings: Settings) -> Params:
    """The networks in ``config.train.start``: one or both, of the configuration's widths.

    Weights without local geometry, or with less of it, are given the rest (zeros at first).
    """
    if not Path(settings.train.start).is_file():
        raise FileNotFoundError(
            "config.train.start must be a file of weights; there is none at "
            f"{settings.train.start}. Give its path, or '' to start from fresh weights."
        )
    start = load_params(settings.train.start)
    if start.config.local_geometry < settings.model.local_geometry:
        start = with_local_geometry(start, settings.model.local_geometry)
    held = [name for name in STAGES if getattr(start, name) is not None]
    require_shapes(
        {name: array.shape for name, array in flatten(start).items()},
        parameter_shapes(settings.model, held),
        f"config.train.start={settings.train.start}",
        "Give weights of the same widths as config.model, or set config.train.start=''.",
    )
    return dataclasses.replace(start, config=settings.model)


def _both_trained(settings: Settings, run_dir: str | Path) -> dict[str, Any]:
    """Both networks of the run or, where it has none, of ``config.train.start``."""
    params, where = None, str(run_dir)
    if any((Path(run_dir) / stage).is_dir() for stage in STAGES):
        params = load_best(run_dir, joint=False)
        _require_model(params, settings.model, run_dir)
    elif settings.train.start:
        params, where = _start_params(settings), settings.train.start
    if params is None or params.overlap is None or params.registration is None:
        raise CheckpointError(
            f"the joint stage goes on from two trained networks; {where} does not hold both. Train "
            "them in that folder first (--stage=both), or give a new --run_dir and "
            "--config.train.start=FILE with both."
        )
    return {"overlap": params.overlap, "registration": params.registration}


def _trained_overlap(model: ModelConfig, run_dir: str | Path) -> Any:
    has_one = (Path(run_dir) / "overlap").is_dir()
    params = load_best(run_dir, joint=False) if has_one else None
    if params is None or params.overlap is None:
        raise CheckpointError(
            f"the registration stage needs a trained overlap network; {run_dir} has none. Train "
            "it first (--stage=overlap or both), or set config.registration.masks='truth'."
        )
    _require_model(params, model, run_dir)
    return params.overlap


def _require_model(params: Params, model: ModelConfig, run_dir: str | Path) -> None:
    if params.config != model:
        raise CheckpointError(
            f"both networks of a run must be of one configuration; {run_dir} holds one of "
            f"{params.config}, config.model is {model}. Give another --run_dir."
        )


def _overlap_functions(settings: Settings) -> tuple[LossFunction, Validation]:
    model, gamma = settings.model, settings.overlap.gamma

    def loss(trainable, frozen, pair, key):
        params = Params(trainable, None, model)
        start_key, dropout_key = jax.random.split(key)
        dropout_key = dropout_key if model.dropout else None
        # Each pass is trained for itself, from starts such as the passes before it may leave.
        start = starting_motion(start_key, pair) if model.overlap_passes > 1 else None
        *predicted, matched = predict_overlap_and_matches(
            params, pair.source, pair.target, dropout_key, start
        )
        return overlap_loss(*predicted, pair, gamma, matched)

    def validate(trainable, frozen, pair):
        params = Params(trainable, None, model)
        *predicted, matched = predict_overlap_and_matches(params, pair.source, pair.target)
        counts = pair_confusion(*predicted, pair)
        wrong = counts.false_positive + counts.false_negative
        return {
            "error": wrong / (wrong + counts.true_positive + counts.true_negative),
            "loss": overlap_loss(*predicted, pair, gamma, matched)[0],
            "f1": 2 * counts.true_positive / jnp.maximum(2 * counts.true_positive + wrong, 1),
        }

    return loss, validate


def _from_anywhere(model: ModelConfig) -> bool:
    """Whether each turn is trained for itself, from starts such as those before it may leave."""
    return (model.overlap_passes > 1 or model.iterations > 1) and not model.released


def _registration_functions(settings: Settings) -> tuple[LossFunction, Validation]:
    model, stage = settings.model, settings.registration

    def given(key, frozen, pair, start):
        if stage.masks == "predicted":
            params = Params(frozen, None, model)
            return predict_overlap_and_matches(params, pair.source, pair.target, start=start)[:2]
        if stage.masks == "imperfect":
            return imperfect_overlap(key, pair, settings.protocol.overlap_radius)
        return pair.source_overlap, pair.target_overlap

    def answer(trainable, pair, masks, key=None, model=model):
        params = Params(None, trainable, model)
        masks = [mask * 1.0 for mask in masks]
        return register_given_overlap(params, pair.source, pair.target, *masks, key)

    def loss(trainable, frozen, pair, key):
        mask_key, start_key, dropout_key = jax.random.split(key, 3)
        start = starting_motion(start_key, pair) if _from_anywhere(model) else None
        masks = given(mask_key, frozen, pair, start)
        one = model
        if start is not None:
            pair = moved_pair(pair, start)
            one = dataclasses.replace(model, iterations=1)
        dropout_key = dropout_key if model.dropout else None
        found = answer(trainable, pair, masks, dropout_key, one)
        return registration_loss(found, pair, stage.weights)

    def validate(trainable, frozen, pair):
        if stage.masks == "predicted":
            found = register_clouds(Params(frozen, trainable, model), pair.source, pair.target)
        else:
            as_often = dataclasses.replace(model, iterations=model.solves)
            truth = pair.source_overlap, pair.target_overlap
            found = answer(trainable, pair, truth, model=as_often)
        errors = registration_errors(found, pair)
        return {
            "error": errors.rotation_deg,
            "translation_error": errors.translation,
            "loss": registration_loss(found, pair, stage.weights)[0],
        }

    return loss, validate


def _joint_functions(settings: Settings) -> tuple[LossFunction, Validation]:
    model, gamma, weights = settings.model, settings.overlap.gamma, settings.registration.weights
    one = dataclasses.replace(model, iterations=1) if _from_anywhere(model) else model

    def turn(networks, pair, start, dropout_key=None):
        """One look, and the registration of what it found: from the start, if there is one."""
        params = Params(networks["overlap"], networks["registration"], one)
        *overlap, matched = predict_overlap_and_matches(
            params, pair.source, pair.target, dropout_key, start
        )
        moved = pair if start is None else moved_pair(pair, start)
        found = register_given_overlap(params, moved.source, moved.target, *overlap, dropout_key)
        return overlap, matched, found, moved

    def own_start(networks, pair, start):
        found: Registration = turn(networks, pair, start)[2]
        return rigid.compose(Rigid(found.rotation, found.translation), start)

    def loss(trainable, frozen, pair, key):
        start_key, choice_key, dropout_key = jax.random.split(key, 3)
        start = None
        if _from_anywhere(model):
            # Half of the pairs go on from where a turn of the networks themselves brings them.
            start = jax.lax.cond(
                jax.random.uniform(choice_key) < 0.5,
                lambda motion: own_start(jax.lax.stop_gradient(trainable), pair, motion),
                lambda motion: motion,
                starting_motion(start_key, pair),
            )
        dropout_key = dropout_key if model.dropout else None
        overlap, matched, found, moved = turn(trainable, pair, start, dropout_key)
        first, overlap_terms = overlap_loss(*overlap, pair, gamma, matched)
        second, registration_terms = registration_loss(found, moved, weights)
        return first + second, JointTerms(*overlap_terms, *registration_terms)

    def validate(trainable, frozen, pair):
        params = Params(trainable["overlap"], trainable["registration"], model)
        found = register_clouds(params, pair.source, pair.target)
        errors = registration_errors(found, pair)
        counts = pair_confusion(found.src_overlap, found.tgt_overlap, pair)
        wrong = counts.false_positive + counts.false_negative
        return {
            "error": errors.rotation_deg,
            "translation_error": errors.translation,
            "overlap_error": wrong / (wrong + counts.true_positive + counts.true_negative),
        }

    return loss, validate
