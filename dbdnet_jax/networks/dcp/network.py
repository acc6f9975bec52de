"""DCP: features of both clouds, a soft correspondence of every source point, one Procrustes solve.

Written after the paper and facts about the released code. There is no mask: every source point
takes part with the same weight, whether it has a counterpart or not.
"""

from dataclasses import dataclass
from typing import NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from dbdnet_jax.networks.batch_norm import fold
from dbdnet_jax.networks.dcp.pointer import Layers, layers_shapes
from dbdnet_jax.networks.edge_features import EdgeFeatures, edge_features_shapes
from dbdnet_jax.networks.params import Params, Shapes
from dbdnet_jax.networks.stacking import neighbours, over_pairs, without_padding
from dbdnet_jax.ops.rigid import procrustes
from dbdnet_jax.types import Answer, Cloud, Rigid

POINTERS = ("transformer", "identity")


@dataclass(frozen=True)
class DCPConfig:
    """Widths of the encoder's layers on edges, of the features, and of the transformer.

    ``pointer="transformer"`` is DCP-v2, "identity" DCP-v1, which has no transformer.
    """

    pointer: str = "transformer"
    neighbours: int = 20
    edges: tuple[int, ...] = (64, 64, 128, 256)
    features: int = 512
    heads: int = 4
    hidden: int = 1024
    blocks: int = 1

    def __post_init__(self) -> None:
        """Refuse unknown pointers and layers of nothing."""
        if self.pointer not in POINTERS:
            raise ValueError(
                f"pointer must be one of {POINTERS}; got {self.pointer!r}. Choose one."
            )
        sizes = (self.neighbours, self.features, self.heads, self.hidden, self.blocks)
        if not self.edges or min(*self.edges, *sizes) < 1 or self.features % self.heads:
            raise ValueError(
                "Every width and number must be at least 1, and features a multiple of heads; got "
                f"{self}. Start from {DCPConfig()}."
            )


class Match(NamedTuple):
    """What one pair's features say: the pose, and how it comes about."""

    target_from_source: Rigid
    scores: Float[Array, "*pairs n m"]
    correspondence: Float[Array, "*pairs n 3"]


class DCP(nn.Module):
    """The features of both clouds, each informed of the other."""

    config: DCPConfig

    def setup(self) -> None:
        """The encoder, and the transformer's two halves."""
        config = self.config
        self.encoder = EdgeFeatures(config.edges, config.features, difference=False)
        if config.pointer == "transformer":
            sizes = config.heads, config.hidden, config.blocks
            self.pointer_encoder = Layers(*sizes)
            self.pointer_decoder = Layers(*sizes)

    def __call__(
        self, source: Cloud, target: Cloud, training: bool = False
    ) -> tuple[Float[Array, "*pairs n d"], Float[Array, "*pairs m d"]]:
        """Features of one pair with folded parameters; in training, of a stack of pairs.

        The batch's statistics are of each cloud on its own, the source's first.
        """
        of_source, of_target = (self.embed(cloud, training) for cloud in (source, target))
        if self.config.pointer == "identity":
            # The code without a transformer adds the features to themselves, and its weights
            # depend on it: the scores are four times as large.
            return 2 * of_source, 2 * of_target
        # Before either is decoded: the order in which the parameters are met.
        memories = self.remember(of_source, source), self.remember(of_target, target)
        return (
            of_source + self.decode(of_source, source, memories[1], target),
            of_target + self.decode(of_target, target, memories[0], source),
        )

    def embed(self, cloud: Cloud, training: bool = False) -> Float[Array, "*pairs n d"]:
        """The encoder's features of one cloud."""
        return self.encoder(cloud.points, neighbours(cloud, self.config.neighbours), training)

    def remember(self, features: Float[Array, "*pairs n d"], cloud: Cloud) -> Array:
        """What the other cloud attends to."""
        return self.pointer_encoder(features, cloud.valid)

    def decode(
        self,
        features: Float[Array, "*pairs n d"],
        cloud: Cloud,
        memory: Float[Array, "*pairs m d"],
        other: Cloud,
    ) -> Float[Array, "*pairs n d"]:
        """What is added to a cloud's features, given the memory of the other."""
        return self.pointer_decoder(features, cloud.valid, memory, other.valid)


def match(
    of_source: Float[Array, "*pairs n d"],
    of_target: Float[Array, "*pairs m d"],
    source: Cloud,
    target: Cloud,
) -> Match:
    """Every source point's weighted mean of the target, and the motion that fits these best."""
    logits = of_source @ jnp.swapaxes(of_target, -1, -2) * of_source.shape[-1] ** -0.5
    seen = jnp.broadcast_to(target.valid[..., None, :], logits.shape)
    scores = jax.nn.softmax(jnp.where(seen, logits, jnp.finfo(logits.dtype).min), axis=-1)
    correspondence = scores @ target.points
    weights = source.valid.astype(logits.dtype)
    solve = over_pairs(lambda x, y, w: procrustes(x, y, w)[0], source.points)
    return Match(solve(source.points, correspondence, weights), scores, correspondence)


def shapes(config: DCPConfig) -> Shapes:
    """Shape of every parameter."""
    found = edge_features_shapes("dcp/encoder", config.edges, config.features, difference=False)
    if config.pointer == "transformer":
        sizes = config.features, config.hidden, config.blocks
        found |= layers_shapes("dcp/pointer_encoder", *sizes, cross=False)
        found |= layers_shapes("dcp/pointer_decoder", *sizes, cross=True)
    return found


def predict(params: Params, source: Cloud, target: Cloud) -> Answer:
    """The pose of one pair; DCP predicts no overlap."""
    return Answer(predict_pose(params, source, target))


def predict_pose(params: Params, source: Cloud, target: Cloud) -> Rigid:
    """The pose of one pair."""
    variables = {"params": fold(params.networks["dcp"])}
    clean = [without_padding(cloud) for cloud in (source, target)]
    features = DCP(params.config).apply(variables, *clean)
    return match(*features, *clean).target_from_source
