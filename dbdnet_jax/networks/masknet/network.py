"""MaskNet: a PointNet of both clouds, and a mask over the points of one of them.

The network is one-sided: it tells which points of a *template* the *source* contains. For two
partial clouds it is asked twice, with the roles exchanged and the same weights. Its authors keep
the points with the highest mask, as many as the source has; here the mask is a probability, and
the usual threshold of 0.5 applies.
"""

from dataclasses import dataclass
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from dbdnet_jax.networks.batch_norm import DenseBatchNorm, dense_batch_norm_shapes, fold
from dbdnet_jax.networks.blocks import Affine, affine_shapes
from dbdnet_jax.networks.params import Params, Shapes
from dbdnet_jax.networks.stacking import pool
from dbdnet_jax.types import Answer, Cloud


@dataclass(frozen=True)
class MaskNetConfig:
    """Widths of the layers: of the encoder, which every point passes, and of the mask's head."""

    encoder: tuple[int, ...] = (64, 64, 64, 128, 1024)
    head: tuple[int, ...] = (1024, 512, 256, 128)

    def __post_init__(self) -> None:
        """Refuse layers of nothing."""
        for name in ("encoder", "head"):
            widths = getattr(self, name)
            if not widths or min(widths) < 1:
                raise ValueError(
                    f"{name} must hold at least one width, each at least 1; got {widths}. Use "
                    f"{getattr(MaskNetConfig, name)}."
                )


class MaskNet(nn.Module):
    """Logits of the template's points: whether the source has them too."""

    config: MaskNetConfig

    @nn.compact
    def __call__(
        self,
        source: Float[Array, "*pairs n 3"],
        template: Float[Array, "*pairs m 3"],
        source_valid: Bool[Array, "*pairs n"] | None = None,
        training: bool = False,
    ) -> Float[Array, "*pairs m"]:
        """Of one pair with folded parameters; in training, of a batch of pairs.

        The batch's statistics are of each cloud on its own, the source's first.
        """
        encoder = [
            DenseBatchNorm(width, name=f"encoder_{i}")
            for i, width in enumerate(self.config.encoder)
        ]

        def encode(x: Array) -> Array:
            for layer in encoder:
                x = layer(x, training)
            return x

        if source_valid is None:
            source_valid = jnp.ones(source.shape[:-1], bool)
        whole = pool(encode(source), source_valid)
        x = encode(template)
        width = x.shape[-1]
        first, *rest = [
            Affine(size, name=f"head_{i}") for i, size in enumerate((*self.config.head, 1))
        ]
        # Every point is given the whole source: its part of the product is the same for all.
        kernel, bias = first(2 * width, x.dtype)
        of_source = _plus(whole @ kernel[width:], bias)
        x = x @ kernel[:width]
        x = x + jnp.broadcast_to(of_source[..., None, :], x.shape)
        for affine in rest:
            kernel, bias = affine(x.shape[-1], x.dtype)
            x = _plus(nn.relu(x) @ kernel, bias)
        return x[..., 0]


def _plus(x: Float[Array, "*rows c"], bias: Float[Array, " c"]) -> Float[Array, "*rows c"]:
    return x + jnp.broadcast_to(bias, x.shape)


def shapes(config: MaskNetConfig) -> Shapes:
    """Shape of every parameter."""
    found: Shapes = {}
    fan_in = 3
    for i, width in enumerate(config.encoder):
        found |= dense_batch_norm_shapes(f"masknet/encoder_{i}", fan_in, width)
        fan_in = width
    fan_in = 2 * fan_in  # a point and the source
    for i, width in enumerate((*config.head, 1)):
        found |= affine_shapes(f"masknet/head_{i}", fan_in, width)
        fan_in = width
    return found


def predict(params: Params, source: Cloud, target: Cloud) -> Answer:
    """The overlap of both clouds, each in turn the template."""
    network, variables = MaskNet(params.config), {"params": fold(params.networks["masknet"])}

    def mask(seen: Cloud, template: Cloud) -> Array:
        logits: Any = network.apply(variables, seen.points, template.points, seen.valid)
        return jnp.where(template.valid, jax.nn.sigmoid(logits), 0.0)

    return Answer(None, mask(target, source), mask(source, target))
