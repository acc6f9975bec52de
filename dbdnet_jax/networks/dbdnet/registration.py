"""The registration network: two branches of soft correspondences, one for R and one for t.

In the paper's ablations a single branch gives both, and a joint overlap comes of its features.
"""

from collections.abc import Sequence
from typing import NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

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
from dbdnet_jax.networks.dbdnet.frames import select
from dbdnet_jax.networks.dbdnet.overlap import OverlapHead, decoder_shapes
from dbdnet_jax.networks.params import Shapes
from dbdnet_jax.ops.attention import position_code
from dbdnet_jax.ops.grouping import masked_max, squared_distances
from dbdnet_jax.ops.pyramid import build_pyramids
from dbdnet_jax.ops.sampling import inverse_order, prefix_mask
from dbdnet_jax.ops.sinkhorn import sinkhorn
from dbdnet_jax.types import Cloud


class Affinity(NamedTuple):
    """How feature distances become affinities: ``-beta (distance^2 - alpha)``, per branch.

    A single branch has both numbers twice.
    """

    beta_rotation: Float[Array, ""]
    alpha_rotation: Float[Array, ""]
    beta_translation: Float[Array, ""]
    alpha_translation: Float[Array, ""]


class Matches(NamedTuple):
    """Soft correspondences of two stacked clouds.

    Entry ``matrix[b, i, j]`` is the mass that source point i gives to target point j in branch b,
    the rotation's first (a single branch stands there twice); zero outside the ``matched`` rows,
    which are the points that take part. ``overlap`` holds the logits of a joint overlap.
    """

    matrix: Float[Array, "2 n n"]
    matched: Bool[Array, "2 n"]
    overlap: Float[Array, "2 n"] | None


class ParameterNetwork(nn.Module):
    """A PointNet over both clouds, tagged 0 and 1, that sets the branches' affinities."""

    config: ModelConfig

    @nn.compact
    def __call__(self, clouds: Cloud, matched: Bool[Array, "2 n"] | None = None) -> Affinity:
        """Two positive numbers for each branch from two stacked clouds (RPM-Net, Yew & Lee 2020).

        From their ``matched`` rows; from all points, if None.
        """
        n = clouds.points.shape[1]
        tag = jnp.zeros((2, n, 1), clouds.points.dtype).at[1].set(1.0)
        x = jnp.concatenate([clouds.points, tag], axis=-1).reshape(2 * n, 4)
        valid = (clouds.valid if matched is None else matched).reshape(2 * n)
        for layer, (features, groups) in enumerate(self.config.point_layers):
            dense_norm = DenseNorm(features, groups, of_points=layer == 0, name=f"point_{layer}")
            x = dense_norm(x, valid)
        x = masked_max(x, valid)[None, :]
        for layer, (features, groups) in enumerate(self.config.global_layers):
            x = DenseNorm(features, groups, name=f"global_{layer}")(x, jnp.ones(1, bool))
        x = nn.softplus(dense(Affine(2 * self.config.branches, name="linear"), x)[0])
        return Affinity(x[0], x[1], x[-2], x[-1])


class RegistrationNetwork(nn.Module):
    """Soft correspondences of its branches (paper, sections III-C and III-D)."""

    config: ModelConfig

    def setup(self) -> None:
        """Declare the encoder, the parameter network, the stacks of blocks, a joint overlap."""
        config = self.config
        self.encoder = make_encoder(config, config.registration_channels)
        self.weight_net = ParameterNetwork(config)

        def stack(size: int) -> list[AttentionBlock]:
            return [AttentionBlock(config.heads, config.dropout) for _ in range(size)]

        self.attention = stack(config.shared_blocks)
        self.attention_R = stack(config.rotation_blocks)
        if config.branches == 2:
            self.attention_t = stack(config.translation_blocks)
        if config.overlap == "joint":
            self.overlap_head = OverlapHead(config)

    def __call__(
        self,
        clouds: Cloud,
        skip_rows: Int[Array, "2 n"] | None = None,
        dropout_key: PRNGKeyArray | None = None,
        geometry: Float[Array, "2 n g"] | None = None,
    ) -> Matches:
        """Encode, then match."""
        return self.match(clouds, self.encode(clouds, skip_rows, geometry), dropout_key)

    def encode(
        self,
        clouds: Cloud,
        skip_rows: Int[Array, "2 n"] | None = None,
        geometry: Float[Array, "2 n g"] | None = None,
    ) -> Float[Array, "2 n d"]:
        """Point-wise features of two stacked clouds, each in farthest-point order."""
        pyramids = build_pyramids(clouds, self.config.neighbours, skip_rows)
        return over_clouds(self.encoder, clouds.points, pyramids, geometry)

    def match(
        self,
        clouds: Cloud,
        features: Float[Array, "2 n d"],
        dropout_key: PRNGKeyArray | None = None,
    ) -> Matches:
        """Correspondences of the rotation branch and of the translation branch."""
        config, width, valid = self.config, features.shape[-1], clouds.valid
        features = features + jax.vmap(lambda x: position_code(x, width))(clouds.points)
        keys = [None] * 3 if dropout_key is None else jax.random.split(dropout_key, 3)
        shared = _run(self.attention, features, valid, keys[0])
        of_rotation = _run(self.attention_R, shared, valid, keys[1])
        matched, overlap = valid, None
        if config.overlap == "joint":
            overlap = self.overlap_head(of_rotation, valid)
            matched = _above_threshold(overlap, clouds, config)
        scale = self.weight_net(clouds, matched)

        def correspond(x: Array, beta: Array, alpha: Array) -> Array:
            affinity = -beta * (squared_distances(x[0], x[1]) - alpha)
            return jnp.exp(sinkhorn(affinity, matched[0], matched[1], config.sinkhorn_iterations))

        matrices = [correspond(of_rotation, scale.beta_rotation, scale.alpha_rotation)] * 2
        if config.branches == 2:
            features = _run(self.attention_t, shared, valid, keys[2])
            matrices[1] = correspond(features, scale.beta_translation, scale.alpha_translation)
        return Matches(jnp.stack(matrices), matched, overlap)


def _above_threshold(
    logits: Float[Array, "2 n"], clouds: Cloud, config: ModelConfig
) -> Bool[Array, "2 n"]:
    """The rows of both clouds that `frames.select` takes, where they stand."""

    def one(probability: Array, count: Array) -> Array:
        order, kept = select(probability, count, config.overlap_threshold, config.min_points)
        return prefix_mask(len(order), kept)[inverse_order(order)]

    return jax.vmap(one)(jax.lax.stop_gradient(jax.nn.sigmoid(logits)), clouds.count)


def _run(
    blocks: Sequence[AttentionBlock],
    features: Float[Array, "2 n d"],
    valid: Bool[Array, "2 n"],
    key: PRNGKeyArray | None,
) -> Float[Array, "2 n d"]:
    """One block after another, each with its own dropout key."""
    keys = [None] * len(blocks) if key is None else jax.random.split(key, len(blocks))
    for block, block_key in zip(blocks, keys, strict=True):
        features = block(features, valid, block_key)
    return features


def registration_shapes(config: ModelConfig) -> Shapes:
    """The parameters of a `RegistrationNetwork`."""
    name, width = "registration", 4 * config.registration_channels
    last = config.point_layers[-1][0]
    shapes = encoder_shapes(f"{name}/encoder", config, config.registration_channels)
    shapes |= attention_shapes(f"{name}/attention", config.shared_blocks, width)
    shapes |= attention_shapes(f"{name}/attention_R", config.rotation_blocks, width)
    if config.branches == 2:
        shapes |= attention_shapes(f"{name}/attention_t", config.translation_blocks, width)
    if config.overlap == "joint":
        shapes |= decoder_shapes(f"{name}/overlap_head", config, 2 * width)
    shapes |= dense_norm_shapes(f"{name}/weight_net/point", 4, config.point_layers)
    shapes |= dense_norm_shapes(f"{name}/weight_net/global", last, config.global_layers)
    numbers = 2 * config.branches
    return shapes | affine_shapes(f"{name}/weight_net/linear", config.global_layers[-1][0], numbers)
