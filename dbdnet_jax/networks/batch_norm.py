"""Batch normalisation as the peers have it: by the batch in training, folded away for answers.

One tree holds a layer's affine map (``conv``), its scale and bias, and the running mean and
variance of what enters the norm (``batch_norm``). Training takes the last two apart; an answer
needs neither: they are folded into the affine map, exactly.

DBDNet itself has group norms only, see `dbdnet_jax.networks.blocks`.
"""

import dataclasses
from collections.abc import Mapping
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from dbdnet_jax.networks.blocks import NORM_EPSILON, affine_shapes
from dbdnet_jax.networks.params import Params, Shapes

MOMENTUM = 0.1  # of the newest batch in the running averages: torch's default
RUNNING = ("mean", "variance")  # what is no parameter, but averaged over the batches


class BatchNorm(nn.Module):
    """Normalise every channel by its mean and variance over all rows of the batch.

    The running averages follow torch: every use counts, and their variance is the unbiased one.
    Padding would enter the statistics, so clouds must have none, as the authors' code assumes.
    """

    @nn.compact
    def __call__(self, x: Float[Array, "*rows c"]) -> Float[Array, "*rows c"]:
        """By the statistics of these rows; the averages are in the collection ``batch_stats``."""
        width, rows = x.shape[-1], x.size // x.shape[-1]
        scale = self.param("scale", nn.initializers.ones, (width,)).astype(x.dtype)
        bias = self.param("bias", nn.initializers.zeros, (width,)).astype(x.dtype)
        running_mean = self.variable("batch_stats", "mean", jnp.zeros, (width,))
        running_variance = self.variable("batch_stats", "variance", jnp.ones, (width,))
        flat = x.reshape(rows, width)
        mean = jnp.mean(flat, axis=0)
        variance = jnp.mean((flat - mean[None, :]) ** 2, axis=0)
        unbiased = variance * (rows / max(rows - 1, 1))
        for average, new in ((running_mean, mean), (running_variance, unbiased)):
            new = jax.lax.stop_gradient(new).astype(average.value.dtype)
            average.value = (1 - MOMENTUM) * average.value + MOMENTUM * new
        slope = scale * jax.lax.rsqrt(variance + NORM_EPSILON)
        return ((flat - mean[None, :]) * slope[None, :] + bias[None, :]).reshape(x.shape)


class DenseBatchNorm(nn.Module):
    """Dense, batch normalisation, leaky ReLU of the given slope (0: ReLU; None: neither).

    ``bias`` says whether the affine map has one of its own in training.
    """

    features: int
    bias: bool = True
    slope: float | None = 0.0

    @nn.compact
    def __call__(
        self, x: Float[Array, "*rows c"], training: bool = False
    ) -> Float[Array, "*rows d"]:
        """By the batch's statistics in training; otherwise the parameters must be folded."""
        x = _Map(self.features, self.bias or not training, name="conv")(x)
        if training:
            x = BatchNorm(name="batch_norm")(x)
        return x if self.slope is None else jnp.where(x > 0, x, self.slope * x)


class _Map(nn.Module):
    """An affine or linear map of every row."""

    features: int
    bias: bool

    @nn.compact
    def __call__(self, x: Float[Array, "*rows c"]) -> Float[Array, "*rows d"]:
        kernel = self.param("kernel", nn.initializers.zeros, (x.shape[-1], self.features))
        x = x @ kernel.astype(x.dtype)
        if not self.bias:
            return x
        bias = self.param("bias", nn.initializers.zeros, (self.features,)).astype(x.dtype)
        return x + jnp.broadcast_to(bias, x.shape)


def dense_batch_norm_shapes(name: str, fan_in: int, features: int, *, bias: bool = True) -> Shapes:
    """The parameters of a `DenseBatchNorm` and its running averages, by name."""
    shapes = affine_shapes(f"{name}/conv", fan_in, features)
    if not bias:
        del shapes[f"{name}/conv/bias"]
    leaves = ("scale", "bias", *RUNNING)
    return shapes | {f"{name}/batch_norm/{leaf}": (features,) for leaf in leaves}


def split_batch_stats(tree: Mapping[str, Any]) -> tuple[dict[str, Any], dict[str, Any]]:
    """A network's parameters, and its running averages by the same names."""
    parameters, running = {}, {}
    for name, value in tree.items():
        if name == "batch_norm":
            parameters[name] = {k: v for k, v in value.items() if k not in RUNNING}
            running[name] = {k: v for k, v in value.items() if k in RUNNING}
        elif isinstance(value, Mapping):
            parameters[name], inner = split_batch_stats(value)
            if inner:
                running[name] = inner
        else:
            parameters[name] = value
    return parameters, running


def join_batch_stats(parameters: Mapping[str, Any], running: Mapping[str, Any]) -> dict[str, Any]:
    """Undo `split_batch_stats`."""
    return {
        name: {**value, **running[name]}
        if name == "batch_norm"
        else join_batch_stats(value, running.get(name, {}))
        if isinstance(value, Mapping)
        else value
        for name, value in parameters.items()
    }


def fold(tree: Mapping[str, Any]) -> dict[str, Any]:
    """The network with every batch norm folded into the affine map before it.

    ``((x K + b) - mean) s + bias`` with ``s = scale / sqrt(variance + eps)`` is the map of kernel
    ``K s`` and bias ``(b - mean) s + bias``. A network without batch norms comes back as it is.
    """
    if "batch_norm" not in tree:
        return {k: fold(v) if isinstance(v, Mapping) else v for k, v in tree.items()}
    norm, before = tree["batch_norm"], tree["conv"]
    slope = norm["scale"] * jax.lax.rsqrt(norm["variance"] + NORM_EPSILON)
    kernel = before["kernel"] * slope[None, :]
    bias = (before.get("bias", 0.0) - norm["mean"]) * slope + norm["bias"]
    return {"conv": {"kernel": kernel, "bias": bias}}


def fold_params(params: Params) -> Params:
    """`fold` for all networks of a method."""
    return dataclasses.replace(params, networks=fold(params.networks))
