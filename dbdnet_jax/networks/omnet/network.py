"""OMNet: masked global features of both clouds, a mask of each and the pose, four times over.

Every turn has weights of its own, and what it hands to the next is cut from the gradient. The
released code needs clouds of equal sizes; nothing in the mathematics does, so this does not.
"""

from dataclasses import dataclass
from typing import Any, NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from dbdnet_jax.networks.batch_norm import fold
from dbdnet_jax.networks.blocks import affine_shapes
from dbdnet_jax.networks.chains import Chain, QuaternionPose, after, chain_shapes, no_motion, unit
from dbdnet_jax.networks.params import Params, Shapes
from dbdnet_jax.networks.stacking import (
    Rows,
    move,
    pool,
    to_every_row,
    without_padding,
    zero_padding,
)
from dbdnet_jax.types import Answer, Cloud

CLASSES = 2  # of a point: without and with a counterpart
DELAY = 2  # turns that see all points: the masks of the first are never used


@dataclass(frozen=True)
class OMNetConfig:
    """Widths of the layers; ``encoder`` is kept after ``kept`` layers, and after the last."""

    turns: int = 4
    encoder: tuple[int, ...] = (64, 64, 64, 128, 1024)
    kept: int = 2
    fusion: tuple[int, ...] = (1024, 1024, 512)
    decoder: tuple[int, ...] = (512, 256, 256)
    regression: tuple[int, ...] = (2048, 1024, 512, 256)

    def __post_init__(self) -> None:
        """Refuse layers of nothing."""
        chains = self.encoder, self.fusion, self.decoder, self.regression
        if self.turns < 1 or any(not widths or min(widths) < 1 for widths in chains):
            raise ValueError(
                "turns and every width must be at least 1, and every chain have a layer; got "
                f"{self}. Start from {OMNetConfig()}."
            )
        if not 1 <= self.kept <= len(self.encoder):
            raise ValueError(
                f"kept must be one of the encoder's {len(self.encoder)} layers, from 1; got "
                f"{self.kept}."
            )


class Turn(NamedTuple):
    """One turn; two arrays are the source's and the target's.

    ``pose`` includes this turn's ``increment``; ``logits`` are of the points' classes,
    ``masks`` those that it was given, ``own``, ``fused`` features of points, ``pooled`` of clouds.
    """

    increment: QuaternionPose
    pose: QuaternionPose
    logits: list[Array]
    masks: tuple[Bool[Array, "*pairs n"], Bool[Array, "*pairs m"]]
    own: list[Array]
    pooled: list[Array]
    fused: list[Array]
    regressed: Float[Array, "*pairs f"]


class OMNet(nn.Module):
    """All turns of one pair, or of a stack of pairs."""

    config: OMNetConfig

    @nn.compact
    def __call__(self, source: Cloud, target: Cloud, training: bool = False) -> list[Turn]:
        """With folded parameters; in training by the batch's statistics, masked points included.

        These are of each cloud on its own, the source's first.
        """
        turns: list[Turn] = []
        pose, points = no_motion(source.points), source.points
        for i in range(self.config.turns):
            valid = source.valid, target.valid
            masks = valid
            if i >= DELAY:
                chosen = [logits[..., 1] > logits[..., 0] for logits in turns[-1].logits]
                masks = chosen[0] & valid[0], chosen[1] & valid[1]
            turn = _Turn(self.config, name=f"turn_{i}")(
                (points, target.points), masks, pose, training
            )
            turns.append(turn)
            increment = jax.lax.stop_gradient(turn.increment.rigid)
            pose, points = turn.pose, move(increment, points)
        return turns


class _Turn(nn.Module):
    config: OMNetConfig

    @nn.compact
    def __call__(
        self,
        clouds: tuple[Array, Array],
        masks: tuple[Array, Array],
        pose: QuaternionPose,
        training: bool,
    ) -> Turn:
        config = self.config
        encoder = Chain(config.encoder, name="encoder")
        fusion = Chain(config.fusion, name="fusion")
        decoder = Chain(config.decoder, name="decoder")
        classes = Rows(CLASSES, name="classes")
        layers = [encoder(points, training) for points in clouds]
        own = [
            zero_padding(x[config.kept - 1], mask) for x, mask in zip(layers, masks, strict=True)
        ]
        # The feature of an empty mask is zeros, the floor of a ReLU, as masked rows are in theirs.
        pooled = [pool(x[-1], mask) for x, mask in zip(layers, masks, strict=True)]
        fused, logits, regressed = [], [], []
        for c in (0, 1):
            wide = [to_every_row(x, own[c].shape[-2]) for x in (pooled[c], pooled[1 - c])]
            x = fusion(jnp.concatenate([own[c], *wide], axis=-1), training)[-1]
            fused.append(zero_padding(x, masks[c]))
        for c in (0, 1):
            decoded = decoder(fused[c], training)
            logits.append(classes(decoded[-1]))
            seen = [fused[c], *decoded]
            regressed.append(pool(jnp.concatenate(seen, axis=-1), masks[c]))
        both = jnp.concatenate(regressed, axis=-1)
        last = Chain(config.regression, name="regression")(both, training)[-1]
        found = Rows(7, name="pose")(last)
        increment = QuaternionPose(unit(found[..., :4]), found[..., 4:])
        pose = after(increment, pose)
        return Turn(increment, pose, logits, masks, own, pooled, fused, both)


def shapes(config: OMNetConfig) -> Shapes:
    """Shape of every parameter."""
    found: Shapes = {}
    encoded, fused = config.encoder[-1], config.fusion[-1]
    for i in range(config.turns):
        name = f"omnet/turn_{i}"
        wide = config.encoder[config.kept - 1] + 2 * encoded
        found |= chain_shapes(f"{name}/encoder", 3, config.encoder)
        found |= chain_shapes(f"{name}/fusion", wide, config.fusion)
        found |= chain_shapes(f"{name}/decoder", fused, config.decoder)
        found |= affine_shapes(f"{name}/classes", config.decoder[-1], CLASSES)
        both = 2 * (fused + sum(config.decoder))
        found |= chain_shapes(f"{name}/regression", both, config.regression)
        found |= affine_shapes(f"{name}/pose", config.regression[-1], 7)
    return found


def predict(params: Params, source: Cloud, target: Cloud) -> Answer:
    """The pose of one pair, and the overlap that the last turn sees."""
    variables = {"params": fold(params.networks["omnet"])}
    clean = [without_padding(cloud) for cloud in (source, target)]
    turns: Any = OMNet(params.config).apply(variables, *clean)
    last = turns[-1]
    source_overlap, target_overlap = (
        jnp.where(cloud.valid, jax.nn.softmax(logits, axis=-1)[..., 1], 0.0)
        for cloud, logits in zip((source, target), last.logits, strict=True)
    )
    return Answer(last.pose.rigid, source_overlap, target_overlap)
