"""Scaled dot-product attention over a masked cloud, and the sine position code."""

import math

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from dbdnet_jax.ops.products import product


def attention(
    query: Float[Array, "n d"],
    key: Float[Array, "m d"],
    value: Float[Array, "m d"],
    valid: Bool[Array, " m"],
    heads: int,
    *,
    dropout: float = 0.0,
    dropout_key: PRNGKeyArray | None = None,
) -> Float[Array, "n d"]:
    """Multi-head scaled dot-product attention (Vaswani et al. 2017) over the valid rows.

    Channels are split into ``heads`` equal groups. With a ``dropout_key``, attention weights are
    dropped at rate ``dropout`` and the others scaled up. Where no row of the other cloud is
    valid the result is zero. Where keys and values are bfloat16, both products are
    (`ops.products`), but not the softmax between them. Heads run one after another, and each one's
    n x m weights are computed again in the derivative instead of being kept.
    """
    n, d = query.shape
    width = d // heads
    split = [x.reshape(x.shape[0], heads, width).swapaxes(0, 1) for x in (query, key, value)]
    keys = None if dropout_key is None else jax.random.split(dropout_key, heads)

    def head(arguments: tuple) -> jax.Array:
        query, key, value, dropout_key = arguments
        return _head(query, key, value, dropout_key, valid, dropout)

    out = jax.lax.map(jax.checkpoint(head), (*split, keys))
    return out.swapaxes(0, 1).reshape(n, d)


def _head(
    query: Float[Array, "n d"],
    key: Float[Array, "m d"],
    value: Float[Array, "m d"],
    dropout_key: PRNGKeyArray | None,
    valid: Bool[Array, " m"],
    dropout: float,
) -> Float[Array, "n d"]:
    """One head: softmax(q k^T / sqrt(width)) v, with the division left to the n x width result."""
    present = valid.astype(query.dtype)[:, None]
    logits = product(query * (1.0 / math.sqrt(query.shape[-1])), key.T)
    # A large finite number, not -inf: a row of only -inf would give nan. Such a row weighs all
    # masked rows alike, so these are left out of both products below.
    logits = jnp.where(valid[None, :], logits, jnp.finfo(logits.dtype).min)
    weights = jnp.exp(logits - jax.lax.stop_gradient(jnp.max(logits, axis=-1, keepdims=True)))
    total = jnp.matmul(weights, present)
    if dropout_key is not None:
        kept = jax.random.bernoulli(dropout_key, 1.0 - dropout, weights.shape)
        weights = jnp.where(kept, weights / (1.0 - dropout), 0.0)
    value = value * present.astype(value.dtype)
    return product(weights, value) / jnp.where(total > 0, total, 1.0)


def position_code(points: Float[Array, "n 3"], width: int) -> Float[Array, "n width"]:
    """Sine code of 3-D coordinates (RegTR, Yew & Lee 2022), padded with zeros to ``width``.

    Each axis takes ``width // 3 // 2 * 2`` channels: interleaved sine and cosine of
    ``2 pi x / 10000^(2 i / channels)``. Coordinates are expected at the unit sphere's scale.
    """
    channels = width // 3 // 2 * 2
    exponent = jnp.arange(0, channels, 2, dtype=points.dtype) / channels
    angle = 2.0 * math.pi * points[:, :, None] / (10000.0**exponent)[None, None, :]
    code = jnp.stack([jnp.sin(angle), jnp.cos(angle)], axis=-1).reshape(points.shape[0], -1)
    return jnp.pad(code, ((0, 0), (0, width - code.shape[1])))
