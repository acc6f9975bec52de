"""A configuration as records: what `configs/*.py` says, checked once, before anything starts."""

from __future__ import annotations

import dataclasses
import difflib
import typing
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ml_collections import ConfigDict

from dbdnet_jax.data.config import DataConfig
from dbdnet_jax.data.pairs import Protocol
from dbdnet_jax.networks.dbdnet.config import ModelConfig
from dbdnet_jax.training.losses import LossWeights

LARGEST = 1e15  # of any number: whole numbers below it are exact as floats, and no count is larger
LARGEST_BATCH = 2**16  # pairs of a step, all of which are in memory
MASKS = ("predicted", "truth", "perturbed")


@dataclasses.dataclass(frozen=True)
class TrainConfig:
    """What all stages share; cadences are in steps, 0 switches clipping and the average off.

    ``start`` is a file of weights that the networks in it start from ("": fresh ones).
    ``batch_size`` and ``learning_rate`` are what the stages' own fields follow until set.
    """

    seed: int
    start: str
    batch_size: int
    learning_rate: float
    weight_decay: float
    warmup_epochs: float
    clip_norm: float  # global norm of a network's gradient
    ema_decay: float  # of the moving average of the weights, which then is what is kept
    log_every: int
    validate_every: int
    checkpoint_every: int
    validation_pairs: int
    devices: int  # XLA devices on a CPU; 0: one for each core

    def __post_init__(self):
        """Refuse what cannot be trained with.

        Cadences must fit each other: a resumed log must equal an unbroken one.
        """
        for name in ("weight_decay", "warmup_epochs", "clip_norm", "devices", "seed"):
            if getattr(self, name) < 0:
                raise ValueError(
                    f"config.train.{name} must not be negative; got {getattr(self, name)}. Use 0."
                )
        _check_steps("train", self.batch_size, self.learning_rate)
        if not 0 <= self.ema_decay < 1:
            raise ValueError(
                f"config.train.ema_decay must be in [0, 1); got {self.ema_decay}. Use 0 for none."
            )
        for name in ("log_every", "validate_every", "checkpoint_every", "validation_pairs"):
            value = getattr(self, name)
            if value < 1:
                raise ValueError(f"config.train.{name} must be at least 1; got {value}.")
            if name.endswith("_every") and value % self.log_every:
                raise ValueError(
                    f"config.train.{name} must be a multiple of config.train.log_every = "
                    f"{self.log_every}; got {value}. Change one of the two."
                )


@dataclasses.dataclass(frozen=True)
class OverlapConfig:
    """Stage 1: the overlap network."""

    epochs: float
    batch_size: int
    learning_rate: float
    gamma: float  # of the focal loss

    def __post_init__(self):
        """Refuse a stage of nothing."""
        _check_stage("overlap", self)
        if self.gamma < 0:
            raise ValueError(f"config.overlap.gamma must not be negative; got {self.gamma}. Use 4.")


@dataclasses.dataclass(frozen=True)
class RegistrationConfig:
    """Stage 2: the registration network behind the frozen overlap network.

    ``masks`` says which points it is given: those that the overlap network "predicted"; those
    that overlap in "truth"; or "perturbed" ones (`pairs.perturbed_overlap`), with the true ones
    for validation. The last two need no stage 1.
    """

    epochs: float
    batch_size: int
    learning_rate: float
    masks: str
    weights: LossWeights

    def __post_init__(self):
        """Refuse a stage of nothing, and masks that there are not."""
        _check_stage("registration", self)
        for name, weight in dataclasses.asdict(self.weights).items():
            if weight < 0:
                raise ValueError(
                    f"config.registration.weights.{name} must not be negative; got {weight}. Use 0."
                )
        if self.masks not in MASKS:
            raise ValueError(
                f"config.registration.masks must be one of {MASKS}; got {self.masks!r}. Choose one."
            )


@dataclasses.dataclass(frozen=True)
class JointConfig:
    """Both networks trained further together, each on what the other one makes of the pair.

    The loss is the sum of both stages' losses, with their gamma and weights.
    """

    epochs: float
    batch_size: int
    learning_rate: float

    def __post_init__(self):
        """Refuse a stage of nothing."""
        _check_stage("joint", self)


@dataclasses.dataclass(frozen=True)
class RunConfig:
    """All of a configuration."""

    model: ModelConfig
    data: DataConfig
    protocol: Protocol
    train: TrainConfig
    overlap: OverlapConfig
    registration: RegistrationConfig
    joint: JointConfig


def read_config(config: ConfigDict) -> RunConfig:
    """The records of a configuration.

    Raises:
        ValueError: an unknown field (the nearest valid one is named), a missing one, or a value
            that its record refuses.
    """
    return read_record(RunConfig, config.to_dict(), "config")


def read_record(record: type, section: Mapping[str, Any], where: str) -> Any:
    """``record`` from a mapping with exactly its fields; nested records from nested mappings."""
    types = typing.get_type_hints(record)
    for name in section:
        if name not in types:
            near = difflib.get_close_matches(name, types, n=1, cutoff=0.0)[0]
            raise ValueError(
                f"{where} must hold only the fields of {record.__name__}; got {where}.{name}. "
                f"Did you mean {where}.{near}?"
            )
    optional = {
        field.name
        for field in dataclasses.fields(record)
        if field.default is not dataclasses.MISSING
    }
    missing = [name for name in types if name not in section and name not in optional]
    if missing:
        raise ValueError(
            f"{where} must hold every field of {record.__name__}; it lacks {', '.join(missing)}. "
            "Start from a config in configs/ and state only the differences."
        )
    values = {
        name: _read_value(types[name], value, f"{where}.{name}") for name, value in section.items()
    }
    try:
        return record(**values)
    except ValueError as error:
        if str(error).startswith("config."):
            raise
        raise ValueError(f"in {where}: {error}") from error


def _read_value(kind: Any, value: Any, where: str) -> Any:
    """A field's value: of the field's type, and finite; for a nested record, the record."""
    if dataclasses.is_dataclass(kind):
        if not isinstance(value, Mapping):
            raise ValueError(
                f"{where} must be a section of fields; got {value!r:.60}. Start from a config in "
                "configs/."
            )
        return read_record(typing.cast(type, kind), value, where)
    accepted = (int, float) if kind is float else kind
    if not isinstance(value, accepted) or (isinstance(value, bool) and kind is not bool):
        raise ValueError(
            f"{where} must be of type {kind.__name__}; got {value!r:.60} "
            f"({type(value).__name__}). Give a value of that type."
        )
    if isinstance(value, int | float) and not abs(value) < LARGEST:
        raise ValueError(
            f"{where} must be finite and below {LARGEST:g}; got {value!r:.60}. Give such a number."
        )
    return value


def stage_record(config: RunConfig, stage: str) -> dict[str, Any]:
    """What decides the outcome of a stage, as plain JSON values: a run may resume only with it."""
    record = dataclasses.asdict(config)
    for name in ("devices", "batch_size", "learning_rate"):  # the stage holds the last two
        del record["train"][name]
    parts = ("overlap", "registration", "joint") if stage == "joint" else (stage,)
    return {name: record[name] for name in ("model", "data", "protocol", "train", *parts)}


def _check_stage(name: str, stage: OverlapConfig | RegistrationConfig | JointConfig) -> None:
    if stage.epochs <= 0:
        raise ValueError(f"config.{name}.epochs must be positive; got {stage.epochs}. Use 1.")
    _check_steps(name, stage.batch_size, stage.learning_rate)


def _check_steps(name: str, batch_size: int, learning_rate: float) -> None:
    if not 1 <= batch_size <= LARGEST_BATCH:
        raise ValueError(
            f"config.{name}.batch_size must be from 1 to {LARGEST_BATCH}; got {batch_size}. Use 8."
        )
    if learning_rate <= 0:
        raise ValueError(
            f"config.{name}.learning_rate must be positive; got {learning_rate}. Use 1e-4."
        )


def parse_flags(arguments: list[str]) -> list[str]:
    """``flags_parser`` of `absl.app.run` that says in one line what is wrong with ``--config``."""
    from absl import app, flags
    from ml_collections import config_flags

    try:
        rest = app.parse_flags_with_usage(arguments)
    except (AttributeError, KeyError) as error:  # from ml_collections, for an unknown field
        message = error.args[0]
        while isinstance(message, BaseException):
            message = message.args[0]
        field, *hint = str(message).splitlines()
        raise SystemExit(
            f"error: only fields of the configuration can be set; it has no {field}. "
            f"{' '.join(hint)}".rstrip()
        ) from None
    except (ValueError, TypeError) as error:  # a value that is of another type than its field
        raise SystemExit(f"error: {error}") from None
    path = config_flags.get_config_filename(flags.FLAGS["config"])
    if not Path(path).is_file():
        raise SystemExit(
            f"error: --config must be a file such as configs/cad.py; there is none at {path}. "
            "Start in the folder that holds configs/, or give the whole path."
        )
    return rest
