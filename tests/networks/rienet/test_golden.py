"""RIENet against what its released code computed, in float64."""

import functools

import jax
import pytest

from dbdnet_jax.networks.batch_norm import fold, split_batch_stats
from dbdnet_jax.networks.rienet.network import RIENet, RIENetConfig, pose_of
from dbdnet_jax.networks.rienet.released import entries
from dbdnet_jax.training.rienet import RIENetStage, total_terms, turn_losses
from tests.peers import (
    EVALUATION,
    GRADIENT,
    TRAINING,
    assert_gradients,
    assert_near,
    assert_running,
    bundle,
    clouds,
    filled,
)

pytestmark = pytest.mark.usefixtures("x64")
LOSSES = ("global_alignment", "neighbourhood", "spatial")


@functools.cache
def given():
    arrays = bundle("rienet")
    sizes = {name: int(arrays[f"config/{name}"]) for name in ("k1", "k2", "dim", "n_keypoints")}
    config = RIENetConfig(k1=sizes["k1"], k2=sizes["k2"], width=sizes["dim"])
    pair = clouds(arrays["source"]), clouds(arrays["target"])
    stage = RIENetStage(keypoints=sizes["n_keypoints"])
    return filled("rienet", entries(config), config), pair, stage


def losses(turns, index, pair, config, stage):
    terms = [turn_losses(turn, index, *pair, stage=stage, k2=config.k2) for turn in turns]
    return sum(total_terms(terms)), terms


def evaluated(network, config, stage, pair):
    turns, index = RIENet(config).apply({"params": fold(network)}, *pair)
    total, terms = losses(turns, index, pair, config, stage)
    return total, (terms, turns)


def trained(trainable, config, stage, pair, batch_stats):
    (turns, index), changed = RIENet(config).apply(
        {"params": trainable, "batch_stats": batch_stats},
        *pair,
        training=True,
        mutable=["batch_stats"],
    )
    total, terms = losses(turns, index, pair, config, stage)
    return total, (terms, turns, changed["batch_stats"])


def check_turns(total, terms, turns, mode, relative):
    arrays = bundle("rienet")
    for i, (turn, term) in enumerate(zip(turns, terms, strict=True)):
        prefix = f"{mode}/iteration{i}"
        assert_near(turn.increment.rotation, arrays[f"{prefix}/rotation"], relative)
        assert_near(turn.increment.translation, arrays[f"{prefix}/translation"], relative)
        assert_near(turn.confidence, arrays[f"{prefix}/weight"], relative)
        correspondence = turn.correspondence.swapaxes(1, 2)
        assert_near(correspondence, arrays[f"{prefix}/source_correspondence"], relative)
        for loss, value in zip(LOSSES, term, strict=True):
            assert_near(value, arrays[f"{prefix}/loss_{loss}"], relative)
    pose = pose_of(turns)
    assert_near(pose.rotation, arrays[f"{mode}/rotation"], relative)
    assert_near(pose.translation, arrays[f"{mode}/translation"], relative)
    assert_near(total, arrays[f"{mode}/loss_total"], relative)
    for loss, value in zip(LOSSES, total_terms(terms), strict=True):
        assert_near(value, arrays[f"{mode}/loss_{loss}"], relative)


def test_evaluation():
    params, pair, stage = given()
    gradient, (terms, turns) = jax.jit(jax.grad(evaluated, has_aux=True), static_argnums=(1, 2))(
        params.networks["rienet"], params.config, stage, pair
    )
    arrays = bundle("rienet")
    total = sum(total_terms(terms))
    check_turns(total, terms, turns, "eval", EVALUATION)
    first = turns[0]
    for name, feature in zip(("source", "target"), first.features, strict=True):
        stored = arrays[f"eval/iteration0/embedding_{name}"]
        assert_near(feature.swapaxes(1, 2), stored, EVALUATION)
    for name, actual in first.maps._asdict().items():
        assert_near(actual, arrays[f"eval/iteration0/{name}"], EVALUATION)
    assert_gradients({"rienet": gradient}, entries(params.config), arrays, "eval", GRADIENT)


def test_training():
    params, pair, stage = given()
    trainable, batch_stats = split_batch_stats(params.networks["rienet"])
    (total, (terms, turns, running)), gradient = jax.jit(
        jax.value_and_grad(trained, has_aux=True), static_argnums=(1, 2)
    )(trainable, params.config, stage, pair, batch_stats)
    check_turns(total, terms, turns, "train", TRAINING)
    names, arrays = entries(params.config), bundle("rienet")
    assert_gradients({"rienet": gradient}, names, arrays, "train", GRADIENT)
    assert_running({"rienet": running}, names, arrays, "train", TRAINING)
