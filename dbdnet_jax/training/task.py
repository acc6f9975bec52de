"""What a stage of training is: the task that the loop works on, and the records that set it up."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

from dbdnet_jax.data.config import DataConfig
from dbdnet_jax.data.pairs import Protocol
from dbdnet_jax.networks.table import DEFAULT_METHOD

OPTIMIZERS = ("adamw", "adam")
LARGEST_BATCH = 2**16  # pairs of a step, all of which are in memory
SCHEDULES = ("cosine", "constant", "steps")
PRECISIONS = ("float32", "bfloat16")


class Task(NamedTuple):
    """One stage: the parameters it trains and those it leaves alone, its loss, its judge.

    ``loss(trainable, frozen, pair, key)`` gives the loss of one pair and a NamedTuple of its terms.
    A network with batch norms has running averages, ``batch_stats``, and a loss of a whole batch:
    ``loss(trainable, frozen, pairs, key, batch_stats)``, of stacked pairs, gives the loss, and the
    terms with the new averages. ``validate(weights, frozen, pair)`` gives scalars by name, of one
    pair, from weights whose batch norms are folded; "error", the smaller the better, chooses the
    best. Where the stage trains several ``networks``, ``trainable`` holds them by these names.
    """

    trainable: Any
    frozen: Any
    loss: Callable[..., Any]
    validate: Callable[..., Any]
    networks: tuple[str, ...] = ()
    batch_stats: Any = None


class Stage(NamedTuple):
    """One line of `training.table`: the stage's record, its task, other stages' records it reads.

    The record is a frozen dataclass with a default for every field, among them ``epochs``,
    ``batch_size`` and ``learning_rate``; it is the section of the stage's name in a configuration.
    """

    record: type
    make_task: Callable[[RunConfig, str | Path], Task]
    reads: tuple[str, ...] = ()


@dataclasses.dataclass(frozen=True)
class TrainConfig:
    """What all stages share; cadences are in steps, 0 switches clipping and the average off.

    The defaults are the paper's for DBDNet. ``start`` is a file of weights that the networks in it
    start from ("": fresh ones). ``batch_size`` and ``learning_rate`` are what the stages' own
    fields follow until set. ``optimizer`` "adam" adds the weight decay to the gradient, as torch's
    Adam does, "adamw" does not. ``schedule`` "cosine" ends at 0; "steps" multiplies the rate by
    ``factor`` after each of the ``milestones`` (epochs); "constant" falls to 0 by a cosine over the
    last ``decay_epochs`` only, so that such a run may be prolonged or cut short. All may warm up.
    ``precision`` is that of the networks' products in the loss (`params.bfloat16_kernels`): weights
    and their average stay in float32, and the validation uses them so.
    """

    seed: int = 0
    start: str = ""
    batch_size: int = 8
    learning_rate: float = 1e-4
    optimizer: str = "adamw"
    weight_decay: float = 1e-4
    schedule: str = "cosine"
    milestones: tuple[float, ...] = ()
    factor: float = 0.1
    decay_epochs: float = 0.0
    warmup_epochs: float = 5.0
    clip_norm: float = 0.0  # global norm of a network's gradient
    ema_decay: float = 0.0  # of the moving average of the weights, which then is what is kept
    log_every: int = 20
    validate_every: int = 1000
    checkpoint_every: int = 200
    validation_pairs: int = 200
    devices: int = 0  # that share each batch; 0: all (on a CPU, of one for each core)
    accumulate: int = 1  # parts of a device's share, taken one after another on a GPU or TPU
    remat: bool = False  # recompute the loss for its gradient instead of keeping what it needs
    precision: str = "float32"  # or "bfloat16"

    def __post_init__(self) -> None:
        """Refuse unknown choices, and cadences that do not fit: a resumed log must be unbroken."""
        for name, choices in (
            ("optimizer", OPTIMIZERS),
            ("schedule", SCHEDULES),
            ("precision", PRECISIONS),
        ):
            if getattr(self, name) not in choices:
                raise ValueError(
                    f"config.train.{name} must be one of {choices}; got {getattr(self, name)!r}. "
                    "Choose one."
                )
        if bool(self.milestones) != (self.schedule == "steps"):
            raise ValueError(
                "config.train.milestones must be given for schedule='steps', and for it alone; got "
                f"{self.milestones} for {self.schedule!r}. Change one of the two."
            )
        if self.decay_epochs and self.schedule != "constant":
            raise ValueError(
                "config.train.decay_epochs must be 0 but for schedule='constant'; got "
                f"{self.decay_epochs} for {self.schedule!r}. Change one of the two."
            )
        for name in (
            "weight_decay",
            "decay_epochs",
            "warmup_epochs",
            "clip_norm",
            "devices",
            "seed",
        ):
            if getattr(self, name) < 0:
                raise ValueError(
                    f"config.train.{name} must not be negative; got {getattr(self, name)}. Use 0."
                )
        _check_steps("train", self)
        if not 0 <= self.ema_decay < 1:
            raise ValueError(
                f"config.train.ema_decay must be in [0, 1); got {self.ema_decay}. Use 0 for none."
            )
        cadences = "log_every", "validate_every", "checkpoint_every"
        for name in (*cadences, "validation_pairs", "accumulate"):
            value = getattr(self, name)
            if value < 1:
                raise ValueError(
                    f"config.train.{name} must be at least 1; got {value}. Use 1 or more."
                )
            if name.endswith("_every") and value % self.log_every:
                raise ValueError(
                    f"config.train.{name} must be a multiple of config.train.log_every = "
                    f"{self.log_every}; got {value}. Change one of the two."
                )


@dataclasses.dataclass(frozen=True)
class RunConfig:
    """All of a configuration: ``model`` and ``stages`` (by name) are the method's records."""

    method: str
    model: Any
    data: DataConfig
    protocol: Protocol
    train: TrainConfig
    stages: Mapping[str, Any]

    def __post_init__(self) -> None:
        """Refuse a precision that the method does not know."""
        if self.method != DEFAULT_METHOD and self.train.precision != "float32":
            raise ValueError(
                f"config.train.precision must be 'float32' but for the method {DEFAULT_METHOD}; "
                f"got {self.train.precision!r} for {self.method}. Use 'float32'."
            )

    def with_stage(self, name: str, **changes: Any) -> RunConfig:
        """The same with fields of one stage's record changed."""
        stage = dataclasses.replace(self.stages[name], **changes)
        return dataclasses.replace(self, stages={**self.stages, name: stage})


def check_stage(name: str, stage: Any) -> None:
    """Refuse a stage of nothing."""
    if stage.epochs <= 0:
        raise ValueError(f"config.{name}.epochs must be positive; got {stage.epochs}. Use 1.")
    _check_steps(name, stage)


def _check_steps(name: str, section: Any) -> None:
    if not 1 <= section.batch_size <= LARGEST_BATCH:
        raise ValueError(
            f"config.{name}.batch_size must be from 1 to {LARGEST_BATCH}; got "
            f"{section.batch_size}. Use 8."
        )
    if section.learning_rate <= 0:
        raise ValueError(
            f"config.{name}.learning_rate must be positive; got {section.learning_rate}. Use 1e-4."
        )
