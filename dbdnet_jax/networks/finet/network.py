"""FINet: features of both clouds in a branch for the rotation and one for the translation.

Four turns, each with weights of its own; what a turn hands to the next is cut from the gradient.
Both clouds are one batch for the batch norms: here as rows of one array, so that they may differ
in size. There is no mask.
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
from dbdnet_jax.networks.finet.encoder import BRANCHES, TwoBranches, two_branches_shapes
from dbdnet_jax.networks.params import Params, Shapes
from dbdnet_jax.networks.stacking import Rows, move, without_padding
from dbdnet_jax.types import Answer, Cloud, Rigid

SENSITIVE = 2  # turns whose features the sensitivity loss compares


@dataclass(frozen=True)
class FINetConfig:
    """Widths of the layers; the encoder exchanges after the layers ``exchanges``, counted from 1.

    ``released`` makes the passes over moved sources in every turn of the training, as the authors'
    code does; their results are used in the first two, elsewhere they only enter the running
    averages.
    """

    turns: int = 4
    encoder: tuple[int, ...] = (64, 64, 128, 256, 512)
    exchanges: tuple[int, ...] = (2, 4)
    fusion: tuple[int, ...] = (2048, 1024, 1024)
    regression: tuple[int, ...] = (2048, 1024, 512, 256)
    released: bool = False

    def __post_init__(self) -> None:
        """Refuse layers of nothing."""
        chains = self.encoder, self.fusion, self.regression
        if self.turns < 1 or any(not w or min(w) < 1 for w in chains):
            raise ValueError(
                "turns and every width must be at least 1, and every chain have a layer; got "
                f"{self}. Start from {FINetConfig()}."
            )
        places = (0, *self.exchanges, len(self.encoder))
        if any(a >= b for a, b in zip(places[:-1], places[1:], strict=True)):
            raise ValueError(
                f"exchanges must be increasing layers of the encoder's {len(self.encoder)}, all "
                f"but the last; got {self.exchanges}."
            )

    @property
    def parts(self) -> tuple[tuple[int, ...], ...]:
        """Widths of the encoder's layers between its exchanges."""
        places = (0, *self.exchanges, len(self.encoder))
        return tuple(self.encoder[a:b] for a, b in zip(places[:-1], places[1:], strict=True))


class Features(NamedTuple):
    """The two branches' features of the source and the target, in this order."""

    rotation: Float[Array, "*pairs 2 d"]
    translation: Float[Array, "*pairs 2 d"]


class Turn(NamedTuple):
    """One turn; ``pose`` includes its ``increment``.

    ``rotated`` and ``translated`` are the features after one half of the increment was applied to
    the source, ``dropped`` those without the points that were dropped; None where not asked for.
    """

    increment: QuaternionPose
    centres: Float[Array, "*pairs 2 3"]
    pose: QuaternionPose
    features: Features
    fused: Features
    rotated: Features | None
    translated: Features | None
    dropped: Features | None


class FINet(nn.Module):
    """All turns of one pair, or of a stack of pairs."""

    config: FINetConfig

    @nn.compact
    def __call__(
        self,
        source: Cloud,
        target: Cloud,
        keep: Bool[Array, "turns *pairs rows"] | None = None,
        training: bool = False,
        sensitive: bool = False,
    ) -> list[Turn]:
        """With folded parameters; in training by the statistics of both clouds together.

        ``keep`` says for every turn which rows, the source's and then the target's, stay in
        ``dropped``; ``sensitive`` asks for the passes over moved sources.
        """
        turns, points, pose = [], source.points, no_motion(source.points)
        for i in range(self.config.turns):
            passes = sensitive and (i < SENSITIVE or self.config.released)
            turn = _Turn(self.config, name=f"turn_{i}")(
                source._replace(points=points),
                target,
                pose,
                None if keep is None else keep[i],
                training,
                passes,
            )
            turns.append(turn)
            pose, points = turn.pose, move(jax.lax.stop_gradient(turn.increment.rigid), points)
        return turns


class _Turn(nn.Module):
    config: FINetConfig

    @nn.compact
    def __call__(
        self,
        source: Cloud,
        target: Cloud,
        pose: QuaternionPose,
        keep: Array | None,
        training: bool,
        passes: bool,
    ) -> Turn:
        encoder = TwoBranches(self.config.parts, name="encoder")
        found, dropped = encoder(source, target, keep, training)
        features = Features(*found)
        fused = []
        for branch, x in zip(BRANCHES, features, strict=True):
            both = jnp.concatenate([x, x[..., ::-1, :]], axis=-1)
            fused.append(Chain(self.config.fusion, name=f"fusion_{branch}")(both, training)[-1])
        increment, centres = self._regress(Features(*fused), training)
        rotated = translated = None
        if passes:
            there = jax.lax.stop_gradient(increment.rigid)
            nowhere = jnp.zeros_like(there.translation)
            turned = move(Rigid(there.rotation, nowhere), source.points)
            shifted = source.points + there.translation[..., None, :]
            rotated, translated = (
                Features(*encoder(source._replace(points=points), target, None, training)[0])
                for points in (turned, shifted)
            )
        return Turn(
            increment,
            centres,
            after(increment, pose),
            features,
            Features(*fused),
            rotated,
            translated,
            None if dropped is None else Features(*dropped),
        )

    def _regress(self, fused: Features, training: bool) -> tuple[QuaternionPose, Array]:
        """The rotation from everything, the translation as the difference of two centres."""
        (rotation_source, rotation_target), (shift_source, shift_target) = (
            (x[..., 0, :], x[..., 1, :]) for x in fused
        )
        everything = [shift_source, rotation_source, shift_target, rotation_target]
        chain = Chain(self.config.regression, name="regression_rotation")
        last = chain(jnp.concatenate(everything, axis=-1), training)[-1]
        q = unit(Rows(4, name="quaternion")(last))
        each = [
            jnp.concatenate(x, axis=-1)
            for x in (
                [shift_source, rotation_source, shift_target],
                [shift_target, rotation_target, shift_source],
            )
        ]
        chain = Chain(self.config.regression, name="regression_translation")
        last = chain(jnp.stack(each, axis=-2), training)[-1]
        centres = Rows(3, name="centre")(last)
        return QuaternionPose(q, centres[..., 1, :] - centres[..., 0, :]), centres


def shapes(config: FINetConfig) -> Shapes:
    """Shape of every parameter."""
    found: Shapes = {}
    width = sum(config.encoder)
    fused, last = config.fusion[-1], config.regression[-1]
    for i in range(config.turns):
        name = f"finet/turn_{i}"
        found |= two_branches_shapes(f"{name}/encoder", config.parts)
        for branch in BRANCHES:
            found |= chain_shapes(f"{name}/fusion_{branch}", 2 * width, config.fusion)
        found |= chain_shapes(f"{name}/regression_rotation", 4 * fused, config.regression)
        found |= affine_shapes(f"{name}/quaternion", last, 4)
        found |= chain_shapes(f"{name}/regression_translation", 3 * fused, config.regression)
        found |= affine_shapes(f"{name}/centre", last, 3)
    return found


def predict(params: Params, source: Cloud, target: Cloud) -> Answer:
    """The pose of one pair; FINet predicts no overlap."""
    return Answer(predict_pose(params, source, target))


def predict_pose(params: Params, source: Cloud, target: Cloud) -> Rigid:
    """The pose of one pair."""
    variables = {"params": fold(params.networks["finet"])}
    clean = [without_padding(cloud) for cloud in (source, target)]
    turns: Any = FINet(params.config).apply(variables, *clean)
    return turns[-1].pose.rigid
