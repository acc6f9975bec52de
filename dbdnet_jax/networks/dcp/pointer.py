"""DCP's pointer: a transformer that tells each cloud's features about the other cloud."""

import flax.linen as nn
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from dbdnet_jax.networks.blocks import affine_shapes, norm_shapes
from dbdnet_jax.networks.params import Shapes
from dbdnet_jax.networks.stacking import Rows, over_pairs
from dbdnet_jax.ops.attention import attention

EPSILON = 1e-6  # added to a standard deviation


class DeviationNorm(nn.Module):
    """A layer norm by the unbiased standard deviation, with its epsilon outside of the root."""

    @nn.compact
    def __call__(self, x: Float[Array, "*rows c"]) -> Float[Array, "*rows c"]:
        """Normalise every row."""
        width = x.shape[-1]
        scale = self.param("scale", nn.initializers.ones, (width,)).astype(x.dtype)
        bias = self.param("bias", nn.initializers.zeros, (width,)).astype(x.dtype)
        centred = x - jnp.mean(x, axis=-1, keepdims=True)
        square = jnp.sum(centred * centred, axis=-1, keepdims=True) / (width - 1)
        # The root's derivative at 0 would be infinite: a row of equal entries.
        deviation = jnp.where(square > 0, jnp.sqrt(jnp.where(square > 0, square, 1.0)), 0.0)
        x = centred / (deviation + EPSILON)
        return jnp.broadcast_to(scale, x.shape) * x + jnp.broadcast_to(bias, x.shape)


class Attention(nn.Module):
    """Multi-head attention with four projections."""

    heads: int

    @nn.compact
    def __call__(
        self,
        query: Float[Array, "*pairs n d"],
        memory: Float[Array, "*pairs m d"],
        valid: Bool[Array, "*pairs m"],
    ) -> Float[Array, "*pairs n d"]:
        """Attend from every query row to the valid rows of the memory."""
        width = query.shape[-1]
        q = Rows(width, name="query")(query)
        k, v = Rows(width, name="key")(memory), Rows(width, name="value")(memory)
        heads = self.heads
        attend = over_pairs(lambda q, k, v, valid: attention(q, k, v, valid, heads), q)
        return Rows(width, name="out")(attend(q, k, v, valid))


class Layers(nn.Module):
    """Pre-norm residual layers: self-attention, attention to the other cloud if given, two maps."""

    heads: int
    hidden: int
    blocks: int

    @nn.compact
    def __call__(
        self,
        x: Float[Array, "*pairs n d"],
        valid: Bool[Array, "*pairs n"],
        memory: Float[Array, "*pairs m d"] | None = None,
        memory_valid: Bool[Array, "*pairs m"] | None = None,
    ) -> Float[Array, "*pairs n d"]:
        """The new features, normalised."""
        for block in range(self.blocks):
            y = DeviationNorm(name=f"self_norm_{block}")(x)
            x = x + Attention(self.heads, name=f"self_attention_{block}")(y, y, valid)
            if memory is not None and memory_valid is not None:
                y = DeviationNorm(name=f"cross_norm_{block}")(x)
                attend = Attention(self.heads, name=f"cross_attention_{block}")
                x = x + attend(y, memory, memory_valid)
            y = DeviationNorm(name=f"forward_norm_{block}")(x)
            y = nn.relu(Rows(self.hidden, name=f"forward_{block}_0")(y))
            x = x + Rows(x.shape[-1], name=f"forward_{block}_1")(y)
        return DeviationNorm(name="norm")(x)


def layers_shapes(name: str, width: int, hidden: int, blocks: int, *, cross: bool) -> Shapes:
    """The parameters of `Layers`."""
    found: Shapes = {}
    for block in range(blocks):
        for kind in ("self", "cross") if cross else ("self",):
            found |= norm_shapes(f"{name}/{kind}_norm_{block}", width)
            for part in ("query", "key", "value", "out"):
                found |= affine_shapes(f"{name}/{kind}_attention_{block}/{part}", width, width)
        found |= norm_shapes(f"{name}/forward_norm_{block}", width)
        found |= affine_shapes(f"{name}/forward_{block}_0", width, hidden)
        found |= affine_shapes(f"{name}/forward_{block}_1", hidden, width)
    return found | norm_shapes(f"{name}/norm", width)
