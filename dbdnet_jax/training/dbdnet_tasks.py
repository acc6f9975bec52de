"""DBDNet's stages as tasks: which weights each one starts from, and which stand still."""

from __future__ import annotations

import functools
from pathlib import Path
from typing import Any

from dbdnet_jax.errors import CheckpointError
from dbdnet_jax.training.dbdnet import (
    joint_loss_of,
    overlap_loss_of,
    registration_loss_of,
    validate_joint,
    validate_overlap,
    validate_registration,
)
from dbdnet_jax.training.run_folder import load_best
from dbdnet_jax.training.start import initial_params, load_start
from dbdnet_jax.training.task import RunConfig, Task

NETWORKS = ("overlap", "registration")


def overlap_task(config: RunConfig, run_dir: str | Path) -> Task:
    """Stage 1, from fresh weights or ``config.train.start``.

    Raises:
        ValueError: the configuration has no overlap network.
    """
    _require_overlap_network(config, "overlap")
    settings = config.model, config.stages["overlap"].gamma
    return Task(
        initial_params(config).overlap,
        None,
        functools.partial(overlap_loss_of, *settings),
        functools.partial(validate_overlap, *settings),
    )


def registration_task(config: RunConfig, run_dir: str | Path) -> Task:
    """Stage 2, from fresh weights or ``config.train.start``.

    Raises:
        ValueError: masks of the truth for a network that is given all points.
        CheckpointError: predicted masks, and no trained overlap network in ``run_dir``.
    """
    stage = config.stages["registration"]
    prior = config.model.overlap == "prior"
    if not prior and stage.masks != "predicted":
        raise ValueError(
            "config.registration.masks must be 'predicted' unless config.model.overlap is 'prior': "
            f"any other network is given all points; got {stage.masks!r} for "
            f"{config.model.overlap!r}. Change one of the two."
        )
    masked = prior and stage.masks == "predicted"
    frozen = trained_overlap(run_dir) if masked else None
    radius = config.protocol.overlap_radius
    return Task(
        initial_params(config).registration,
        frozen,
        functools.partial(registration_loss_of, config.model, stage, radius),
        functools.partial(validate_registration, config.model, stage),
    )


def joint_task(config: RunConfig, run_dir: str | Path) -> Task:
    """Both networks further.

    Raises:
        ValueError: there is one network only.
        CheckpointError: they are neither in ``run_dir`` nor in ``config.train.start``.
    """
    _require_overlap_network(config, "joint")
    settings = config.stages["overlap"].gamma, config.stages["registration"].weights
    return Task(
        both_trained(config, run_dir),
        None,
        functools.partial(joint_loss_of, config.model, *settings),
        functools.partial(validate_joint, config.model),
        NETWORKS,
    )


def _require_overlap_network(config: RunConfig, stage: str) -> None:
    if config.model.overlap != "prior":
        raise ValueError(
            f"the {stage} stage trains an overlap network, which only config.model.overlap='prior' "
            f"has; got {config.model.overlap!r}. Train with --stage=registration or all."
        )


def both_trained(config: RunConfig, run_dir: str | Path) -> dict[str, Any]:
    """Both networks of the run or, where it has none, of ``config.train.start``."""
    params, where = None, str(run_dir)
    if any((Path(run_dir) / stage).is_dir() for stage in NETWORKS):
        params = load_best(run_dir, joint=False)
    elif config.train.start:
        params, where = load_start(config), config.train.start
    if params is None or params.overlap is None or params.registration is None:
        raise CheckpointError(
            f"the joint stage goes on from two trained networks; {where} does not hold both. Train "
            "them in that folder first (--stage=both), or give a new --run_dir and "
            "--config.train.start=FILE with both."
        )
    return params.networks


def trained_overlap(run_dir: str | Path) -> Any:
    """The run's overlap network, as it was before any joint stage."""
    has_one = (Path(run_dir) / "overlap").is_dir()
    params = load_best(run_dir, joint=False) if has_one else None
    if params is None or params.overlap is None:
        raise CheckpointError(
            f"the registration stage needs a trained overlap network; {run_dir} has none. Train "
            "it first (--stage=overlap or both), or set config.registration.masks='truth'."
        )
    return params.overlap
