"""The multi-resolution encoder: four levels that exchange features after every stage."""

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from dbdnet_jax.networks.blocks import Exchange, exchange_shapes
from dbdnet_jax.networks.dbdnet.config import ModelConfig
from dbdnet_jax.networks.dbdnet.dgcnn import DGCNN, dgcnn_shapes
from dbdnet_jax.networks.edgeconv import EdgeConv, edgeconv_shapes
from dbdnet_jax.networks.params import Shapes
from dbdnet_jax.ops.grouping import knn
from dbdnet_jax.ops.pyramid import LEVELS, Pyramid, query_down

GROUPS = (4, 4, 8, 8)  # of the group norms at levels 1 to 4


class Encoder(nn.Module):
    """A point-wise feature of four times ``channels`` (paper, section III-A).

    Stage s holds levels 1 to s and opens the next one by transition-down; in the names, as in
    the released checkpoints, levels and stages count from 1.
    """

    channels: int
    neighbour_space: str

    @nn.compact
    def __call__(
        self,
        points: Float[Array, "n 3"],
        pyramid: Pyramid,
        geometry: Float[Array, "n g"] | None = None,
    ) -> Float[Array, "n d"]:
        """Encode one cloud in farthest-point order; the pyramid may be of the cloud at rest.

        ``geometry`` holds what else is known of each point (`ops.local_geometry`).
        """
        history: list[list[jax.Array]] = [[] for _ in range(LEVELS)]
        features = [points if geometry is None else jnp.concatenate([points, geometry], axis=-1)]
        for stage in range(1, LEVELS + 1):
            features = [
                self._edgeconv(stage, level, x, pyramid, points if stage == 1 else x)
                for level, x in enumerate(features)
            ]
            for level, x in enumerate(features):
                history[level].append(x)
            features = self._exchange(f"stage{stage}", features, pyramid)
        for level, x in enumerate(features):
            history[level].append(x)
        fused = [
            Exchange(self._width(level), name=f"fusion_{level + 1}").down(jnp.concatenate(xs, -1))
            for level, xs in enumerate(history)
        ]
        necks = [
            Exchange(self.channels, name=f"neck_{level + 1}").up(
                fused[level], *pyramid.up[0][level - 1]
            )
            for level in range(1, LEVELS)
        ]
        return jnp.concatenate([fused[0], *necks], axis=-1)

    def _width(self, level: int) -> int:
        return self.channels << level

    def _edgeconv(
        self, stage: int, level: int, x: jax.Array, pyramid: Pyramid, place: jax.Array
    ) -> jax.Array:
        """EdgeConv over rows near in ``place``: coordinates in the first stage, then features."""
        here = pyramid.levels[level]
        index = here.neighbours
        if self.neighbour_space == "feature":
            index = knn(place, place, index.shape[1], here.count)
        name = f"stage{stage}_conv{level + 1}"
        layer = EdgeConv(self._width(level), GROUPS[level], of_points=stage == 1, name=name)
        return layer(x, index, here.valid)

    def _exchange(self, stage: str, features: list[jax.Array], pyramid: Pyramid) -> list:
        """Every level adds all others; the next level, if there is one, is opened."""
        opened = len(features)
        result = []
        for level in range(min(opened + 1, LEVELS)):
            parts = [features[level]] if level < opened else []
            for other, x in enumerate(features):
                if other == level:
                    continue
                direction = "up" if other > level else "down"
                name = f"{stage}_{direction}_{other + 1}_{level + 1}"
                move = Exchange(self._width(level), name=name)
                if other > level:
                    parts.append(move.up(x, *pyramid.up[level][other - level - 1]))
                elif level == opened and other == level - 1:
                    rows = len(pyramid.levels[level].valid)
                    parts.append(move.pool(x, pyramid.levels[other].neighbours[:rows]))
                else:
                    parts.append(move.down(query_down(x, pyramid, other, level)))
            result.append(sum(parts[1:], parts[0]))
        return result


def make_encoder(config: ModelConfig, channels: int, name: str | None = None) -> nn.Module:
    """The encoder of this width that a configuration has."""
    kind = DGCNN if config.encoder == "dgcnn" else Encoder
    return kind(channels, config.neighbour_space, name=name)


def encoder_shapes(name: str, config: ModelConfig, channels: int) -> Shapes:
    """The parameters of `make_encoder`."""
    shapes = dgcnn_shapes if config.encoder == "dgcnn" else _multiresolution_shapes
    return shapes(name, channels, config.inputs)


def _multiresolution_shapes(name: str, channels: int, inputs: int) -> Shapes:
    """The parameters of an `Encoder` that is given so many numbers of each point."""
    widths = [channels << level for level in range(LEVELS)]
    shapes: Shapes = {}
    for stage in range(1, LEVELS + 1):
        for level, width in enumerate(widths[:stage]):
            fan_in = width if stage > 1 else inputs
            shapes |= edgeconv_shapes(f"{name}/stage{stage}_conv{level + 1}", fan_in, width)
        for level, width in enumerate(widths[: stage + 1]):
            for other, fan_in in enumerate(widths[:stage]):
                if other != level:
                    move = f"{'up' if other > level else 'down'}_{other + 1}_{level + 1}"
                    shapes |= exchange_shapes(f"{name}/stage{stage}_{move}", fan_in, width)
    for level, width in enumerate(widths):
        # What is fused: the level's output of every stage that holds it and the last exchange's.
        fused = (LEVELS + 1 - level) * width
        shapes |= exchange_shapes(f"{name}/fusion_{level + 1}", fused, width)
        if level:
            shapes |= exchange_shapes(f"{name}/neck_{level + 1}", width, channels)
    return shapes
