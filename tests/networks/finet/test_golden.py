"""FINet against what its released code computed, in float64.

Nothing but points and pose passes from one turn to the next, so each turn's gradients are those of
its own terms. The first turn alone is compared, all four (142 million parameters) are
compared where the environment says PARITY=all.
"""

import functools
import os

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dbdnet_jax.networks.batch_norm import fold, split_batch_stats
from dbdnet_jax.networks.finet.network import SENSITIVE, FINet, FINetConfig, shapes
from dbdnet_jax.training.finet import (
    DROPOUT_WEIGHT,
    DROPPED,
    FINetStage,
    dropout_losses,
    sensitivity_losses,
    turn_losses,
)
from dbdnet_jax.types import Rigid
from tests.networks.finet.names import entries
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
ALL = os.environ.get("PARITY") == "all"
TURNS = 4 if ALL else 1
# Batch norms over four nearly equal pooled vectors multiply the rounding, turn by turn.
TRAINING = (1e-9, 1e-8, 1e-6, 1e-4)


@functools.cache
def given():
    arrays = bundle("finet")
    pair = clouds(arrays["source"]), clouds(arrays["target"])
    truth = Rigid(jnp.asarray(arrays["rotation_gt"]), jnp.asarray(arrays["translation_gt"]))
    config = FINetConfig(turns=TURNS, released=True)
    return filled("finet", entries(config), config), pair, truth


def losses(turns, truth, margin):
    stage = FINetStage(margin=margin)
    terms = [turn_losses(turn, i, truth, stage) for i, turn in enumerate(turns)]
    return sum(sum(term) for term in terms), (terms, turns)


def evaluated(network, config, pair, truth, margin):
    turns = FINet(config).apply({"params": fold(network)}, *pair, sensitive=True)
    return losses(turns, truth, margin)


def trained(trainable, config, pair, truth, keep, batch_stats):
    turns, changed = FINet(config).apply(
        {"params": trainable, "batch_stats": batch_stats},
        *pair,
        keep,
        training=True,
        sensitive=True,
        mutable=["batch_stats"],
    )
    total, aux = losses(turns, truth, 0.01)
    return total, (*aux, changed["batch_stats"])


def stacked(feature):
    """(pairs, 2, d): the bundle has all sources, then all targets."""
    return jnp.concatenate([feature[:, 0], feature[:, 1]])


def check_turn(turn, terms, mode, i, relative):
    arrays, prefix = bundle("finet"), f"{mode}/iteration{i}"
    near = functools.partial(assert_near, relative=relative)
    near(turn.increment.quaternion, arrays[f"{prefix}/quaternion_increment"])
    near(turn.increment.translation, arrays[f"{prefix}/translation_increment"])
    near(jnp.concatenate(turn.pose, -1), arrays[f"{prefix}/pose"])
    near(stacked(turn.centres), arrays[f"{prefix}/centre"])
    rigid = turn.pose.rigid
    whole = jnp.concatenate([rigid.rotation, rigid.translation[..., None]], -1)
    near(whole, arrays[f"{prefix}/transform"])
    near(terms.rotation, arrays[f"{mode}/loss/quat_{i}"])
    near(terms.translation, arrays[f"{mode}/loss/translate_{i}"])
    # The stored features may be of the turns at both ends only.
    kinds = {"encoder": turn.features, "fusion": turn.fused}
    if turn.dropped is not None:
        kinds["dropout"] = turn.dropped
    for kind, features in kinds.items():
        for letter, feature in zip("Rt", features, strict=True):
            name = f"{prefix}/{kind}_{letter}"
            if kind == "dropout":
                name = f"{prefix}/encoder_{letter}_dropout"
            if name in arrays:
                near(stacked(feature), arrays[name])
    if f"{prefix}/encoder_R_rotated" in arrays:
        near(turn.rotated.rotation[:, 0], arrays[f"{prefix}/encoder_R_rotated"])
        near(turn.translated.translation[:, 0], arrays[f"{prefix}/encoder_t_translated"])
    for branch, letter in enumerate("Rt"):
        for c, cloud in enumerate(("src", "ref")):
            actual = DROPOUT_WEIGHT * dropout_losses(turn)[branch, c]
            near(actual, arrays[f"{mode}/loss/{cloud}_{letter}_feats_dropout_{i}"])


def check_sensitivity(turn, mode, margin, i, relative):
    arrays = bundle("finet")
    for letter, loss in zip("Rt", sensitivity_losses(turn, margin), strict=True):
        expected = arrays[f"{mode}/loss/{letter}_feats_triplet_{i}"]
        assert_near(FINetStage().sensitivity * loss, expected, relative)


@pytest.mark.parametrize(("mode", "margin"), [("eval", 0.01), ("eval_margin1", 1.0)])
def test_evaluation(mode, margin):
    params, pair, truth = given()
    gradient, (terms, turns) = jax.jit(jax.grad(evaluated, has_aux=True), static_argnums=(1, 4))(
        params.networks["finet"], params.config, pair, truth, margin
    )
    arrays = bundle("finet")
    for i, (turn, term) in enumerate(zip(turns, terms, strict=True)):
        if mode == "eval":
            check_turn(turn, term, "eval", i, EVALUATION)
        if i < SENSITIVE:
            check_sensitivity(turn, mode, margin, i, EVALUATION)
    if ALL:
        total = sum(sum(term) for term in terms)
        assert_near(total, arrays[f"{mode}/loss/total"], EVALUATION)
    names = entries(params.config)
    assert_gradients({"finet": gradient}, names, of_turns(arrays), mode, GRADIENT)


def test_training():
    params, pair, truth = given()
    trainable, batch_stats = split_batch_stats(params.networks["finet"])
    arrays = bundle("finet")
    uniform = arrays["dropout_uniform"][::3, :, 0]  # of the passes over unmoved sources
    sources, targets = np.split(uniform[:TURNS] > DROPPED, 2, axis=1)
    keep = jnp.asarray(np.concatenate([sources, targets], axis=-1))
    (total, (terms, turns, running)), gradient = jax.jit(
        jax.value_and_grad(trained, has_aux=True), static_argnums=1
    )(trainable, params.config, pair, truth, keep, batch_stats)
    for i, (turn, term) in enumerate(zip(turns, terms, strict=True)):
        check_turn(turn, term, "train", i, TRAINING[i])
        if i < SENSITIVE:
            check_sensitivity(turn, "train", 0.01, i, TRAINING[i])
    names, arrays = entries(params.config), of_turns(arrays)
    if ALL:
        assert_near(total, arrays["train/loss/total"], TRAINING[-1])
    relative = TRAINING[TURNS - 1]
    assert_gradients({"finet": gradient}, names, arrays, "train", relative)
    assert_running({"finet": running}, names, arrays, "train", relative)


def of_turns(arrays):
    """Without gradients and averages of turns that are not compared."""
    parts = ("grad_norm/", "after_one_forward/")
    later = [f"{part}.{i}." for part in ("encoder", "fusion", "regression") for i in range(4)]
    later = [name for name in later if int(name.split(".")[1]) >= TURNS]
    return {
        k: x
        for k, x in arrays.items()
        if not (any(part in k for part in parts) and any(name in k for name in later))
    }


def test_shapes_are_those_of_the_released_code():
    found = shapes(FINetConfig())
    assert_shapes(entries(FINetConfig()), found)
    parameters = (k for k in found if not k.endswith(("/mean", "/variance")))
    assert sum(np.prod(found[name]) for name in parameters) == 142_199_324
