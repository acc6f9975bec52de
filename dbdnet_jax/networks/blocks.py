"""The small layers: affine maps, masked group norm, moves between levels, attention blocks.

Every layer works on one cloud of static size whose valid rows are given by a mask. Parameters are
cast to the features' type, so a network given float64 computes in float64 throughout; kernels of
bfloat16 stay what they are, see `ops.products`. Beside each
layer stand the shapes of its parameters by name: tracing the full-size network to find them takes
seconds, loading weights should not. A test holds the lists against the networks.
"""

import operator
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from dbdnet_jax.networks.params import Shapes
from dbdnet_jax.ops.attention import attention
from dbdnet_jax.ops.grouping import interpolate, max_over_neighbours
from dbdnet_jax.ops.products import product
from dbdnet_jax.ops.sampling import divisor

Layers = tuple[tuple[int, int], ...]  # (features, groups of the norm) of each layer

NORM_EPSILON = 1e-5  # torch's default, which the released weights were trained with
LEAKY_SLOPE = 0.2


class Affine(nn.Module):
    """Kernel (in, out) and bias (out,) of an affine map, for layers that apply them in pieces.

    Declared as zeros: `initial.init_params` draws the values of the whole network at once.
    ``of_points``: what it maps are coordinates, which no product rounds.
    """

    features: int
    of_points: bool = False

    @nn.compact
    def __call__(
        self, fan_in: int, dtype: jnp.dtype
    ) -> tuple[Float[Array, "in out"], Float[Array, " out"]]:
        """Declare and return both, cast to ``dtype``; a kernel of bfloat16 stays one."""
        kernel = self.param("kernel", nn.initializers.zeros, (fan_in, self.features))
        bias = self.param("bias", nn.initializers.zeros, (self.features,))
        rounded = kernel.dtype == jnp.bfloat16 and not self.of_points
        return kernel if rounded else kernel.astype(dtype), bias.astype(dtype)


def affine_shapes(name: str, fan_in: int, features: int) -> Shapes:
    """The parameters of an `Affine`."""
    return {f"{name}/kernel": (fan_in, features), f"{name}/bias": (features,)}


def dense(affine: Affine, x: Float[Array, "n c"]) -> Float[Array, "n d"]:
    """Apply an affine map to every row: a 1 x 1 convolution."""
    kernel, bias = affine(x.shape[-1], x.dtype)
    return product(x, kernel) + bias[None, :]


class Norm(nn.Module):
    """Scale and bias of a group normalisation, and how statistics become one affine map."""

    features: int
    groups: int

    def setup(self) -> None:
        """Declare both."""
        self.scale = self.param("scale", nn.initializers.ones, (self.features,))
        self.bias = self.param("bias", nn.initializers.zeros, (self.features,))

    def __call__(
        self, mean: Float[Array, " c"], variance: Float[Array, " c"]
    ) -> tuple[Float[Array, " c"], Float[Array, " c"]]:
        """The map ``slope * x + offset`` from the mean and variance of each channel.

        A group's variance is the mean of its channels' variances plus the variance of their
        means (Wu & He 2018).
        """
        scale, bias = self.scale.astype(mean.dtype), self.bias.astype(mean.dtype)
        mean, variance = mean.reshape(self.groups, -1), variance.reshape(self.groups, -1)
        centre = jnp.mean(mean, axis=1, keepdims=True)
        spread = jnp.mean(variance + (mean - centre) ** 2, axis=1, keepdims=True)
        inverse = jnp.broadcast_to(jax.lax.rsqrt(spread + NORM_EPSILON), mean.shape)
        slope = scale * inverse.reshape(-1)
        return slope, bias - slope * jnp.broadcast_to(centre, mean.shape).reshape(-1)


def norm_shapes(name: str, features: int) -> Shapes:
    """The parameters of a `Norm`, or of a layer norm."""
    return {f"{name}/scale": (features,), f"{name}/bias": (features,)}


class DenseNorm(nn.Module):
    """Dense, group normalisation over the valid rows, ReLU.

    Flax's own GroupNorm normalises each point alone on an unbatched cloud, and knows no padding.
    """

    features: int
    groups: int
    of_points: bool = False

    @nn.compact
    def __call__(self, x: Float[Array, "n c"], valid: Bool[Array, " n"]) -> Float[Array, "n d"]:
        """Map, normalise, rectify; rows that are not valid enter no statistic."""
        x = dense(Affine(self.features, of_points=self.of_points, name="conv"), x)
        weight = valid.astype(x.dtype) / divisor(jnp.sum(valid), x.dtype)
        mean = weight @ x
        centred = jnp.where(valid[:, None], x - mean[None, :], 0.0)
        norm = Norm(self.features, self.groups, name="norm")
        slope, offset = norm(mean, weight @ (centred * centred))
        return nn.relu(x * slope[None, :] + offset[None, :])


def dense_norm_shapes(stem: str, fan_in: int, layers: Layers) -> Shapes:
    """The parameters of `DenseNorm` layers one after another, named STEM_0, STEM_1 and so on."""
    shapes: Shapes = {}
    for layer, (features, _) in enumerate(layers):
        shapes |= affine_shapes(f"{stem}_{layer}/conv", fan_in, features)
        shapes |= norm_shapes(f"{stem}_{layer}/norm", features)
        fan_in = features
    return shapes


class Exchange(nn.Module):
    """Dense + ReLU: what a feature passes through on its way to another level."""

    features: int

    def setup(self) -> None:
        """Declare the affine map."""
        self.conv = Affine(self.features)

    def down(self, x: Float[Array, "n c"]) -> Float[Array, "n d"]:
        """Query-down: the rows are already those of the coarser level."""
        return nn.relu(dense(self.conv, x))

    def pool(self, x: Float[Array, "n c"], index: Int[Array, "m k"]) -> Float[Array, "m d"]:
        """Transition-down: the maximum of dense + ReLU over each kept point's neighbours.

        Rectifying is monotone, so the dense layer runs once per point instead of once per
        neighbour, and the maximum is rectified.
        """
        return nn.relu(max_over_neighbours(dense(self.conv, x), index))

    def up(
        self, x: Float[Array, "m c"], index: Int[Array, "n 3"], weight: Float[Array, "n 3"]
    ) -> Float[Array, "n d"]:
        """Transition-up: interpolate the coarse feature at the finer points, then dense + ReLU.

        The weights sum to one, so the affine map may run first, on the fewer coarse rows.
        """
        return nn.relu(interpolate(dense(self.conv, x), index, weight))


def exchange_shapes(name: str, fan_in: int, features: int) -> Shapes:
    """The parameters of an `Exchange`."""
    return affine_shapes(f"{name}/conv", fan_in, features)


class MultiHeadAttention(nn.Module):
    """Multi-head attention with biases: a packed input projection and an output projection."""

    heads: int
    dropout: float

    @nn.compact
    def __call__(
        self,
        query: Float[Array, "n d"],
        memory: Float[Array, "m d"],
        memory_valid: Bool[Array, " m"],
        dropout_key: PRNGKeyArray | None,
    ) -> Float[Array, "n d"]:
        """Attend from every query row to the valid memory rows."""
        width = query.shape[-1]
        packed = Affine(3 * width, name="in_proj")
        kernels, biases = (jnp.split(x, 3, axis=-1) for x in packed(width, query.dtype))
        q, k, v = (
            product(x, kernel) + bias[None, :]
            for x, kernel, bias in zip((query, memory, memory), kernels, biases, strict=True)
        )
        k, v = (x.astype(kernels[0].dtype) for x in (k, v))
        out = attention(
            q, k, v, memory_valid, self.heads, dropout=self.dropout, dropout_key=dropout_key
        )
        return dense(Affine(width, name="out_proj"), out)


class AttentionBlock(nn.Module):
    """Self-attention, then cross-attention: residual, followed by LayerNorm (eps 1e-5).

    One set of weights serves both clouds, and both directions of the cross step read the features
    from before it.
    """

    heads: int
    dropout: float

    @nn.compact
    def __call__(
        self,
        features: Float[Array, "2 n d"],
        valid: Bool[Array, "2 n"],
        dropout_key: PRNGKeyArray | None = None,
    ) -> Float[Array, "2 n d"]:
        """Update both clouds' features; without a ``dropout_key`` nothing is dropped."""
        for step in ("self", "cross"):
            attend = MultiHeadAttention(self.heads, self.dropout, name=f"{step}_attention")
            norm = nn.LayerNorm(epsilon=NORM_EPSILON, name=f"{step}_layer_norm")
            memory, memory_valid = features, valid
            if step == "cross":
                memory, memory_valid = features[::-1], valid[::-1]
            keys = None
            if dropout_key is not None:
                split = jax.random.split(dropout_key, 3)
                dropout_key, keys = split[0], split[1:]
            features = norm(features + over_clouds(attend, features, memory, memory_valid, keys))
        return features


def attention_shapes(stem: str, blocks: int, width: int) -> Shapes:
    """The parameters of `AttentionBlock` layers one after another, named STEM_0 and so on."""
    shapes: Shapes = {}
    for block in range(blocks):
        for step in ("self", "cross"):
            attend = f"{stem}_{block}/{step}_attention"
            shapes |= affine_shapes(f"{attend}/in_proj", width, 3 * width)
            shapes |= affine_shapes(f"{attend}/out_proj", width, width)
            shapes |= norm_shapes(f"{stem}_{block}/{step}_layer_norm", width)
    return shapes


def over_clouds(module: nn.Module, *stacked: Any) -> Array:
    """Apply a module to both clouds of stacked arguments: one set of weights, compiled once."""
    if module.is_initializing():
        clouds = (jax.tree.map(operator.itemgetter(c), stacked) for c in (0, 1))
        return jnp.stack([module(*cloud) for cloud in clouds])
    # `nn.scan` would do both, but traces a module twice to find what a scan cannot change.
    module, variables = module.unbind()
    return jax.lax.map(lambda arguments: module.apply(variables, *arguments), stacked)
