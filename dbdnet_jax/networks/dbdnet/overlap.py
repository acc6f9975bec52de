"""The overlap network: which points of each cloud have a counterpart in the other one."""

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

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
from dbdnet_jax.networks.dbdnet.encoder import Encoder, encoder_shapes
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
        encoder = Encoder(config.overlap_channels, config.neighbour_space, name="encoder")
        features = over_clouds(encoder, clouds.points, pyramids, geometry)
        n, width = features.shape[1:]
        features = features + jax.vmap(lambda x: position_code(x, width))(clouds.points)
        valid = clouds.valid
        keys = [None] * config.overlap_blocks
        if dropout_key is not None:
            keys = list(jax.random.split(dropout_key, config.overlap_blocks))
        for block, key in enumerate(keys):
            attend = AttentionBlock(config.heads, config.dropout, name=f"attention_{block}")
            features = attend(features, valid, key)
        pooled = jax.vmap(masked_max)(features, valid)[::-1]  # of the other cloud
        other = jnp.broadcast_to(pooled[:, None, :], features.shape)
        seen, matched = [features, other], None
        if config.overlap_matching:
            matched = MatchingLayer(config.sinkhorn_iterations, name="matching")(clouds, features)
            seen.append(match_features(matched))
        features = jnp.concatenate(seen, axis=-1)
        for layer, (size, groups) in enumerate(config.head_layers):
            decode = DenseNorm(size, groups, name=f"decoder_{layer}")
            features = over_clouds(decode, features, valid)
        logits = dense(Affine(1, name="linear"), features.reshape(2 * n, -1)).reshape(2, n)
        return logits, matched


def overlap_shapes(config: ModelConfig) -> Shapes:
    """The parameters of an `OverlapNetwork`."""
    width = 4 * config.overlap_channels
    shapes = encoder_shapes("overlap/encoder", config.overlap_channels, config.inputs)
    shapes |= attention_shapes("overlap/attention", config.overlap_blocks, width)
    fan_in = 2 * width
    if config.overlap_matching:
        shapes |= matching_shapes("overlap/matching")
        fan_in += FIT_FEATURES
    shapes |= dense_norm_shapes("overlap/decoder", fan_in, config.head_layers)
    return shapes | affine_shapes("overlap/linear", config.head_layers[-1][0], 1)
