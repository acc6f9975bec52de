"""Every learned method's stage lowers its loss on a batch, and moves its running averages."""

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from dbdnet_jax.data.config import DataConfig
from dbdnet_jax.data.pairs import Protocol, make_pair
from dbdnet_jax.networks.batch_norm import fold, join_batch_stats
from dbdnet_jax.networks.table import method_of
from dbdnet_jax.training.table import STAGES
from dbdnet_jax.training.task import RunConfig, TrainConfig
from tests.conftest import assert_finite, random_cloud
from tests.networks.small_peers import CONFIGS, SIZE

STEPS = 8


def pairs():
    protocol = Protocol(points=SIZE, keep=1.0, overlap_radius=0.3)
    points = jnp.asarray(random_cloud(0, 4 * SIZE), jnp.float32)
    keys = jax.random.split(jax.random.key(1), 4)
    return jax.vmap(lambda key: make_pair(key, points, points, protocol))(keys)


# Two of them compile for half a minute, and golden outputs hold their losses and gradients too.
LEARNERS = [
    pytest.param(name, marks=pytest.mark.slow) if name in ("finet", "omnet") else name
    for name in CONFIGS
]


@pytest.mark.parametrize("name", LEARNERS)
def test_a_few_steps_lower_the_loss(tmp_path, name):
    method = method_of(CONFIGS[name])
    stages = {stage: line.record() for stage, line in STAGES[method].items()}
    config = RunConfig(method, CONFIGS[name], DataConfig(), Protocol(), TrainConfig(), stages)
    task = STAGES[method][method].make_task(config, tmp_path)
    batch, optimizer = pairs(), optax.adam(3e-3)

    @jax.jit
    def step(trainable, batch_stats, state):
        (loss, (terms, batch_stats)), gradient = jax.value_and_grad(task.loss, has_aux=True)(
            trainable, task.frozen, batch, jax.random.key(2), batch_stats
        )
        updates, state = optimizer.update(gradient, state)
        return optax.apply_updates(trainable, updates), batch_stats, state, loss, terms

    trainable, batch_stats = task.trainable, task.batch_stats
    state, losses = optimizer.init(trainable), []
    for _ in range(STEPS):
        trainable, batch_stats, state, loss, terms = step(trainable, batch_stats, state)
        assert np.isclose(sum(jax.tree.leaves(terms)), loss, rtol=1e-5)
        losses.append(float(loss))
    assert losses[-1] < losses[0]
    moved = jax.tree.map(lambda a, b: bool((a != b).any()), batch_stats, task.batch_stats)
    assert all(jax.tree.leaves(moved))
    one = jax.tree.map(lambda x: x[0], batch)
    weights = fold(join_batch_stats(trainable, batch_stats))
    found = jax.jit(task.validate)(weights, task.frozen, one)
    assert "error" in found
    assert_finite(found)
