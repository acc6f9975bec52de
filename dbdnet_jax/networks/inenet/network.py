"""INENet: similarities of all target points as channels of every source point, and a threshold.

The network is one-sided: it tells which points of the *source* the *target* contains, and is asked
twice, with the roles exchanged. The target's points are channels, so the network knows one number
of points only, and their order matters.
"""

from dataclasses import dataclass
from typing import Any, NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from dbdnet_jax.networks.batch_norm import DenseBatchNorm, dense_batch_norm_shapes, fold
from dbdnet_jax.networks.blocks import affine_shapes
from dbdnet_jax.networks.chains import Chain, chain_shapes
from dbdnet_jax.networks.params import Params, Shapes
from dbdnet_jax.networks.stacking import Rows, over_pairs, pool, without_padding, zero_padding
from dbdnet_jax.ops.sampling import divisor
from dbdnet_jax.types import Answer, Cloud

HEAD_SLOPE = 0.01  # of the leaky ReLUs behind the encoder


@dataclass(frozen=True)
class INENetConfig:
    """The number of target points, and the widths of the layers.

    ``released`` takes the target's rows in the order given. That is chance in clouds of random
    order (the authors' own arrive sorted by the distance to where they are cropped); otherwise
    they are sorted by the distance to their centroid.
    """

    points: int = 717
    transform: tuple[int, ...] = (64, 128, 1024)
    transform_head: tuple[int, ...] = (512, 256)
    encoder: tuple[int, ...] = (64, 64, 128, 256)
    features: int = 1024
    mask: tuple[int, ...] = (1024, 512, 128, 128)
    threshold: tuple[int, ...] = (512, 256, 128)
    released: bool = False

    def __post_init__(self) -> None:
        """Refuse layers of nothing."""
        chains = self.transform, self.transform_head, self.encoder, self.mask, self.threshold
        if min(self.points, self.features) < 1 or any(not w or min(w) < 1 for w in chains):
            raise ValueError(
                "points and every width must be at least 1, and every chain have a layer; got "
                f"{self}. Start from {INENetConfig()}."
            )
        if len(self.encoder) != 4:
            raise ValueError(f"encoder must have four widths; got {self.encoder}.")


class Encoded(NamedTuple):
    """One cloud's features, and the matrices that its points and their features went through."""

    features: Float[Array, "*pairs n d"]
    input_transform: Float[Array, "*pairs 3 3"]
    feature_transform: Float[Array, "*pairs c c"]


class Found(NamedTuple):
    """Logits of the source's mask and of its threshold, and what they come from."""

    mask_logits: Float[Array, "*pairs n"]
    threshold_logit: Float[Array, "*pairs"]
    cosine: Float[Array, "*pairs m n"]
    residual: Float[Array, "*pairs d"]
    source: Encoded
    target: Encoded

    @property
    def margin(self) -> Float[Array, "*pairs n"]:
        """Mask minus threshold: a point is overlapping where it is not negative."""
        threshold = jax.nn.sigmoid(self.threshold_logit)[..., None]
        mask = jax.nn.sigmoid(self.mask_logits)
        return mask - jnp.broadcast_to(threshold, mask.shape)


class _Transform(nn.Module):
    """A square matrix from a whole cloud: the identity plus what a PointNet says."""

    config: INENetConfig

    @nn.compact
    def __call__(self, x: Array, valid: Array, training: bool) -> Array:
        width = x.shape[-1]
        x = Chain(self.config.transform, name="points")(x, training)[-1]
        x = pool(x, valid)
        x = Chain(self.config.transform_head, name="cloud")(x, training)[-1]
        x = Rows(width * width, name="matrix")(x).reshape(*x.shape[:-1], width, width)
        return x + jnp.broadcast_to(jnp.eye(width, dtype=x.dtype), x.shape)


class _Encoder(nn.Module):
    config: INENetConfig

    @nn.compact
    def __call__(self, cloud: Cloud, training: bool) -> Encoded:
        first, second, third, fourth = (
            DenseBatchNorm(width, bias=False, name=f"layer_{i}")
            for i, width in enumerate(self.config.encoder)
        )
        matrix = _Transform(self.config, name="input")(cloud.points, cloud.valid, training)
        a = first(cloud.points @ matrix, training)
        b = second(a, training)
        of_features = _Transform(self.config, name="feature")(b, cloud.valid, training)
        b = b @ of_features
        c = third(b, training)
        d = fourth(c, training)
        last = DenseBatchNorm(self.config.features, bias=False, name="point")
        x = last(jnp.concatenate([a, b, c, d], axis=-1), training)
        return Encoded(x, matrix, of_features)


class INENet(nn.Module):
    """The source's mask and its threshold, of one pair or of a stack of pairs."""

    config: INENetConfig

    @nn.compact
    def __call__(self, source: Cloud, target: Cloud, training: bool = False) -> Found:
        """With folded parameters; in training by the batch's statistics.

        These are of each cloud on its own, the source's first. The target must have the
        configuration's number of rows; those of its padding are like nothing.
        """
        config = self.config
        encoder = _Encoder(config, name="encoder")
        of_source, of_target = encoder(source, training), encoder(target, training)
        x, y = (
            zero_padding(_unit_rows(encoded.features), cloud.valid)
            for encoded, cloud in ((of_source, source), (of_target, target))
        )
        cosine = y @ jnp.swapaxes(x, -1, -2)
        masked = Chain(config.mask, slope=HEAD_SLOPE, name="mask")
        mask = Rows(1, name="mask_logit")(masked(jnp.swapaxes(cosine, -1, -2), training)[-1])
        residual = jnp.abs(
            _mean(of_source.features, source.valid) - _mean(of_target.features, target.valid)
        )
        chain = Chain(config.threshold, slope=HEAD_SLOPE, name="threshold")
        threshold = Rows(1, name="threshold_logit")(chain(residual, training)[-1])
        return Found(mask[..., 0], threshold[..., 0], cosine, residual, of_source, of_target)


def _unit_rows(x: Float[Array, "*rows d"]) -> Float[Array, "*rows d"]:
    """Every row divided by its length; zeros, where the authors divide by zero, stay zeros."""
    square = jnp.sum(x * x, axis=-1, keepdims=True)
    some = square > 0
    return jnp.where(some, x * jax.lax.rsqrt(jnp.where(some, square, 1.0)), 0.0)


def _mean(x: Float[Array, "*pairs n d"], valid: Array) -> Float[Array, "*pairs d"]:
    total = divisor(jnp.sum(valid, axis=-1), x.dtype)
    total_of_rows = jnp.sum(zero_padding(x, valid), axis=-2)
    return total_of_rows / jnp.broadcast_to(total[..., None], total_of_rows.shape)


def as_channels(cloud: Cloud, config: INENetConfig) -> Cloud:
    """The cloud in the role of the target: its rows in order, padded to the network's number."""
    rows = cloud.points.shape[-2]
    if rows > config.points:
        raise ValueError(
            f"INENet must be given at most {config.points} points, its number of channels; got "
            f"{rows}. Downsample the clouds, or train a network with points={rows}."
        )
    if not config.released:
        cloud = cloud._replace(
            points=over_pairs(_by_distance, cloud.points)(cloud.points, cloud.valid)
        )
    wider = [(0, 0)] * (cloud.points.ndim - 2) + [(0, config.points - rows), (0, 0)]
    return cloud._replace(points=jnp.pad(cloud.points, wider))


def _by_distance(points: Float[Array, "n 3"], valid: Array) -> Float[Array, "n 3"]:
    """Rows in the order of their distance to the centroid, padding last."""
    centroid = _mean(points, valid)
    square = jnp.sum((points - centroid[None, :]) ** 2, axis=-1)
    return points[jnp.argsort(jnp.where(valid, square, jnp.inf))]


def shapes(config: INENetConfig) -> Shapes:
    """Shape of every parameter."""
    found: Shapes = {}
    for name, width in (("input", 3), ("feature", config.encoder[1])):
        name = f"inenet/encoder/{name}"
        found |= chain_shapes(f"{name}/points", width, config.transform)
        found |= chain_shapes(f"{name}/cloud", config.transform[-1], config.transform_head)
        found |= affine_shapes(f"{name}/matrix", config.transform_head[-1], width * width)
    sizes = (3, *config.encoder)
    for i, (fan_in, width) in enumerate(zip(sizes[:-1], sizes[1:], strict=True)):
        found |= dense_batch_norm_shapes(f"inenet/encoder/layer_{i}", fan_in, width, bias=False)
    whole = sum(config.encoder)
    found |= dense_batch_norm_shapes("inenet/encoder/point", whole, config.features, bias=False)
    found |= chain_shapes("inenet/mask", config.points, config.mask)
    found |= affine_shapes("inenet/mask_logit", config.mask[-1], 1)
    found |= chain_shapes("inenet/threshold", config.features, config.threshold)
    return found | affine_shapes("inenet/threshold_logit", config.threshold[-1], 1)


def predict(params: Params, source: Cloud, target: Cloud) -> Answer:
    """The overlap of both clouds, each in turn the source: one half where mask is threshold."""
    config = params.config
    variables = {"params": fold(params.networks["inenet"])}
    clean = [without_padding(cloud) for cloud in (source, target)]

    def overlap(cloud: Cloud, other: Cloud) -> Array:
        found: Any = INENet(config).apply(variables, cloud, as_channels(other, config))
        return jnp.where(cloud.valid, 0.5 + 0.5 * found.margin, 0.0)

    return Answer(None, overlap(*clean), overlap(*clean[::-1]))
