"""How the overlap network looks at two clouds: at some of their points, the source moved."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PRNGKeyArray

from dbdnet_jax.model.config import ModelConfig
from dbdnet_jax.model.matching import Matched
from dbdnet_jax.model.overlap import OverlapNetwork
from dbdnet_jax.model.params import Params
from dbdnet_jax.model.stack import (
    first_rows,
    geometry_of,
    move_source,
    prepare,
    reordered,
    uncentred,
)
from dbdnet_jax.ops import rigid
from dbdnet_jax.ops.grouping import interpolate, interpolation_weights
from dbdnet_jax.ops.pyramid import Pyramid, build_pyramids
from dbdnet_jax.ops.sampling import inverse_order, prefix_mask
from dbdnet_jax.types import Cloud, Rigid


class View(NamedTuple):
    """What all looks of the overlap network at two clouds share."""

    seen: Cloud  # stacked and centred, in farthest-point order, the points that the network sees
    centroid: Float[Array, "2 3"]
    pyramids: Pyramid  # of the clouds at rest: a motion changes no neighbours
    order: Int[Array, "2 n"]
    ordered: Cloud  # all points in that order
    nearest: tuple[Array, Array] | None  # of all points among the seen ones, to interpolate
    geometry: Float[Array, "2 m g"] | None  # of all points, in the clouds' own row order


def view_of(config: ModelConfig, clouds: Cloud) -> View:
    """Prepare two stacked clouds for any number of looks."""
    ordered, order, skip_rows, centroid = prepare(clouds, config, config.overlap_points)
    seen = first_rows(ordered, config.overlap_points)
    pyramids = build_pyramids(seen, config.neighbours, skip_rows)
    nearest = None
    if seen.points.shape[1] < ordered.points.shape[1]:
        nearest = jax.vmap(interpolation_weights)(ordered.points, seen.points, seen.count)
    return View(seen, centroid, pyramids, order, ordered, nearest, geometry_of(clouds, config))


def look(
    params: Params, view: View, start: Rigid, dropout_key: PRNGKeyArray | None = None
) -> tuple[Float[Array, "2 n"], Matched | None]:
    """Logits of the points seen, and their matches in the clouds' own frames.

    ``start`` has moved the source; it is a motion between the centred clouds.
    """
    network = OverlapNetwork(params.config)
    moved = move_source(view.seen, start)
    variables = {"params": params.overlap}
    rows = view.order[:, : moved.points.shape[1]]
    geometry = reordered(view.geometry, rows)
    answer: Any = network.apply(variables, moved, view.pyramids, dropout_key, geometry)
    logits, matched = answer
    if matched is not None:
        own = view.seen._replace(points=view.seen.points + view.centroid[:, None, :])
        motion = uncentred(rigid.compose(matched.motion, start), view.centroid)
        matched = matched._replace(clouds=own, motion=motion)
    return logits, matched


def probability_of_all(view: View, logits: Float[Array, "2 n"]) -> Float[Array, "2 m"]:
    """Overlap probability of all points, in the clouds' own row order; zero in the padding."""
    size = view.ordered.points.shape[1]
    if view.nearest is not None:
        logits = jax.vmap(interpolate)(logits[..., None], *view.nearest)[..., 0]
    valid = jax.vmap(lambda count: prefix_mask(size, count))(view.ordered.count)
    logits = jnp.take_along_axis(logits, jax.vmap(inverse_order)(view.order), axis=1)
    return jnp.where(valid, jax.nn.sigmoid(logits), 0.0)
