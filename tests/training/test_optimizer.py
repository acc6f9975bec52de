"""Rates, Adam and AdamW, and clipping."""

import jax.numpy as jnp
import numpy as np
import optax

from dbdnet_jax.training.optimizer import make_optimizer, make_schedule
from tests.conftest import FLOAT32, assert_close


def test_the_schedule_warms_up_to_the_peak_and_ends_at_zero():
    schedule = make_schedule(0.5, 100, 9)
    rates = np.array([schedule(step) for step in range(101)])
    np.testing.assert_allclose(rates[:10], 0.5 * np.arange(1, 11) / 10, rtol=1e-6)
    cosine = 0.25 * (1 + np.cos(np.pi * np.arange(92) / 91))
    np.testing.assert_allclose(rates[9:], cosine, atol=1e-7)
    for steps, warmup in ((1, 0), (1, 5), (2, 5), (10, 0)):
        rates = [float(make_schedule(0.5, steps, warmup)(step)) for step in range(steps)]
        assert all(0 < rate <= 0.5 for rate in rates)


def test_steps_and_constant_rates_and_their_warm_up():
    schedule = make_schedule(0.5, 100, 0, kind="steps", milestones=[10, 20], factor=0.1)
    found = [float(schedule(step)) for step in (0, 9, 10, 19, 20, 99)]
    np.testing.assert_allclose(found, [0.5, 0.5, 0.05, 0.05, 0.005, 0.005], rtol=1e-6)
    schedule = make_schedule(0.5, 100, 4, kind="constant")
    found = [float(schedule(step)) for step in (0, 3, 4, 99)]
    np.testing.assert_allclose(found, [0.1, 0.4, 0.5, 0.5], rtol=1e-6)


def test_adam_adds_the_decay_to_the_gradient():
    params, gradient = {"x": jnp.asarray([2.0, -4.0])}, {"x": jnp.asarray([1.0, 1.0])}
    optimizer = make_optimizer(optax.constant_schedule(1e-3), weight_decay=0.5, kind="adam")
    _, state = optimizer.update(gradient, optimizer.init(params), params)
    moment = optax.tree_utils.tree_get(state, "mu")["x"]
    assert_close(moment, 0.1 * np.array([2.0, -1.0]), FLOAT32)


def test_clipping_bounds_the_norm_of_the_gradient():
    params = {"x": jnp.zeros(4)}
    gradient = {"x": jnp.asarray([30.0, 40.0, 0.0, 0.0])}
    for clip_norm, mu in ((0.0, 5.0), (1.0, 0.1)):  # AdamW's first moment: a tenth of it
        optimizer = make_optimizer(
            optax.constant_schedule(1e-3), weight_decay=0.0, clip_norm=clip_norm
        )
        _, state = optimizer.update(gradient, optimizer.init(params), params)
        moment = optax.tree_utils.tree_get(state, "mu")["x"]
        assert_close(jnp.linalg.norm(moment), mu, FLOAT32)


def test_each_network_is_clipped_by_its_own_norm():
    names = ("a", "b")
    params = {name: {"x": jnp.zeros(2)} for name in names}
    gradient = {"a": {"x": jnp.asarray([30.0, 40.0])}, "b": {"x": jnp.asarray([0.3, 0.4])}}
    optimizer = make_optimizer(
        optax.constant_schedule(1e-3), weight_decay=0.0, clip_norm=1.0, networks=names
    )
    _, state = optimizer.update(gradient, optimizer.init(params), params)
    moments = optax.tree_utils.tree_get(state, "mu")
    assert_close(jnp.linalg.norm(moments["a"]["x"]), 0.1, FLOAT32)  # a tenth of the limit
    assert_close(jnp.linalg.norm(moments["b"]["x"]), 0.05, FLOAT32)  # a tenth of its own
