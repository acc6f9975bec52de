"""The authors' losses, gradients and training, run in float64, against ours."""

import dataclasses
import functools
from typing import NamedTuple

import jax
import numpy as np
import optax
import pytest

from configs import modelnet
from dbdnet_jax.networks.dbdnet.released import to_released
from dbdnet_jax.networks.params import Params
from dbdnet_jax.training.config import read_config
from dbdnet_jax.training.optimizer import make_optimizer
from dbdnet_jax.training.parallel import on_all_devices, training_mesh
from dbdnet_jax.training.step import init_state, train_step
from dbdnet_jax.training.table import STAGES as TRAINED
from tests.conftest import assert_close
from tests.golden import (
    GRADIENT_NORM,
    IS_WHOLE,
    LOSS,
    MARKS,
    TRAJECTORY,
    below,
    golden,
    pairs,
    released_params,
)
from tools.cut_golden import POINTNET

pytestmark = MARKS


class Trained(NamedTuple):
    """Losses of five steps; the loss terms and the gradient of the first one."""

    losses: np.ndarray
    terms: np.ndarray
    gradient: Params


@functools.cache
def trained(stage: str, numbers: tuple[int, ...]) -> Trained:
    """Train one network on these pairs, as our own training does it."""
    params = released_params()
    # In evaluation mode, as there: no dropout.
    model = dataclasses.replace(params.config, dropout=0.0)
    config = read_config(modelnet.get_config())
    config = dataclasses.replace(config, model=model).with_stage("registration", masks="truth")
    task = TRAINED[config.method][stage].make_task(config, "no folder is needed")
    optimizer = optax.chain(
        optax.trace(decay=0.0),  # keeps the gradient
        make_optimizer(optax.constant_schedule(1e-3), weight_decay=config.train.weight_decay),
    )
    mesh = training_mesh(len(numbers))
    step = jax.jit(
        functools.partial(
            train_step,
            draw=lambda key, i, arrays: jax.tree.map(lambda x: x[i % len(numbers)], arrays),
            loss=task.loss,
            optimizer=optimizer,
            batch_size=len(numbers),
            mesh=mesh,
        )
    )
    state = on_all_devices(mesh, init_state(getattr(params, stage), optimizer))
    key, arrays = on_all_devices(mesh, (jax.random.key(0), pairs(*numbers)))
    states, metrics = [], []
    for _ in range(5):
        state, of_step = step(state, None, key, arrays)
        states.append(state)
        metrics.append(of_step)
    networks = {**params.networks, stage: states[0].opt_state[0].trace}
    gradient = params.replace(networks=networks)
    return Trained(np.stack([m.loss for m in metrics]), np.stack(metrics[0].terms), gradient)


STAGES = pytest.mark.parametrize(
    ("stage", "numbers"), [("overlap", (0, 1)), ("registration", (0,))]
)


@STAGES
def test_the_losses_of_five_steps(stage, numbers):
    losses, expected = trained(stage, numbers).losses, golden()[f"{stage}/loss_trajectory"]
    assert losses.dtype == np.float64
    assert_close(losses[0], expected[0], LOSS)
    assert_close(
        losses[: len(expected)], expected, TRAJECTORY
    )  # the part holds one of registration


def test_each_term_of_the_registration_loss():
    # With the weights of configs/modelnet.py.
    terms = trained("registration", (0,)).terms
    assert_close(terms, golden()["registration/loss_terms_step0"], LOSS)


@STAGES
def test_the_gradient_of_every_parameter(stage, numbers):
    gradient = trained(stage, numbers).gradient
    if stage == "overlap":  # named there as in a checkpoint of that network alone
        gradient = gradient.replace(networks={"overlap": gradient.overlap})
    by_name = to_released(gradient)
    expected = below(f"{stage}/grad_norm/")
    left_out = 0 if IS_WHOLE or stage == "overlap" else len(below(f"state_dict/{POINTNET}"))
    assert len(expected) == len(jax.tree.leaves(getattr(gradient, stage))) - left_out
    found = [np.linalg.norm(by_name[name].astype(np.float64)) for name in expected]
    assert_close(np.stack(found), np.stack(list(expected.values())), GRADIENT_NORM)
