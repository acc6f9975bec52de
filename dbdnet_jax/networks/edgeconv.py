"""EdgeConv (Wang et al. 2019) with two group-normalised layers, without its n x k x c arrays.

The plain form maps ``[f_j - f_i, f_i]`` of every neighbour j of every point i through
convolution, GroupNorm and LeakyReLU twice and takes the maximum over j. The same values are had
for a fraction of the arithmetic and memory:

- the first convolution is linear, so it is one product per point (``W_d f_j``), gathered, plus
  another (``(W_s - W_d) f_i + b``);
- a GroupNorm is one affine map per channel once its statistics are known, and LeakyReLU is
  monotone, so the maximum over j needs only the maximum of the second convolution, or its minimum
  where the slope is negative; the slope has the sign of the norm's scale;
- rows go in blocks whose edges stay in a core's cache; those of several blocks are computed again
  in the derivative.
"""

import math
from collections.abc import Callable
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from dbdnet_jax.networks.blocks import LEAKY_SLOPE, Affine, Norm, affine_shapes, norm_shapes
from dbdnet_jax.networks.params import Shapes
from dbdnet_jax.ops.grouping import max_over_slots
from dbdnet_jax.ops.products import product
from dbdnet_jax.ops.sampling import divisor

BLOCK_VALUES = 1 << 17  # of one block's edges, k x rows x channels: 512 KB of float32


Moments = tuple[Array, Array]  # sums per channel (c,) of edges and of their squares
Block = tuple[Array, Array, Array]  # see `_blocks`


class EdgeConv(nn.Module):
    """Two-layer EdgeConv of one level; both layers have ``features`` channels.

    ``of_points``: the features that come in are coordinates.
    """

    features: int
    groups: int
    of_points: bool = False

    @nn.compact
    def __call__(
        self, x: Float[Array, "n c"], index: Int[Array, "n k"], valid: Bool[Array, " n"]
    ) -> Float[Array, "n d"]:
        """The new feature of every point; rows that are not valid enter no statistic."""
        first = Affine(self.features, of_points=self.of_points, name="conv_0")
        kernel, bias = first(2 * x.shape[-1], x.dtype)
        difference, own_kernel = jnp.split(kernel, 2, axis=0)
        near = product(x, difference)
        own = product(x, own_kernel - difference) + bias[None, :]
        norm = Norm(self.features, self.groups, name="norm_0")
        slope, offset = norm(*edge_moments(near, own, index, valid))
        # The first normalisation, folded into its two inputs.
        near, own = near * slope[None, :], own * slope[None, :] + offset[None, :]
        kernel, bias = Affine(self.features, name="conv_1")(self.features, x.dtype)
        norm = Norm(self.features, self.groups, name="norm_1")
        rising = norm.scale >= 0
        best, mean, variance = edge_extremes(near, own, kernel, bias, rising, index, valid)
        slope, offset = norm(mean, variance)
        return nn.leaky_relu(best * slope[None, :] + offset[None, :], LEAKY_SLOPE)


def edgeconv_shapes(name: str, fan_in: int, features: int) -> Shapes:
    """The parameters of an `EdgeConv` on features of width ``fan_in``."""
    return {
        **affine_shapes(f"{name}/conv_0", 2 * fan_in, features),
        **norm_shapes(f"{name}/norm_0", features),
        **affine_shapes(f"{name}/conv_1", features, features),
        **norm_shapes(f"{name}/norm_1", features),
    }


def edge_moments(
    near: Float[Array, "n c"],
    own: Float[Array, "n c"],
    index: Int[Array, "n k"],
    valid: Bool[Array, " n"],
) -> tuple[Float[Array, " c"], Float[Array, " c"]]:
    """Mean and variance per channel of ``near[j] + own[i]`` over all edges of the valid rows."""
    weight = edge_weights(valid, index.shape[1], near.dtype)
    shift = _mean_over_first_slot(near[index[:, 0]] + own, weight, index)

    def block(moments: Moments, rows: Block) -> tuple[Moments, None]:
        slots, own, weight = rows
        edge = near[slots] + own[None, :, :]
        return _add_moments(moments, edge, shift, weight), None

    rows = _blocks(index, own, weight)
    zero = jnp.zeros_like(shift)
    (mean, square), _ = _scan(block, (zero, zero), rows)
    return mean + shift, square - mean * mean


def edge_extremes(
    near: Float[Array, "n c"],
    own: Float[Array, "n c"],
    kernel: Float[Array, "c d"],
    bias: Float[Array, " d"],
    rising: Bool[Array, " d"],
    index: Int[Array, "n k"],
    valid: Bool[Array, " n"],
) -> tuple[Float[Array, "n d"], Float[Array, " d"], Float[Array, " d"]]:
    """Of ``leaky(near[j] + own[i]) @ kernel + bias``: the extremes over j, mean and variance.

    The extreme (n, d) of a row is the maximum over its neighbours in ``rising`` channels and the
    minimum in the others; mean (d,) and variance (d,) go over all edges of the valid rows.
    """
    n, k = index.shape
    weight = edge_weights(valid, k, near.dtype)
    sign = jnp.where(rising, 1.0, -1.0).astype(near.dtype)

    def convolve(edge: Array) -> Array:
        return product(nn.leaky_relu(edge, LEAKY_SLOPE), kernel)

    shift = _mean_over_first_slot(convolve(near[index[:, 0]] + own), weight, index)

    def block(moments: Moments, rows: Block) -> tuple[Moments, Array]:
        slots, own, weight = rows
        edge = convolve(near[slots] + own[None, :, :])
        extreme = max_over_slots(edge * sign[None, None, :]) * sign[None, :]
        return _add_moments(moments, edge, shift, weight), extreme

    rows = _blocks(index, own, weight)
    zero = jnp.zeros_like(shift)
    (mean, square), extreme = _scan(block, (zero, zero), rows)
    extreme = extreme.reshape(-1, kernel.shape[1])[:n]
    return extreme + bias[None, :], mean + shift + bias, square - mean * mean


def edge_weights(valid: Bool[Array, " n"], k: int, dtype: jnp.dtype) -> Float[Array, " n"]:
    """What each of a row's k edges counts for in a mean over all edges of the valid rows."""
    return valid.astype(dtype) / (k * divisor(jnp.sum(valid), dtype))


def _mean_over_first_slot(
    edge: Float[Array, "n c"], weight: Float[Array, " n"], index: Int[Array, "n k"]
) -> Float[Array, " c"]:
    """A point near the mean: squares summed about it lose nothing; about zero they would cancel."""
    return jax.lax.stop_gradient(index.shape[1] * (weight @ edge))


def _add_moments(
    moments: Moments,
    edge: Float[Array, "k rows c"],
    shift: Float[Array, " c"],
    weight: Float[Array, " rows"],
) -> Moments:
    """Add the weighted sums of a block's edges (k, rows, c) and of their squares about shift."""
    centred = edge - shift[None, None, :]
    mean, square = moments
    return mean + weight @ jnp.sum(centred, 0), square + weight @ jnp.sum(centred * centred, 0)


def _scan(
    block: Callable[[Moments, Block], tuple[Moments, Any]], zero: Moments, rows: Block
) -> tuple[Moments, Any]:
    """Block after block; the derivative keeps the edges of one, and computes those of several."""
    several = len(rows[0]) > 1
    return jax.lax.scan(jax.checkpoint(block) if several else block, zero, rows)


def _blocks(
    index: Int[Array, "n k"], own: Float[Array, "n c"], weight: Float[Array, " n"]
) -> Block:
    """Neighbour slots (blocks, k, rows), own features and weights of blocks of rows.

    Rows that only fill the last block weigh nothing.
    """
    n, k = index.shape
    blocks = math.ceil(n * k * own.shape[1] / BLOCK_VALUES)
    rows = math.ceil(n / blocks)

    def split(x: Array) -> Array:
        x = jnp.pad(x, [(0, blocks * rows - n)] + [(0, 0)] * (x.ndim - 1))
        return x.reshape(blocks, rows, *x.shape[1:])

    return split(index).swapaxes(1, 2), split(own), split(weight)
