"""Training in stages: a pure step, and the loop that keeps its results.

Stage "overlap" trains the overlap network, stage "registration" the registration network behind
it, frozen and deterministic; stage "joint" may train both further. Everything random comes from
``fold_in(key, step)``: a run that was killed and started again ends with the same parameters, bit
for bit on a CPU.
"""

from __future__ import annotations

import dataclasses
import functools
import math
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import flax.struct
import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from dbdnet_jax.checkpoint import Checkpoints, write_stage
from dbdnet_jax.optimizer import make_optimizer, make_schedule
from dbdnet_jax.parallel import mean_over_pairs, on_all_devices
from dbdnet_jax.runlog import RunLog
from dbdnet_jax.settings import Settings, TrainSettings, stage_record
from dbdnet_jax.sources import Source
from dbdnet_jax.stages import LossFunction, Task, make_task
from dbdnet_jax.types import Pair


@flax.struct.dataclass
class TrainState:
    """Everything that a step changes: ``step`` counts those taken, as an int32 scalar.

    ``ema`` is None where no moving average is kept.
    """

    step: Any
    params: Any
    opt_state: Any
    ema: Any


class StepMetrics(NamedTuple):
    """What a step says of itself: means over its pairs, before the update."""

    loss: Float[Array, ""]
    terms: Any
    gradient_norm: Float[Array, ""]
    finite: Bool[Array, ""]


def init_state(
    trainable: Any, optimizer: optax.GradientTransformation, *, ema_decay: float = 0.0
) -> TrainState:
    """The state before the first step."""
    ema = jax.tree.map(jnp.copy, trainable) if ema_decay else None
    return TrainState(jnp.zeros((), jnp.int32), trainable, optimizer.init(trainable), ema)


def train_step(
    state: TrainState,
    frozen: Any,
    key: PRNGKeyArray,
    arrays: Any,
    *,
    draw: Callable[[PRNGKeyArray, Int[Array, ""], Any], Pair],
    loss: LossFunction,
    optimizer: optax.GradientTransformation,
    batch_size: int,
    ema_decay: float = 0.0,
) -> tuple[TrainState, StepMetrics]:
    """One step on ``batch_size`` fresh pairs; pure, so its result depends on the arguments only.

    Where the loss, a term or the gradient is not finite the state comes back as it was, step
    count included: the same step would be taken again, and fail again, until the caller stops.
    """

    def one(i, params, frozen, step, key, arrays):
        draw_key, loss_key = jax.random.split(jax.random.fold_in(key, i))
        pair = draw(draw_key, step * batch_size + i, arrays)
        return jax.value_and_grad(loss, has_aux=True)(params, frozen, pair, loss_key)

    step_key = jax.random.fold_in(key, state.step)
    (total, terms), gradient = mean_over_pairs(
        one, batch_size, state.params, frozen, state.step, step_key, arrays
    )
    norm = optax.tree.norm(gradient)
    finite = jnp.isfinite(jnp.stack([total, norm, *jax.tree.leaves(terms)])).all()

    updates, opt_state = optimizer.update(gradient, state.opt_state, state.params)
    params = optax.apply_updates(state.params, updates)
    ema = state.ema
    if ema_decay:
        # The first weights are noise: a short memory at first forgets them.
        decay = jnp.minimum(ema_decay, (1 + state.step) / (10 + state.step))
        ema = jax.tree.map(lambda old, new: old + (1 - decay) * (new - old), ema, params)
    moved = TrainState(state.step + 1, params, opt_state, ema)
    state = jax.tree.map(lambda new, old: jnp.where(finite, new, old), moved, state)
    return state, StepMetrics(total, terms, norm, finite)


def fit(settings: Settings, stage: str, run_dir: str | Path, source: Source) -> None:
    """Train one stage in ``run_dir/stage``, or go on where a killed run left it.

    The results are there: checkpoints, ``train.csv``, ``validation.csv`` and TensorBoard events.
    A finished stage returns at once.

    Raises:
        CheckpointError: a damaged checkpoint, or a folder of another configuration.
        FloatingPointError: a loss term or a gradient is not finite; says which, at which step, and
            where the last good state is.
    """
    folder = Path(run_dir) / stage
    task = make_task(settings, stage, run_dir)
    write_stage(folder, stage_record(settings, stage))
    part = getattr(settings, stage)
    run_task(
        task,
        source,
        folder,
        settings.train,
        epochs=part.epochs,
        batch_size=part.batch_size,
        learning_rate=part.learning_rate,
    )


def run_task(
    task: Task,
    source: Source,
    folder: Path,
    train: TrainSettings,
    *,
    epochs: float,
    batch_size: int,
    learning_rate: float,
) -> None:
    """`fit` for any task."""
    epoch_steps = max(1, source.epoch_pairs // batch_size)
    total = max(1, round(epochs * epoch_steps))
    schedule = make_schedule(
        learning_rate,
        total,
        round(train.warmup_epochs * epoch_steps),
        round(train.decay_epochs * epoch_steps),
    )
    optimizer = make_optimizer(
        schedule,
        weight_decay=train.weight_decay,
        clip_norm=train.clip_norm,
        networks=task.networks,
    )
    with Checkpoints(folder) as checkpoints:
        state = init_state(task.trainable, optimizer, ema_decay=train.ema_decay)
        start = checkpoints.latest_step() or 0
        if start:
            state = checkpoints.restore(start, state)
        if start >= total:
            return
        step = functools.partial(
            train_step,
            draw=source.draw,
            loss=task.loss,
            optimizer=optimizer,
            batch_size=batch_size,
            ema_decay=train.ema_decay,
        )
        with RunLog(folder, start) as log:
            loop = _Loop(task, source, train, checkpoints, log, schedule, batch_size, total)
            loop.run(on_all_devices(state), start, jax.jit(step, donate_argnums=0))


@dataclasses.dataclass
class _Loop:
    """What stays the same from step to step of one stage."""

    task: Task
    source: Source
    train: TrainSettings
    checkpoints: Checkpoints
    log: RunLog
    schedule: optax.Schedule
    batch_size: int
    total: int

    def run(self, state: TrainState, start: int, step: Callable[..., Any]) -> None:
        """Take steps ``start`` + 1 to ``total``; log, validate and save on the way."""
        train = self.train
        frozen, pairs, key = on_all_devices(
            (self.task.frozen, self.source.validation, jax.random.key(train.seed))
        )
        arrays = _on_all_devices(self.source.arrays(start))
        validate = jax.jit(self._mean_validation)
        window: list[dict[str, float]] = []
        waiting: list[StepMetrics] = []
        if self.task.networks and not start:
            # They are trained already, and what follows may be worse.
            self._validate_and_save(0, state, validate, frozen, pairs)
        with self._bar(start) as bar:
            for done in range(start + 1, self.total + 1):
                state, metrics = step(state, frozen, key, next(arrays))
                waiting.append(metrics)
                at_row = done % train.log_every == 0 or done == self.total
                # One step late, so that the device always has the next one to work on. A bad step
                # gives back the state it was given, so the one after it did too.
                while len(waiting) > (0 if at_row else 1):
                    window.append(_scalars(jax.device_get(waiting.pop(0))))
                    self._require_finite(window[-1], state, "in the step")
                    bar.update(self.batch_size)
                if not at_row:
                    continue
                bar.set_postfix(self._write_row(done, window))
                window = []
                if done % train.validate_every == 0 or done == self.total:
                    self._validate_and_save(done, state, validate, frozen, pairs)
                elif done % train.checkpoint_every == 0:
                    self.checkpoints.save(done, state)

    def _bar(self, start: int) -> Any:
        from tqdm import tqdm

        return tqdm(
            desc=self.checkpoints.folder.parent.name,
            total=self.total * self.batch_size,
            initial=start * self.batch_size,
            unit="pair",
            # A log file gets a line now and then, not ten a second.
            mininterval=0.5 if sys.stderr.isatty() else 30.0,
        )

    def _write_row(self, done: int, window: list[dict[str, float]]) -> dict[str, str]:
        """Log the means over the steps since the last row; returns what the bar shows."""
        row = {name: sum(step[name] for step in window) / len(window) for name in window[0]}
        row["learning_rate"] = float(self.schedule(done - 1))
        self.log.write("train", done, row)
        return {"loss": f"{row['loss']:.4f}"}

    def _validate_and_save(
        self, done: int, state: TrainState, validate: Callable[..., Any], frozen: Any, pairs: Pair
    ) -> None:
        means = validate(state.params if state.ema is None else state.ema, frozen, pairs)
        row = {name: float(value) for name, value in means.items()}
        self._require_finite(row, state, "in the validation")
        self.log.write("validation", done, row)
        self.checkpoints.save(done, state, row["error"])

    def _mean_validation(self, weights: Any, frozen: Any, pairs: Pair) -> dict[str, Array]:
        def one(i, weights, frozen, pairs):
            pair = jax.tree.map(lambda leaf: leaf[i], pairs)
            return self.task.validate(weights, frozen, pair)

        count = pairs.source.count.shape[0]
        return mean_over_pairs(one, count, weights, frozen, pairs)

    def _require_finite(self, scalars: dict[str, float], state: TrainState, where: str) -> None:
        """Stop at the first value that is not finite, with the last good state on disk."""
        bad = [name for name, value in scalars.items() if not math.isfinite(value)]
        if not bad:
            return
        good, folder = int(state.step), self.checkpoints.folder
        if good and self.checkpoints.latest_step() != good:
            self.checkpoints.save(good, state)
        raise FloatingPointError(
            f"every loss term and gradient must be finite; '{bad[0]}' is {scalars[bad[0]]} {where} "
            f"after step {good} of {folder.parent}. The last good state is kept: "
            f"{folder / str(good) if good else 'none, it was the first step'}. Look for NaN or "
            "huge values in the data, mend it and start the same command again; if the data is "
            "sound, train anew with a lower learning rate or --config.train.clip_norm=1.0."
        )


def _on_all_devices(arrays: Iterator[Any]) -> Iterator[Any]:
    """Each step's arrays where they are needed; what stays the same is moved there once."""
    held = placed = None
    for these in arrays:
        if these is not held:
            held, placed = these, on_all_devices(these)
        yield placed


def _scalars(metrics: StepMetrics) -> dict[str, float]:
    """The numbers of a step by name, the terms before the loss they sum to."""
    terms = {name: float(value) for name, value in metrics.terms._asdict().items()}
    return terms | {"loss": float(metrics.loss), "gradient_norm": float(metrics.gradient_norm)}
