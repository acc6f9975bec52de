"""MaskNet against what its released code computed, in float64."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from dbdnet_jax.networks.batch_norm import fold, split_batch_stats
from dbdnet_jax.networks.masknet.network import MaskNet, MaskNetConfig, shapes
from dbdnet_jax.networks.torch_state import Entry, affine_entries, batch_norm_entries
from dbdnet_jax.training.masknet import mask_loss
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
CONFIG = MaskNetConfig()


def entries() -> dict[str, Entry]:
    """Torch's name and shape of each of our parameters."""
    found: dict[str, Entry] = {}
    fan_in = 3
    for i, width in enumerate(CONFIG.encoder):
        names = (f"maskNet.feature_model.{kind}{i + 1}" for kind in ("conv", "bn"))
        found |= batch_norm_entries(
            f"masknet/encoder_{i}", *names, fan_in, width, bias=True, axes=1
        )
        fan_in = width
    fan_in *= 2
    for i, width in enumerate((*CONFIG.head, 1)):
        theirs = f"maskNet.h3.{2 * i}"
        found |= affine_entries(f"masknet/head_{i}", theirs, fan_in, width, axes=1)
        fan_in = width
    return found


@functools.cache
def given():
    arrays = bundle("masknet")
    pair = clouds(arrays["source"]).points, clouds(arrays["template"]).points
    return filled("masknet", entries(), CONFIG), pair, jnp.asarray(arrays["template_mask_gt"] > 0.5)


def evaluated(network, pair, overlap):
    logits = MaskNet(CONFIG).apply({"params": fold(network)}, *pair)
    return mask_loss(logits, overlap, jnp.ones_like(overlap)), logits


def trained(trainable, pair, overlap, batch_stats):
    variables = {"params": trainable, "batch_stats": batch_stats}
    logits, changed = MaskNet(CONFIG).apply(
        variables, *pair, training=True, mutable=["batch_stats"]
    )
    loss = mask_loss(logits, overlap, jnp.ones_like(overlap))
    return loss, (logits, changed["batch_stats"])


def check(loss, logits, mode, relative):
    arrays = bundle("masknet")
    assert_near(loss, arrays[f"{mode}/loss_mse"], relative)
    assert_near(logits, arrays[f"{mode}/mask_logit"], relative)
    assert_near(jax.nn.sigmoid(logits), arrays[f"{mode}/mask"], relative)
    np.testing.assert_array_equal(logits > 0, arrays[f"{mode}/threshold_mask"] == 1)
    # As its authors choose: as many of the template's points as the source has.
    highest = np.argsort(-np.asarray(logits), axis=1)[:, : arrays["source"].shape[1]]
    np.testing.assert_array_equal(np.sort(highest, axis=1), arrays[f"{mode}/topk_index"])


def test_the_names_are_those_of_all_parameters():
    assert_shapes(entries(), shapes(CONFIG))


def test_evaluation():
    params, pair, overlap = given()
    (loss, logits), gradient = jax.jit(jax.value_and_grad(evaluated, has_aux=True))(
        params.networks["masknet"], pair, overlap
    )
    check(loss, logits, "eval", EVALUATION)
    assert_gradients({"masknet": gradient}, entries(), bundle("masknet"), "eval", GRADIENT)


def test_training():
    params, pair, overlap = given()
    trainable, batch_stats = split_batch_stats(params.networks["masknet"])
    (loss, (logits, running)), gradient = jax.jit(jax.value_and_grad(trained, has_aux=True))(
        trainable, pair, overlap, batch_stats
    )
    check(loss, logits, "train", TRAINING)
    assert_gradients({"masknet": gradient}, entries(), bundle("masknet"), "train", GRADIENT)
    assert_running({"masknet": running}, entries(), bundle("masknet"), "train", TRAINING)


def test_the_first_steps():
    params, pair, overlap = given()
    trainable, batch_stats = split_batch_stats(params.networks["masknet"])
    optimizer = optax.adam(1e-4)

    @jax.jit
    def step(trainable, batch_stats, state):
        (loss, (_, batch_stats)), gradient = jax.value_and_grad(trained, has_aux=True)(
            trainable, pair, overlap, batch_stats
        )
        updates, state = optimizer.update(gradient, state)
        return loss, optax.apply_updates(trainable, updates), batch_stats, state

    state, losses = optimizer.init(trainable), []
    expected = bundle("masknet")["train/loss_trajectory"]
    for _ in expected:
        loss, trainable, batch_stats, state = step(trainable, batch_stats, state)
        losses.append(float(loss))
    assert_near(np.array(losses), expected, TRAINING)
