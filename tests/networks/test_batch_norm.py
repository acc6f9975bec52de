"""Batch normalisation: by the batch in training, folded exactly for answers."""

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np

from dbdnet_jax.networks.batch_norm import (
    DenseBatchNorm,
    dense_batch_norm_shapes,
    fold,
    join_batch_stats,
    split_batch_stats,
)
from dbdnet_jax.networks.params import unflatten
from tests.conftest import FLOAT64, assert_close, random_cloud


class TwoLayers(nn.Module):
    """One with a bias of its own and a leaky slope, one without either."""

    @nn.compact
    def __call__(self, x, training):
        """Of arrays of either library."""
        x = DenseBatchNorm(5, slope=0.2, name="a")(jnp.asarray(x), training)
        return DenseBatchNorm(4, bias=False, slope=None, name="b")(x, training)


def tree():
    shapes = dense_batch_norm_shapes("a", 3, 5) | dense_batch_norm_shapes("b", 5, 4, bias=False)
    rng = np.random.default_rng(0)
    arrays = {n: rng.uniform(0.5, 1.5, s) * rng.choice([-1, 1], s) for n, s in shapes.items()}
    arrays |= {n: np.abs(x) for n, x in arrays.items() if n.endswith("variance")}
    return unflatten(arrays, None).networks


def by_hand(x, layer, mean, variance):
    x = x @ np.asarray(layer["conv"]["kernel"]) + np.asarray(layer["conv"].get("bias", 0.0))
    if mean is None:
        mean, variance = x.mean(axis=(0, 1)), x.var(axis=(0, 1))
    norm = layer["batch_norm"]
    out = (x - mean) / np.sqrt(variance + 1e-5) * np.asarray(norm["scale"])
    return out + np.asarray(norm["bias"]), mean, variance


def test_training_uses_the_batch_and_averages_as_torch_does(x64):
    layers, x = tree(), random_cloud(1, 14).reshape(2, 7, 3)
    trainable, stats = split_batch_stats(layers)
    variables = {"params": trainable, "batch_stats": stats}
    found, changed = TwoLayers().apply(variables, x, True, mutable=["batch_stats"])
    hidden, mean, variance = by_hand(x, layers["a"], None, None)
    expected, *_ = by_hand(np.where(hidden > 0, hidden, 0.2 * hidden), layers["b"], None, None)
    assert_close(found, expected, FLOAT64)
    old, new = layers["a"]["batch_norm"], changed["batch_stats"]["a"]["batch_norm"]
    assert_close(new["mean"], 0.9 * old["mean"] + 0.1 * mean, FLOAT64)
    assert_close(new["variance"], 0.9 * old["variance"] + 0.1 * variance * 14 / 13, FLOAT64)


def test_folding_is_exact_and_done_once(x64):
    layers, x = tree(), random_cloud(2, 9)
    folded = fold(layers)
    found = TwoLayers().apply({"params": folded}, x, False)
    for name in ("a", "b"):
        norm = layers[name]["batch_norm"]
        x, *_ = by_hand(x, layers[name], np.asarray(norm["mean"]), np.asarray(norm["variance"]))
        x = np.where(x > 0, x, 0.2 * x) if name == "a" else x
    assert_close(found, x, FLOAT64)
    again = fold(folded)
    assert jax.tree.all(jax.tree.map(lambda a, b: bool((a == b).all()), again, folded))
    plain = {"conv": {"kernel": jnp.ones((2, 2))}, "norm": {"scale": jnp.ones(2)}}
    assert jax.tree.structure(fold(plain)) == jax.tree.structure(plain)


def test_splitting_and_joining_undo_each_other():
    layers = {"part": tree(), "head": {"kernel": jnp.ones((4, 1))}}
    trainable, stats = split_batch_stats(layers)
    assert stats["part"]["a"]["batch_norm"].keys() == {"mean", "variance"} and "head" not in stats
    assert trainable["part"]["a"]["batch_norm"].keys() == {"scale", "bias"}
    joined = join_batch_stats(trainable, stats)
    assert jax.tree.structure(joined) == jax.tree.structure(layers)
    jax.tree.map(np.testing.assert_array_equal, joined, layers)


def test_a_layer_used_twice_in_a_step_averages_twice():
    layers = tree()
    trainable, stats = split_batch_stats({"a": layers["a"]})

    class Twice(nn.Module):
        @nn.compact
        def __call__(self, x, y):
            layer = DenseBatchNorm(5, name="a")
            return layer(jnp.asarray(x), True), layer(jnp.asarray(y), True)

    x, y = (random_cloud(s, 6).astype("f4") for s in (1, 2))
    _, changed = Twice().apply(
        {"params": trainable, "batch_stats": stats}, x, y, mutable=["batch_stats"]
    )
    mean = stats["a"]["batch_norm"]["mean"]
    for cloud in (x, y):
        mapped = cloud @ layers["a"]["conv"]["kernel"] + layers["a"]["conv"]["bias"][None, :]
        mean = 0.9 * mean + 0.1 * mapped.mean(axis=0)
    np.testing.assert_allclose(
        changed["batch_stats"]["a"]["batch_norm"]["mean"], mean, rtol=1e-4, atol=1e-5
    )
