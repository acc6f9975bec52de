"""The overlap network: which points of each cloud have a counterpart in the other one."""

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from dbdnet_jax.networks.blocks import (
    Affine,
    AttentionBlock,
    DenseNorm,
    affine_shapes,
    attention_shapes,
    dense,
    dense_norm_shapes,
    over_clouds,
)
from dbdnet_jax.networks.dbdnet.config import ModelConfig
from dbdnet_jax.networks.dbdnet.encoder import encoder_shapes, make_encoder
from dbdnet_jax.networks.dbdnet.matching import (
    FIT_FEATURES,
    MatchingLayer,
    SoftMatches,
    match_features,
    matching_shapes,
)
from dbdnet_jax.networks.params import Shapes
from dbdnet_jax.ops.attention import position_code
from dbdnet_jax.ops.grouping import masked_max
from dbdnet_jax.ops.pyramid import Pyramid
from dbdnet_jax.types import Cloud


class OverlapNetwork(nn.Module):
    """Overlap logits of both clouds (paper, section III-B)."""

    config: ModelConfig

    @nn.compact
    def __call__(
        self,
        clouds: Cloud,
        pyramids: Pyramid,
        dropout_key: PRNGKeyArray | None = None,
        geometry: Float[Array, "2 n g"] | None = None,
    ) -> tuple[Float[Array, "2 n"], SoftMatches | None]:
        """Logits of the points of two clouds, stacked, each in farthest-point order.

        The pyramids may be of the clouds before a motion. With ``overlap_matching`` also the soft
        matches that the logits follow from. Rows past a cloud's count hold logits without meaning.
        Without a ``dropout_key`` the network is deterministic.
        """
        config = self.config
        encoder = make_encoder(config, config.overlap_channels, "encoder")
        features = over_clouds(encoder, clouds.points, pyramids, geometry)
        width = features.shape[-1]
        features = features + jax.vmap(lambda x: position_code(x, width))(clouds.points)
        valid = clouds.valid
        keys = [None] * config.overlap_blocks
        if dropout_key is not None:
            keys = list(jax.random.split(dropout_key, config.overlap_blocks))
        for block, key in enumerate(keys):
            attend = AttentionBlock(config.heads, config.dropout, name=f"attention_{block}")
            features = attend(features, valid, key)
        matched, fit = None, []
        if config.overlap_matching:
            matched = MatchingLayer(config.sinkhorn_iterations, name="matching")(clouds, features)
            fit = [match_features(matched)]
        return decode_overlap(config, features, valid, *fit), matched


def decode_overlap(
    config: ModelConfig,
    features: Float[Array, "2 n d"],
    valid: Bool[Array, "2 n"],
    *more: Float[Array, "2 n f"],
) -> Float[Array, "2 n"]:
    """Overlap logits from each point's feature, the other cloud's pooled one, and ``more``.

    For a compact method, whose module the layers become part of.
    """
    pooled = jax.vmap(masked_max)(features, valid)[::-1]  # of the other cloud
    other = jnp.broadcast_to(pooled[:, None, :], features.shape)
    features = jnp.concatenate([features, other, *more], axis=-1)
    for layer, (size, groups) in enumerate(config.head_layers):
        decode = DenseNorm(size, groups, name=f"decoder_{layer}")
        features = over_clouds(decode, features, valid)
    n = features.shape[1]
    return dense(Affine(1, name="linear"), features.reshape(2 * n, -1)).reshape(2, n)


class OverlapHead(nn.Module):
    """`decode_overlap` of a network that does not end there."""

    config: ModelConfig

    @nn.compact
    def __call__(
        self, features: Float[Array, "2 n d"], valid: Bool[Array, "2 n"]
    ) -> Float[Array, "2 n"]:
        """Logits of the points of two stacked clouds."""
        return decode_overlap(self.config, features, valid)


def overlap_shapes(config: ModelConfig) -> Shapes:
    """The parameters of an `OverlapNetwork`."""
    width = 4 * config.overlap_channels
    shapes = encoder_shapes("overlap/encoder", config, config.overlap_channels)
    shapes |= attention_shapes("overlap/attention", config.overlap_blocks, width)
    fit = 0
    if config.overlap_matching:
        shapes |= matching_shapes("overlap/matching")
        fit = FIT_FEATURES
    return shapes | decoder_shapes("overlap", config, 2 * width + fit)


def decoder_shapes(name: str, config: ModelConfig, fan_in: int) -> Shapes:
    """The parameters of `decode_overlap`, given so many numbers of each point."""
    return {
        **dense_norm_shapes(f"{name}/decoder", fan_in, config.head_layers),
        **affine_shapes(f"{name}/linear", config.head_layers[-1][0], 1),
    }
