"""A training task that compiles in a second: the loop, the checkpoints and the log do not care."""

from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from ml_collections import ConfigDict

from dbdnet_jax.data.pairs import Protocol
from dbdnet_jax.data.shapes import Shapes
from dbdnet_jax.data.training_pairs import PairStream, pairs_of_shapes
from dbdnet_jax.training.loop import run_task
from dbdnet_jax.training.task import Task, TrainConfig

PROTOCOL = Protocol(points=24, keep=0.5)
EPOCHS, BATCH, RATE = 6.0, 4, 0.1  # 12 steps
TRAIN = TrainConfig(
    start="",
    seed=5,
    batch_size=BATCH,
    learning_rate=RATE,
    weight_decay=1e-4,
    warmup_epochs=1.0,
    clip_norm=1.0,
    ema_decay=0.9,
    log_every=1,
    validate_every=4,
    checkpoint_every=2,
    validation_pairs=3,
    devices=0,
)


class Terms(NamedTuple):
    """The terms of the stand-in's loss."""

    fit: jax.Array
    size: jax.Array


def six_steps(config: ConfigDict) -> None:
    """Six steps of two pairs of 64 points in three epochs of four shapes, with rows of the log."""
    config.protocol.points = 64
    config.train.batch_size = 2
    config.train.learning_rate = 3e-3
    config.train.warmup_epochs = 0.0
    config.train.ema_decay = 0.0
    config.train.log_every = 2
    config.train.checkpoint_every = 2
    config.train.validate_every = 6
    config.train.validation_pairs = 2


def shapes(count: int = 8, points: int = 32, seed: int = 0) -> Shapes:
    """Random clouds as shapes."""
    rng = np.random.default_rng(seed)
    text = np.full(count, "")
    return Shapes(
        rng.uniform(-1, 1, (count, points, 3)).astype(np.float32),
        np.zeros((count, points, 3), np.float32),
        *(text,) * 8,
    )


def source(train: Shapes | None = None) -> PairStream:
    """Pairs of the random shapes."""
    return pairs_of_shapes(
        shapes() if train is None else train,
        shapes(2, seed=1),
        PROTOCOL,
        seed=TRAIN.seed,
        validation_pairs=TRAIN.validation_pairs,
    )


def loss(trainable, frozen, pair, key):
    """Learn to repeat the target's centre, seen with a little noise from the key."""
    centre = jnp.mean(pair.target.points, axis=0)
    seen = centre + 1e-3 * jax.random.normal(key, (3,))
    fit = jnp.mean((seen @ trainable["matrix"] + trainable["offset"] - centre) ** 2)
    terms = Terms(fit, 1e-3 * jnp.sum(trainable["matrix"] ** 2))
    return terms.fit + terms.size, terms


def validate(trainable, frozen, pair):
    """The loss without its noise is the error."""
    return {"error": loss(trainable, frozen, pair, jax.random.key(0))[0]}


def task() -> Task:
    """The stand-in for a stage."""
    return Task({"matrix": 0.1 * jnp.ones((3, 3)), "offset": jnp.ones(3)}, None, loss, validate)


def train(folder: Path, pairs: PairStream | None = None, config: TrainConfig = TRAIN) -> None:
    """All 12 steps, or those that are left."""
    run_task(
        task(),
        source() if pairs is None else pairs,
        folder,
        config,
        epochs=EPOCHS,
        batch_size=BATCH,
        learning_rate=RATE,
    )
