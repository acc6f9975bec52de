"""INENet against what its released code computed, in float64."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dbdnet_jax.networks.batch_norm import fold, split_batch_stats
from dbdnet_jax.networks.inenet.network import INENet, INENetConfig, shapes
from dbdnet_jax.training.inenet import margin_loss
from tests.networks.inenet.names import entries
from tests.peers import (
    EVALUATION,
    GRADIENT,
    TRAINING,
    assert_gradients,
    assert_near,
    assert_running,
    assert_shapes,
    bundle,
    clouds,
    filled,
)

pytestmark = pytest.mark.usefixtures("x64")


@functools.cache
def given():
    arrays = bundle("inenet")
    pair = clouds(arrays["source"]), clouds(arrays["target"])
    config = INENetConfig(points=arrays["target"].shape[1], released=True)
    overlap = jnp.asarray(arrays["source_mask_gt"] > 0.5)
    return filled("inenet", entries(config), config), pair, overlap


def evaluated(network, config, pair, overlap):
    found = INENet(config).apply({"params": fold(network)}, *pair)
    return margin_loss(found.margin, overlap, pair[0].valid), found


def trained(trainable, config, pair, overlap, batch_stats):
    found, changed = INENet(config).apply(
        {"params": trainable, "batch_stats": batch_stats},
        *pair,
        training=True,
        mutable=["batch_stats"],
    )
    loss = margin_loss(found.margin, overlap, pair[0].valid)
    return loss, (found, changed["batch_stats"])


def check(loss, found, mode, relative):
    arrays = bundle("inenet")
    near = functools.partial(assert_near, relative=relative)
    near(loss, arrays[f"{mode}/loss"])
    near(found.mask_logits, arrays[f"{mode}/mask_logit"])
    near(found.threshold_logit[:, None], arrays[f"{mode}/threshold_logit"])
    near(jax.nn.sigmoid(found.mask_logits), arrays[f"{mode}/mask"])
    near(jax.nn.sigmoid(found.threshold_logit)[:, None], arrays[f"{mode}/threshold"])
    np.testing.assert_array_equal(found.margin >= 0, arrays[f"{mode}/mask_index"] == 1)
    near(found.cosine, arrays[f"{mode}/cosine"])
    near(found.residual, arrays[f"{mode}/global_residual"])
    for cloud in ("source", "target"):
        encoded = getattr(found, cloud)
        near(encoded.input_transform, arrays[f"{mode}/input_transform_{cloud}"])
        if f"{mode}/embedding_{cloud}" in arrays:
            near(encoded.features.swapaxes(1, 2), arrays[f"{mode}/embedding_{cloud}"])
            near(encoded.feature_transform, arrays[f"{mode}/feature_transform_{cloud}"])


def test_evaluation():
    params, pair, overlap = given()
    (loss, found), gradient = jax.jit(
        jax.value_and_grad(evaluated, has_aux=True), static_argnums=1
    )(params.networks["inenet"], params.config, pair, overlap)
    check(loss, found, "eval", EVALUATION)
    names = entries(params.config)
    assert_gradients({"inenet": gradient}, names, bundle("inenet"), "eval", GRADIENT)


def test_training():
    params, pair, overlap = given()
    trainable, batch_stats = split_batch_stats(params.networks["inenet"])
    (loss, (found, running)), gradient = jax.jit(
        jax.value_and_grad(trained, has_aux=True), static_argnums=1
    )(trainable, params.config, pair, overlap, batch_stats)
    check(loss, found, "train", TRAINING)
    names, arrays = entries(params.config), bundle("inenet")
    assert_gradients({"inenet": gradient}, names, arrays, "train", GRADIENT)
    assert_running({"inenet": running}, names, arrays, "train", TRAINING)


@pytest.mark.parametrize(("points", "parameters"), [(768, 5_322_123), (717, 5_269_899)])
def test_shapes_are_those_of_the_released_code(points, parameters):
    config = INENetConfig(points=points)
    found = shapes(config)
    assert_shapes(entries(config), found)
    names = (k for k in found if not k.endswith(("/mean", "/variance")))
    assert sum(np.prod(found[name]) for name in names) == parameters
