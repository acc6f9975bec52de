"""EdgeConv (Wang et al. 2019) with two group-normalised layers, without its n x k x c arrays.

The plain form maps ``[f_j - f_i, f_i]`` of every neighbour j of every point i through
convolution, GroupNorm and LeakyReLU twice and takes the maximum over j. The same values are had
for a fraction of the arithmetic and memory:

- the first convolution is linear, so it is one product per point (``W_d f_j``), gathered, plus
  another (``(W_s - W_d) f_i + b``);
- a GroupNorm is one affine map per channel once its statistics are known, and LeakyReLU is
  monotone, so the maximum over j needs only the maximum and the minimum of the second
  convolution: which one depends on the sign of the affine map's slope;
- neighbour slots are looped over, so that the working set is n x c and stays in cache.
"""

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from dbdnet_jax.model.blocks import LEAKY_SLOPE, Affine, Norm


class EdgeConv(nn.Module):
    """Two-layer EdgeConv of one level; both layers have ``features`` channels."""

    features: int
    groups: int

    @nn.compact
    def __call__(
        self, x: Float[Array, "n c"], index: Int[Array, "n k"], valid: Bool[Array, " n"]
    ) -> Float[Array, "n d"]:
        """The new feature of every point; rows that are not valid enter no statistic."""
        kernel, bias = Affine(self.features, name="conv_0")(2 * x.shape[-1], x.dtype)
        difference, own_kernel = jnp.split(kernel, 2, axis=0)
        near = x @ difference
        own = x @ (own_kernel - difference) + bias[None, :]
        slope, offset = Norm(self.groups, name="norm_0")(*edge_moments(near, own, index, valid))
        # The first normalisation, folded into its two inputs.
        near, own = near * slope[None, :], own * slope[None, :] + offset[None, :]
        kernel, bias = Affine(self.features, name="conv_1")(self.features, x.dtype)
        highest, lowest, mean, variance = edge_extremes(near, own, kernel, bias, index, valid)
        slope, offset = Norm(self.groups, name="norm_1")(mean, variance)
        best = jnp.where(slope[None, :] >= 0, highest, lowest)
        return nn.leaky_relu(best * slope[None, :] + offset[None, :], LEAKY_SLOPE)


def row_weights(valid: Bool[Array, " n"], k: int, dtype: jnp.dtype) -> Float[Array, " n"]:
    """What each row's k edges count for in a mean over all edges of the valid rows."""
    return valid.astype(dtype) / (k * jnp.maximum(jnp.sum(valid), 1)).astype(dtype)


def edge_moments(
    near: Float[Array, "n c"],
    own: Float[Array, "n c"],
    index: Int[Array, "n k"],
    valid: Bool[Array, " n"],
) -> tuple[Float[Array, " c"], Float[Array, " c"]]:
    """Mean and variance per channel of ``near[j] + own[i]`` over all edges of the valid rows."""
    k = index.shape[1]
    weight = row_weights(valid, k, near.dtype)
    # Sums of squares about a point near the mean lose nothing; about zero they would cancel.
    shift = jax.lax.stop_gradient(k * (weight @ (near[index[:, 0]] + own)))

    def slot(moments, rows):
        edge = near[rows] + own - shift[None, :]
        return (moments[0] + weight @ edge, moments[1] + weight @ (edge * edge)), None

    zero = jnp.zeros_like(shift)
    (mean, square), _ = jax.lax.scan(jax.checkpoint(slot), (zero, zero), index.T)
    return mean + shift, square - mean * mean


def edge_extremes(
    near: Float[Array, "n c"],
    own: Float[Array, "n c"],
    kernel: Float[Array, "c d"],
    bias: Float[Array, " d"],
    index: Int[Array, "n k"],
    valid: Bool[Array, " n"],
):
    """Of ``leaky(near[j] + own[i]) @ kernel + bias``: max and min over j, mean and variance.

    Returns the maximum (n, d) and minimum (n, d) over each row's neighbours, and the mean (d,)
    and variance (d,) over all edges of the valid rows.
    """
    k = index.shape[1]
    weight = row_weights(valid, k, near.dtype)

    def edge(rows):
        return nn.leaky_relu(near[rows] + own, LEAKY_SLOPE) @ kernel + bias[None, :]

    first = edge(index[:, 0])
    shift = jax.lax.stop_gradient(k * (weight @ first))

    def slot(carry, rows):
        highest, lowest, mean, square = carry
        value = edge(rows)
        centred = value - shift[None, :]
        mean, square = mean + weight @ centred, square + weight @ (centred * centred)
        return (jnp.maximum(highest, value), jnp.minimum(lowest, value), mean, square), None

    centred = first - shift[None, :]
    start = (first, first, weight @ centred, weight @ (centred * centred))
    (highest, lowest, mean, square), _ = jax.lax.scan(jax.checkpoint(slot), start, index[:, 1:].T)
    return highest, lowest, mean + shift, square - mean * mean
