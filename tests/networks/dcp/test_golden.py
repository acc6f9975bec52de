"""DCP against what its released code computed, in float64."""

import functools

import jax
import jax.numpy as jnp
import pytest

from dbdnet_jax.networks.batch_norm import fold, split_batch_stats
from dbdnet_jax.networks.dcp.network import DCP, DCPConfig, match
from dbdnet_jax.networks.dcp.released import entries
from dbdnet_jax.ops import rigid
from dbdnet_jax.training.dcp import pose_loss
from dbdnet_jax.types import Rigid
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
CONFIGS = {"v1": DCPConfig(pointer="identity"), "v2": DCPConfig()}
VERSIONS = pytest.mark.parametrize("version", CONFIGS)


@functools.cache
def given(version):
    config = CONFIGS[version]
    arrays = bundle("dcp")
    pair = clouds(arrays["source"]), clouds(arrays["target"])
    truth = Rigid(jnp.asarray(arrays["rotation_gt"]), jnp.asarray(arrays["translation_gt"]))
    return filled("dcp", entries(config), config), pair, truth


def losses(network, config, pair, truth):
    """Loss of the evaluation mode by the parameters before they are folded."""
    features = DCP(config).apply({"params": fold(network)}, *pair)
    found = match(*features, *pair)
    terms = pose_loss(found.target_from_source, truth)
    return sum(terms), (terms, features, found)


@VERSIONS
def test_evaluation(version):
    params, pair, truth = given(version)
    arrays = {
        k.removeprefix(f"{version}_eval/"): x
        for k, x in bundle("dcp").items()
        if k.startswith(f"{version}_eval/")
    }
    network, config = params.networks["dcp"], params.config
    gradient, (terms, features, found) = jax.jit(jax.grad(losses, has_aux=True), static_argnums=1)(
        network, config, pair, truth
    )
    near = functools.partial(assert_near, relative=EVALUATION)
    pose = found.target_from_source
    back = jax.vmap(rigid.invert)(pose)
    near(pose.rotation, arrays["rotation_ab"])
    near(pose.translation, arrays["translation_ab"])
    near(back.rotation, arrays["rotation_ba"])
    near(back.translation, arrays["translation_ba"])
    near(found.scores, arrays["scores"])
    near(found.correspondence.swapaxes(1, 2), arrays["source_correspondence"])
    near(terms.rotation, arrays["loss_rotation"])
    near(terms.translation, arrays["loss_translation"])
    near(sum(terms), arrays["loss_total"])
    assert_gradients({"dcp": gradient}, entries(config), bundle("dcp"), f"{version}_eval", GRADIENT)


def test_intermediate_features():
    params, pair, _ = given("v2")
    variables = {"params": fold(params.networks["dcp"])}
    arrays = bundle("dcp")

    @functools.partial(jax.jit, static_argnums=0)
    def call(method, *arguments):
        return DCP(params.config).apply(variables, *arguments, method=method)

    features = [call("embed", cloud) for cloud in pair]
    memory = [call("remember", x, cloud) for x, cloud in zip(features, pair, strict=True)]
    added = [call("decode", features[i], pair[i], memory[1 - i], pair[1 - i]) for i in (0, 1)]
    for i, name in enumerate(("source", "target")):
        assert_near(features[i].swapaxes(1, 2), arrays[f"v1_eval/embedding_{name}"], EVALUATION)
        assert_near(memory[i], arrays[f"v2_eval/memory_{name}"], EVALUATION)
        assert_near(added[i], arrays[f"v2_eval/pointer_{name}"], EVALUATION)


def cycle(there: Rigid, back: Rigid):
    """The released code's cycle term, its transpose where none belongs included."""
    turn = back.rotation @ there.rotation - jnp.eye(3)[None]
    moved = jnp.einsum("bji,bj->bi", back.rotation, there.translation) + back.translation
    return jnp.mean(turn**2), jnp.mean(moved**2)


def training_loss(trainable, batch_stats, config, pair, truth):
    features, changed = DCP(config).apply(
        {"params": trainable, "batch_stats": batch_stats},
        *pair,
        training=True,
        mutable=["batch_stats"],
    )
    there, back = match(*features, *pair), match(*features[::-1], *pair[::-1])
    terms = pose_loss(there.target_from_source, truth)
    cycles = cycle(there.target_from_source, back.target_from_source)
    return sum(terms) + 0.1 * sum(cycles), (terms, cycles, there, back, changed)


def test_training_with_the_cycle_term():
    params, pair, truth = given("v2")
    trainable, batch_stats = split_batch_stats(params.networks["dcp"])
    (total, (terms, cycles, there, back, changed)), gradient = jax.jit(
        jax.value_and_grad(training_loss, has_aux=True), static_argnums=2
    )(trainable, batch_stats, params.config, pair, truth)
    arrays = bundle("dcp")
    for name, actual in {
        "rotation_ab": there.target_from_source.rotation,
        "translation_ab": there.target_from_source.translation,
        "rotation_ba": back.target_from_source.rotation,
        "translation_ba": back.target_from_source.translation,
        "scores": there.scores,
        "scores_ba": back.scores,
        "source_correspondence": there.correspondence.swapaxes(1, 2),
        "loss_rotation": terms.rotation,
        "loss_translation": terms.translation,
        "loss_cycle_rotation": cycles[0],
        "loss_cycle_translation": cycles[1],
        "loss_total": total,
    }.items():
        assert_near(actual, arrays[f"v2_train/{name}"], TRAINING)
    assert_gradients({"dcp": gradient}, entries(params.config), arrays, "v2_train", GRADIENT)
    running = {"dcp": changed["batch_stats"]}
    assert_running(running, entries(params.config), arrays, "v2_train", TRAINING)
