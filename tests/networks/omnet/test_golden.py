"""OMNet against what its released code computed, in float64."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dbdnet_jax.networks.batch_norm import fold, split_batch_stats
from dbdnet_jax.networks.omnet.network import OMNet, OMNetConfig, shapes
from dbdnet_jax.training.omnet import labels, turn_losses
from dbdnet_jax.types import Rigid
from tests.networks.omnet.names import entries
from tests.peers import (
    EVALUATION,
    GRADIENT,
    assert_gradients,
    assert_near,
    assert_running,
    assert_shapes,
    bundle,
    clouds,
    filled,
)

pytestmark = pytest.mark.usefixtures("x64")
RADIUS = 0.1
CLOUDS = ("source", "target")
# Batch norms over four nearly equal pooled vectors multiply the rounding, turn by turn.
TRAINING = (1e-9, 1e-8, 1e-6, 1e-4)


@functools.cache
def given():
    arrays = bundle("omnet")
    pair = clouds(arrays["source"]), clouds(arrays["target"])
    truth = Rigid(jnp.asarray(arrays["rotation_gt"]), jnp.asarray(arrays["translation_gt"]))
    config = OMNetConfig()
    return filled("omnet", entries(config), config), pair, truth


def losses(turns, pair, truth):
    terms = [turn_losses(turn, *pair, truth, RADIUS) for turn in turns]
    return sum(sum(term) for term in terms), (terms, turns)


def evaluated(network, config, pair, truth):
    turns = OMNet(config).apply({"params": fold(network)}, *pair)
    return losses(turns, pair, truth)


def trained(trainable, config, pair, truth, batch_stats):
    turns, changed = OMNet(config).apply(
        {"params": trainable, "batch_stats": batch_stats},
        *pair,
        training=True,
        mutable=["batch_stats"],
    )
    total, aux = losses(turns, pair, truth)
    return total, (*aux, changed["batch_stats"])


def check_turn(turn, terms, pair, truth, mode, i, relative):
    arrays, prefix = bundle("omnet"), f"{mode}/iteration{i}"
    near = functools.partial(assert_near, relative=relative)
    near(jnp.concatenate(turn.increment, -1), arrays[f"{prefix}/pose_increment"])
    near(jnp.concatenate(turn.pose, -1), arrays[f"{prefix}/pose"])
    rigid = turn.pose.rigid
    whole = jnp.concatenate([rigid.rotation, rigid.translation[..., None]], -1)
    near(whole, arrays[f"{prefix}/transform"])
    near(turn.regressed, arrays[f"{prefix}/regression_input"])
    overlaps = labels(*pair, truth, turn.masks, RADIUS)
    for c, cloud in enumerate(CLOUDS):
        near(turn.logits[c].swapaxes(1, 2), arrays[f"{prefix}/class_logits_{cloud}"])
        near(turn.pooled[c], arrays[f"{prefix}/global_{cloud}"])
        label = arrays[f"{prefix}/class_gt_{cloud}"]
        np.testing.assert_array_equal(overlaps[c][: len(label)], label > 0.5)
        mask = arrays[f"{prefix}/predicted_mask_{cloud}"]
        np.testing.assert_array_equal(turn.logits[c].argmax(-1)[: len(mask)], mask)
    if f"{prefix}/fused_source" in arrays:
        near(turn.own[0].swapaxes(1, 2), arrays[f"{prefix}/encoder64_source"])
        near(turn.fused[0].swapaxes(1, 2), arrays[f"{prefix}/fused_source"])
    for name, term in zip(("cls", "quat", "translate"), terms, strict=True):
        near(term, arrays[f"{mode}/loss/{name}_{i}"])


def test_evaluation():
    params, pair, truth = given()
    gradient, (terms, turns) = jax.jit(jax.grad(evaluated, has_aux=True), static_argnums=1)(
        params.networks["omnet"], params.config, pair, truth
    )
    for i, (turn, term) in enumerate(zip(turns, terms, strict=True)):
        check_turn(turn, term, pair, truth, "eval", i, EVALUATION)
    empty = ~turns[3].masks[1].any(axis=-1)  # as turn 2 predicts them
    assert empty.sum() == 2  # targets without a point left go on
    arrays = bundle("omnet")
    assert_near(sum(sum(term) for term in terms), arrays["eval/loss/total"], EVALUATION)
    assert_gradients({"omnet": gradient}, entries(params.config), arrays, "eval", GRADIENT)


def test_training():
    params, pair, truth = given()
    trainable, batch_stats = split_batch_stats(params.networks["omnet"])
    (total, (terms, turns, running)), gradient = jax.jit(
        jax.value_and_grad(trained, has_aux=True), static_argnums=1
    )(trainable, params.config, pair, truth, batch_stats)
    for i, (turn, term) in enumerate(zip(turns, terms, strict=True)):
        check_turn(turn, term, pair, truth, "train", i, TRAINING[i])
    names, arrays = entries(params.config), bundle("omnet")
    assert_near(total, arrays["train/loss/total"], TRAINING[-1])
    assert_gradients({"omnet": gradient}, names, arrays, "train", TRAINING[-1])
    assert_running({"omnet": running}, names, arrays, "train", TRAINING[-1])


def test_shapes_are_those_of_the_released_code():
    found = shapes(OMNetConfig())
    assert_shapes(entries(OMNetConfig()), found)
    parameters = (k for k in found if not k.endswith(("/mean", "/variance")))
    assert sum(np.prod(found[name]) for name in parameters) == 53_658_148
