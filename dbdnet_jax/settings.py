"""A configuration as records: what `configs/*.py` says, checked once, before anything starts."""

from __future__ import annotations

import dataclasses
import difflib
import typing
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ml_collections import ConfigDict

from dbdnet_jax.data.mixture import Mixture
from dbdnet_jax.data.pairs import Protocol
from dbdnet_jax.losses import LossWeights
from dbdnet_jax.model.config import ModelConfig

DATA_SETS = ("cad", "modelnet40", "threedmatch")
MASKS = ("predicted", "truth", "imperfect")


@dataclasses.dataclass(frozen=True)
class DataSettings:
    """Which shapes or scans: ``folder`` is where the downloaded sets stand ("" for "cad")."""

    name: str
    folder: str
    categories: str  # "all", or one half of the shape classes: "seen" or "unseen"
    procedural: int = (
        0  # generated shapes to train on beside those of "cad": 15 ms each, every start
    )
    varied: float = 0.0  # share of the training pairs under other conditions than the protocol's
    mixture: Mixture = Mixture()  # shares of pairs as the world is; ``varied`` is of the others

    def __post_init__(self):
        """Refuse an unknown data set."""
        if self.name not in DATA_SETS:
            raise ValueError(
                f"config.data.name must be one of {DATA_SETS}; got {self.name!r}. Choose one."
            )
        if self.procedural < 0 or (self.procedural and self.name != "cad"):
            raise ValueError(
                "config.data.procedural must not be negative, and 0 for other data than 'cad'; got "
                f"{self.procedural} for {self.name!r}. Use 0."
            )
        if not 0 <= self.varied <= 1 or (self.varied and self.name == "threedmatch"):
            raise ValueError(
                "config.data.varied must be in [0, 1], and 0 for 'threedmatch', whose pairs are "
                f"read; got {self.varied} for {self.name!r}. Use 0."
            )
        if self.mixture.total and self.name == "threedmatch":
            raise ValueError(
                "config.data.mixture must be 0 for 'threedmatch', whose pairs are read; got "
                f"{self.mixture}. Set its shares to 0."
            )


@dataclasses.dataclass(frozen=True)
class TrainSettings:
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
    decay_epochs: float = 0.0  # at the end, the rate constant before them; 0: a cosine over all

    def __post_init__(self):
        """Refuse cadences that do not fit each other: a resumed log must equal an unbroken one."""
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
class OverlapSettings:
    """Stage 1: the overlap network."""

    epochs: float
    batch_size: int
    learning_rate: float
    gamma: float  # of the focal loss

    def __post_init__(self):
        """Refuse a stage of nothing."""
        _check_stage("overlap", self)


@dataclasses.dataclass(frozen=True)
class RegistrationSettings:
    """Stage 2: the registration network behind the frozen overlap network.

    ``masks`` says which points it is given: those that the overlap network "predicted"; those
    that overlap in "truth"; or "imperfect" ones (`pairs.imperfect_overlap`), with the true ones
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
        if self.masks not in MASKS:
            raise ValueError(
                f"config.registration.masks must be one of {MASKS}; got {self.masks!r}. Choose one."
            )


@dataclasses.dataclass(frozen=True)
class JointSettings:
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
class Settings:
    """All of a configuration."""

    model: ModelConfig
    data: DataSettings
    protocol: Protocol
    train: TrainSettings
    overlap: OverlapSettings
    registration: RegistrationSettings
    joint: JointSettings


def read_settings(config: ConfigDict) -> Settings:
    """The records of a configuration.

    Raises:
        ValueError: an unknown field (the nearest valid one is named), a missing one, or a value
            that its record refuses.
    """
    return read_record(Settings, config.to_dict(), "config")


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
    return record(
        **{
            name: read_record(types[name], value, f"{where}.{name}")
            if dataclasses.is_dataclass(types[name])
            else value
            for name, value in section.items()
        }
    )


def stage_record(settings: Settings, stage: str) -> dict[str, Any]:
    """What decides the outcome of a stage, as plain JSON values: a run may resume only with it.

    Where the rate is constant but for the last epochs, a run may be prolonged or cut short.
    """
    record = dataclasses.asdict(settings)
    if settings.train.decay_epochs:
        del record[stage]["epochs"]
    for name in ("devices", "batch_size", "learning_rate"):  # the stage holds the last two
        del record["train"][name]
    parts = ("overlap", "registration", "joint") if stage == "joint" else (stage,)
    return {name: record[name] for name in ("model", "data", "protocol", "train", *parts)}


def _check_stage(name: str, stage: OverlapSettings | RegistrationSettings | JointSettings) -> None:
    if stage.epochs <= 0 or stage.batch_size < 1:
        raise ValueError(
            f"config.{name} must have epochs > 0 and batch_size >= 1; got epochs={stage.epochs}, "
            f"batch_size={stage.batch_size}."
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
    path = config_flags.get_config_filename(flags.FLAGS["config"])
    if not Path(path).is_file():
        raise SystemExit(
            f"error: --config must be a file such as configs/cad.py; there is none at {path}. "
            "Start in the folder that holds configs/, or give the whole path."
        )
    return rest
