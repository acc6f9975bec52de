"""One pass of the overlap network over two clouds: over some of their points, the source moved."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PRNGKeyArray

from dbdnet_jax.networks.dbdnet.config import ModelConfig
from dbdnet_jax.networks.dbdnet.frames import (
    centre_and_order,
    geometry_of,
    move_source,
    reordered,
    truncate_rows,
    uncentred,
)
from dbdnet_jax.networks.dbdnet.matching import SoftMatches
from dbdnet_jax.networks.dbdnet.overlap import OverlapNetwork
from dbdnet_jax.networks.params import Params
from dbdnet_jax.ops import rigid
from dbdnet_jax.ops.grouping import interpolate, interpolation_weights
from dbdnet_jax.ops.pyramid import Pyramid, build_pyramids
from dbdnet_jax.ops.sampling import inverse_order
from dbdnet_jax.types import Cloud, Rigid


class PreparedPair(NamedTuple):
    """What all passes of the overlap network over two clouds share."""

    seen: Cloud  # stacked and centred, in farthest-point order, the points that the network sees
    centroid: Float[Array, "2 3"]
    pyramids: Pyramid  # of the clouds at rest: a motion changes no neighbours
    order: Int[Array, "2 n"]
    ordered: Cloud  # all points in that order
    nearest: tuple[Array, Array] | None  # of all points among the seen ones, to interpolate
    geometry: Float[Array, "2 m g"] | None  # of all points, in the clouds' own row order


def prepare_pair(config: ModelConfig, clouds: Cloud) -> PreparedPair:
    """Prepare two stacked clouds for any number of passes."""
    ordered, order, skip_rows, centroid = centre_and_order(clouds, config, config.overlap_points)
    seen = truncate_rows(ordered, config.overlap_points)
    pyramids = build_pyramids(seen, config.neighbours, skip_rows)
    nearest = None
    if seen.points.shape[1] < ordered.points.shape[1]:
        nearest = jax.vmap(interpolation_weights)(ordered.points, seen.points, seen.count)
    geometry = geometry_of(clouds, config)
    return PreparedPair(seen, centroid, pyramids, order, ordered, nearest, geometry)


def apply_overlap_network(
    params: Params, prepared: PreparedPair, start: Rigid, dropout_key: PRNGKeyArray | None = None
) -> tuple[Float[Array, "2 n"], SoftMatches | None]:
    """Logits of the points seen, and their matches in the clouds' own frames.

    ``start`` has moved the source; it is a motion between the centred clouds.
    """
    network = OverlapNetwork(params.config)
    moved = move_source(prepared.seen, start)
    variables = {"params": params.overlap}
    rows = prepared.order[:, : moved.points.shape[1]]
    geometry = reordered(prepared.geometry, rows)
    answer: Any = network.apply(variables, moved, prepared.pyramids, dropout_key, geometry)
    logits, matched = answer
    if matched is not None:
        own = prepared.seen._replace(points=prepared.seen.points + prepared.centroid[:, None, :])
        motion = uncentred(rigid.compose(matched.motion, start), prepared.centroid)
        matched = matched._replace(clouds=own, motion=motion)
    return logits, matched


def probability_of_all(prepared: PreparedPair, logits: Float[Array, "2 n"]) -> Float[Array, "2 m"]:
    """Overlap probability of all points, in the clouds' own row order; zero in the padding."""
    if prepared.nearest is not None:
        logits = jax.vmap(interpolate)(logits[..., None], *prepared.nearest)[..., 0]
    logits = jnp.take_along_axis(logits, jax.vmap(inverse_order)(prepared.order), axis=1)
    return jnp.where(prepared.ordered.valid, jax.nn.sigmoid(logits), 0.0)
