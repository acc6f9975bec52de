"""Training in stages: the loop that takes the steps of any task and keeps its results.

Everything random comes from ``fold_in(key, step)``: a run that was killed and started again ends
with the same parameters, bit for bit on a CPU.
"""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import math
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import jax
import optax
from jax.sharding import Mesh
from jaxtyping import Array

from dbdnet_jax.data.training_pairs import PairStream
from dbdnet_jax.training.checkpoint import Checkpoints
from dbdnet_jax.training.config import stage_defaults, stage_record
from dbdnet_jax.training.lock import sole_training
from dbdnet_jax.training.optimizer import make_optimizer, make_schedule
from dbdnet_jax.training.parallel import (
    mean_over_pairs,
    on_all_devices,
    spread_rows,
    training_mesh,
)
from dbdnet_jax.training.preemption import Preempted, stop_requests
from dbdnet_jax.training.run_folder import require_same_run, write_stage
from dbdnet_jax.training.runlog import RunLog
from dbdnet_jax.training.step import StepMetrics, TrainState, init_state, train_step, weights_of
from dbdnet_jax.training.table import STAGES
from dbdnet_jax.training.task import RunConfig, Task, TrainConfig
from dbdnet_jax.types import Pair


def fit(config: RunConfig, stage: str, run_dir: str | Path, stream: PairStream) -> None:
    """Train one stage in ``run_dir/stage``, or go on where a killed run left it.

    The results are there: checkpoints, ``train.csv``, ``validation.csv`` and TensorBoard events.
    A finished stage returns at once.

    Raises:
        CheckpointError: all checkpoints damaged, or a run of another configuration.
        ValueError: devices or parts that cannot share the batch.
        BlockingIOError: another process trains this stage in this folder; says which.
        FloatingPointError: a loss term or a gradient is not finite; says which, at which step, and
            where the last good state is.
        Preempted: SIGTERM, SIGHUP or SIGINT came; the state after the step of then is saved.
    """
    folder = Path(run_dir) / stage
    record = folder, stage_record(config, stage), stage_defaults(config)
    require_same_run(*record)
    task = STAGES[config.method][stage].make_task(config, run_dir)
    part = config.stages[stage]
    run_task(
        task,
        stream,
        folder,
        config.train,
        epochs=part.epochs,
        batch_size=part.batch_size,
        learning_rate=part.learning_rate,
        begin=functools.partial(write_stage, *record),
    )


def run_task(
    task: Task,
    stream: PairStream,
    folder: Path,
    train: TrainConfig,
    *,
    epochs: float,
    batch_size: int,
    learning_rate: float,
    begin: Callable[[], None] = lambda: None,
) -> None:
    """`fit` for any task; ``begin`` is called once nothing stands in the way, under the lock."""
    epoch_steps = max(1, stream.epoch_pairs // batch_size)
    total = max(1, round(epochs * epoch_steps))
    schedule = make_schedule(
        learning_rate,
        total,
        round(train.warmup_epochs * epoch_steps),
        kind=train.schedule,
        milestones=[round(epoch * epoch_steps) for epoch in train.milestones],
        factor=train.factor,
        decay_steps=round(train.decay_epochs * epoch_steps),
    )
    optimizer = make_optimizer(
        schedule,
        weight_decay=train.weight_decay,
        clip_norm=train.clip_norm,
        networks=task.networks,
        kind=train.optimizer,
    )
    mesh = training_mesh(batch_size, train.devices)
    _require_parts(task, batch_size // mesh.size, train.accumulate)
    alone = sole_training(folder) if jax.process_index() == 0 else contextlib.nullcontext()
    with alone, Checkpoints(folder) as checkpoints:
        begin()
        state = init_state(
            task.trainable, optimizer, ema_decay=train.ema_decay, batch_stats=task.batch_stats
        )
        start, state, window = checkpoints.resume(state) or (0, state, [])
        if start >= total:
            return
        step = functools.partial(
            train_step,
            draw=stream.draw,
            loss=task.loss,
            optimizer=optimizer,
            batch_size=batch_size,
            mesh=mesh,
            batched=stream.batched,
            ema_decay=train.ema_decay,
            accumulate=train.accumulate,
            remat=train.remat,
            precision=train.precision,
        )
        with RunLog(folder, start) as log:
            loop = _Loop(task, stream, train, checkpoints, log, schedule, batch_size, total, mesh)
            loop.run(on_all_devices(mesh, state), start, window, jax.jit(step, donate_argnums=0))


@dataclasses.dataclass
class _Loop:
    """What stays the same from step to step of one stage."""

    task: Task
    stream: PairStream
    train: TrainConfig
    checkpoints: Checkpoints
    log: RunLog
    schedule: optax.Schedule
    batch_size: int
    total: int
    mesh: Mesh

    def run(
        self,
        state: TrainState,
        start: int,
        window: list[dict[str, float]],
        step: Callable[..., Any],
    ) -> None:
        """Take steps ``start`` + 1 to ``total``; log, validate and save on the way.

        ``window`` holds the numbers of the steps since the last row of the log.
        """
        train = self.train
        frozen, pairs, key = on_all_devices(
            self.mesh, (self.task.frozen, self.stream.validation, jax.random.key(train.seed))
        )
        place = spread_rows if self.stream.batched else on_all_devices
        arrays = _placed(functools.partial(place, self.mesh), self.stream.arrays(start))
        validate = jax.jit(self._mean_validation)
        waiting: list[StepMetrics] = []
        if self.task.networks and self.checkpoints.latest_step() is None:
            # They are trained already, and what follows may be worse.
            self._validate_and_save(0, state, validate, frozen, pairs)
        with stop_requests() as stop, self._bar(start) as bar:
            for done in range(start + 1, self.total + 1):
                state, metrics = step(state, frozen, key, next(arrays))
                waiting.append(metrics)
                at_row = done % train.log_every == 0 or done == self.total
                stopping = stop.asked(done)
                # One step late, so that the device always has the next one to work on: drawn from
                # the same arrays, after a bad step, it is that step again. A batch is not.
                while len(waiting) > (0 if at_row or stopping or self.stream.batched else 1):
                    window.append(_scalars(jax.device_get(waiting.pop(0))))
                    self._require_finite(window, state, "in the step")
                    bar.update(self.batch_size)
                if at_row:
                    bar.set_postfix(self._write_row(done, window))
                    window = []
                    if done % train.validate_every == 0 or done == self.total:
                        self._validate_and_save(done, state, validate, frozen, pairs)
                    elif done % train.checkpoint_every == 0:
                        self.checkpoints.save(done, state)
                if stopping:
                    self._stop(done, state, window, stopping)
            if stop.name:  # it came while the last of it was saved
                self._stop(self.total, state, [], stop.name)

    def _stop(
        self, done: int, state: TrainState, window: list[dict[str, float]], signal: str
    ) -> None:
        if self.checkpoints.latest_step() != done:
            self.checkpoints.save(done, state, window=window)
        raise Preempted(
            f"Stopped by {signal}; the state after step {done} of {self.total} is saved in "
            f"{self.checkpoints.folder / str(done)}."
        )

    def _bar(self, start: int) -> Any:
        from tqdm import tqdm

        return tqdm(
            desc=self.checkpoints.folder.parent.name,
            total=self.total * self.batch_size,
            disable=jax.process_index() > 0,
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
        means = validate(state, frozen, pairs)
        row = {name: float(value) for name, value in means.items()}
        self._require_finite([row], state, "in the validation")
        self.log.write("validation", done, row)
        self.checkpoints.save(done, state, row["error"])

    def _mean_validation(self, state: TrainState, frozen: Any, pairs: Pair) -> dict[str, Array]:
        def one(i: Array, weights: Any, frozen: Any, pairs: Pair) -> dict[str, Array]:
            pair = jax.tree.map(lambda leaf: leaf[i], pairs)
            return self.task.validate(weights, frozen, pair)

        count = pairs.source.count.shape[0]
        # No more pairs at once than in a step, which fit.
        rounds = math.ceil(count / self.batch_size) * self.train.accumulate
        arguments = weights_of(state), frozen, pairs
        return mean_over_pairs(self.mesh, one, count, *arguments, rounds=rounds)

    def _require_finite(
        self, window: list[dict[str, float]], state: TrainState, where: str
    ) -> None:
        """Stop at the first value that is not finite, with the last good state on disk.

        ``window`` ends with the numbers to look at; those before them are of good steps.
        """
        *before, scalars = window
        bad = [name for name, value in scalars.items() if not math.isfinite(value)]
        if not bad:
            return
        good, folder = int(state.step), self.checkpoints.folder
        if good and self.checkpoints.latest_step() != good:
            self.checkpoints.save(good, state, window=before)
        raise FloatingPointError(
            f"every loss term and gradient must be finite; '{bad[0]}' is {scalars[bad[0]]} {where} "
            f"after step {good} of {folder.parent}. The last good state is kept: "
            f"{folder / str(good) if good else 'none, it was the first step'}. Look for NaN or "
            "huge values in the data, mend it and start the same command again; if the data is "
            "sound, train anew with a lower learning rate or --config.train.clip_norm=1.0."
        )


def _require_parts(task: Task, pairs: int, parts: int) -> None:
    """Refuse to divide a device's ``pairs`` of a step into ``parts`` where that cannot be."""
    if parts > 1 and task.batch_stats is not None:
        raise ValueError(
            "config.train.accumulate must be 1 for a network with batch norms, which are of the "
            f"whole batch; got {parts}. Use 1, and a smaller batch_size."
        )
    if pairs % parts:
        raise ValueError(
            "config.train.accumulate must divide the pairs that a device takes of a step; got "
            f"{parts} for {pairs}. Use {math.gcd(pairs, parts)}, or another batch_size."
        )


def _placed(place: Callable[[Any], Any], arrays: Iterator[Any]) -> Iterator[Any]:
    """Each step's arrays where they are needed; what stays the same is moved there once."""
    held = placed = None
    for these in arrays:
        if these is not held:
            held, placed = these, place(these)
        yield placed


def _scalars(metrics: StepMetrics) -> dict[str, float]:
    """The numbers of a step by name, the terms before the loss they sum to."""
    terms = {name: float(value) for name, value in metrics.terms._asdict().items()}
    return terms | {"loss": float(metrics.loss), "gradient_norm": float(metrics.gradient_norm)}
