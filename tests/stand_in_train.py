"""Runs train.py with a loss that compiles in a second; all else, the parameters too, is as it is.

python -m tests.stand_in_train --config=configs/cad.py ...
"""

import runpy
import sys
from typing import NamedTuple

import jax
import jax.numpy as jnp

from dbdnet_jax.training import table
from dbdnet_jax.training.start import initial_params
from dbdnet_jax.training.task import Task


class Terms(NamedTuple):
    """The only term of the loss."""

    fit: jax.Array


def loss(trainable, frozen, pair, key):
    """Draws every parameter to a number that depends on the pair and on the key."""
    aim = jnp.mean(pair.target.points) + 1e-3 * jax.random.normal(key)
    fit = sum(jnp.mean((leaf - aim) ** 2) for leaf in jax.tree.leaves(trainable))
    return fit, Terms(fit)


def validate(trainable, frozen, pair):
    """The loss without its noise is the error."""
    aim = jnp.mean(pair.target.points)
    return {"error": sum(jnp.mean((leaf - aim) ** 2) for leaf in jax.tree.leaves(trainable))}


def task(config, run_dir):
    """The overlap network's parameters, and the loss above."""
    return Task(initial_params(config).overlap, None, loss, validate)


if __name__ == "__main__":
    stages = table.STAGES["dbdnet"]
    stages["overlap"] = stages["overlap"]._replace(make_task=task)
    sys.argv[0] = "train.py"
    runpy.run_path("train.py", run_name="__main__")
