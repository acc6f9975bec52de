"""RIENet: features of edges, matches refined by neighbours, confidences, weighted Procrustes.

Three turns with the same weights; the source is moved after each, and gradients pass through all.
Neither pose nor overlap is told in training (see `dbdnet_jax.training.rienet`).
"""

from dataclasses import dataclass
from typing import NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from dbdnet_jax.networks.batch_norm import fold
from dbdnet_jax.networks.edge_features import EdgeFeatures, edge_features_shapes
from dbdnet_jax.networks.params import Params, Shapes
from dbdnet_jax.networks.rienet.confidence import Confidence, confidence_shapes
from dbdnet_jax.networks.stacking import move, neighbours, over_pairs, without_padding
from dbdnet_jax.ops import rigid
from dbdnet_jax.ops.grouping import squared_distances
from dbdnet_jax.types import Answer, Cloud, Rigid


@dataclass(frozen=True)
class RIENetConfig:
    """Widths, the neighbours of an edge (k1) and of a match (k2), and the match's margin.

    The defaults are the authors' for ModelNet40 in the categories seen; ``width=16`` for unseen
    ones.
    """

    k1: int = 5
    k2: int = 5
    margin: float = 0.7
    turns: int = 3
    edges: tuple[int, ...] = (32, 32, 64, 128)
    features: int = 256
    width: int = 8

    def __post_init__(self) -> None:
        """Refuse layers of nothing."""
        sizes = (self.k1, self.turns, self.features, self.width)
        if not self.edges or min(*self.edges, *sizes) < 1 or self.k2 < 2:
            raise ValueError(
                "Every width and number must be at least 1, and k2, which counts the point itself, "
                f"at least 2; got {self}. Start from {RIENetConfig()}."
            )


class Maps(NamedTuple):
    """How alike each source and target point are, a matrix each."""

    distance: Float[Array, "*pairs n m"]
    scores: Float[Array, "*pairs n m"]
    neighbour_scores: Float[Array, "*pairs n m"]
    refined: Float[Array, "*pairs n m"]


class Turn(NamedTuple):
    """One turn: the source before it, what moves it, and what speaks for it."""

    points: Float[Array, "*pairs n 3"]
    increment: Rigid
    confidence: Float[Array, "*pairs n"]
    correspondence: Float[Array, "*pairs n 3"]
    features: tuple[Float[Array, "*pairs n d"], Float[Array, "*pairs m d"]]
    maps: Maps


class RIENet(nn.Module):
    """All turns of one pair, or of a stack of pairs, and the source's neighbours."""

    config: RIENetConfig

    @nn.compact
    def __call__(
        self, source: Cloud, target: Cloud, training: bool = False
    ) -> tuple[list[Turn], Int[Array, "*pairs n k"]]:
        """With folded parameters; in training by the batch's statistics.

        These are of each cloud on its own, the source's first, anew in every turn.
        """
        config = self.config
        encoder = EdgeFeatures(config.edges, config.features, difference=True, name="encoder")
        confidence = Confidence(config.width, name="confidence")
        # A motion of the source changes no neighbour.
        near = [neighbours(cloud, max(config.k1, config.k2)) for cloud in (source, target)]
        edges = [index[..., : config.k1] for index in near]
        others = [index[..., 1 : config.k2] for index in near]
        turns, points, of_target = [], source.points, None
        for _ in range(config.turns):
            of_source = encoder(points, edges[0], training)
            if training or of_target is None:  # every use counts in the running averages
                of_target = encoder(target.points, edges[1], training)
            maps = _match(of_source, of_target, others, target, config.margin)
            correspondence = maps.refined @ target.points
            weights = confidence(points, correspondence, edges[0], training)
            weights = jnp.where(source.valid, weights, 0.0)
            solve = over_pairs(lambda x, y, w: rigid.procrustes(x, y, w)[0], points)
            increment = solve(points, correspondence, weights)
            turns.append(
                Turn(points, increment, weights, correspondence, (of_source, of_target), maps)
            )
            points = move(increment, points)
        return turns, edges[0]


def _match(
    of_source: Float[Array, "*pairs n d"],
    of_target: Float[Array, "*pairs m d"],
    others: list[Array],
    target: Cloud,
    margin: float,
) -> Maps:
    """Distances of the features, larger where the neighbours of both points do not match."""
    square = over_pairs(squared_distances, of_source)(of_source, of_target)
    # The root's derivative at 0 would be infinite: equal features.
    distance = jnp.where(square > 0, jnp.sqrt(jnp.where(square > 0, square, 1.0)), 0.0)
    seen = jnp.broadcast_to(target.valid[..., None, :], distance.shape)

    def soft(x: Array) -> Array:
        return jax.nn.softmax(jnp.where(seen, -x, jnp.finfo(x.dtype).min), axis=-1)

    scores = soft(distance)
    of_rows, of_columns = (_adjacency(index, scores.dtype) for index in others)
    neighbour_scores = of_rows @ scores @ jnp.swapaxes(of_columns, -1, -2) / others[0].shape[-1]
    refined = soft(jnp.exp(margin - neighbour_scores) * distance)
    return Maps(distance, scores, neighbour_scores, refined)


def _adjacency(index: Int[Array, "*pairs n k"], dtype: jnp.dtype) -> Float[Array, "*pairs n n"]:
    """One where the column is among the row's neighbours."""
    return jnp.sum(jax.nn.one_hot(index, index.shape[-2], dtype=dtype), axis=-2)


def pose_of(turns: list[Turn]) -> Rigid:
    """The motion of all turns together."""
    pose = turns[0].increment
    compose = over_pairs(rigid.compose, pose.rotation)
    for turn in turns[1:]:
        pose = compose(turn.increment, pose)
    return pose


def shapes(config: RIENetConfig) -> Shapes:
    """Shape of every parameter.

    The authors' files hold a second encoder and a fusion too, two thirds of their numbers, which
    nothing uses.
    """
    found = edge_features_shapes("rienet/encoder", config.edges, config.features, difference=True)
    return found | confidence_shapes("rienet/confidence", config.width)


def predict(params: Params, source: Cloud, target: Cloud) -> Answer:
    """The pose of one pair; the confidences are no probabilities of overlap."""
    return Answer(predict_pose(params, source, target))


def predict_pose(params: Params, source: Cloud, target: Cloud) -> Rigid:
    """The pose of one pair."""
    variables = {"params": fold(params.networks["rienet"])}
    clean = [without_padding(cloud) for cloud in (source, target)]
    turns, _ = RIENet(params.config).apply(variables, *clean)
    return pose_of(turns)
