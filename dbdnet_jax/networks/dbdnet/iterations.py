"""The registration network's iterations: match the selected clouds, solve, move, match again."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from dbdnet_jax.networks.dbdnet.config import ModelConfig
from dbdnet_jax.networks.dbdnet.frames import (
    centre_and_order,
    move_source,
    reordered,
    truncate_rows,
    uncentred,
)
from dbdnet_jax.networks.dbdnet.matching import soft_targets
from dbdnet_jax.networks.dbdnet.registration import Matches, RegistrationNetwork
from dbdnet_jax.networks.params import Params
from dbdnet_jax.ops import rigid
from dbdnet_jax.ops.grouping import interpolate, interpolation_weights
from dbdnet_jax.ops.rigid import HIGHEST
from dbdnet_jax.types import Cloud, Rigid


class Solved(NamedTuple):
    """What the iterations end with; rows as the last one ordered the selected clouds.

    ``order`` is that order, ``targets`` the soft targets of both branches, ``overlap`` the joint
    overlap's logits of all rows, and ``determined`` whether the last solve was.
    """

    motion: Rigid
    matches: Matches
    targets: Float[Array, "2 n 3"]
    order: Int[Array, "2 m"]
    overlap: Float[Array, "2 m"] | None
    determined: Bool[Array, ""]


def iterate(
    params: Params,
    kept: Cloud,
    geometry: Float[Array, "2 n g"] | None,
    dropout_key: PRNGKeyArray | None,
    solves: int,
) -> Solved:
    """Run the registration network ``solves`` times on the selected clouds."""
    config = params.config
    network = RegistrationNetwork(config)
    variables = {"params": params.registration}
    unmoved = None
    if config.released:
        # Departure: features of the unmoved source serve all iterations.
        ordered, _, skip_rows, _ = centre_and_order(kept, config, 0)
        unmoved = network.apply(variables, ordered, skip_rows, method="encode")

    def once(motion: Rigid, key: PRNGKeyArray | None) -> tuple[Rigid, tuple[Any, ...]]:
        moved = move_source(kept, motion)
        whole, order, skip_rows, centroid = centre_and_order(
            moved, config, config.registration_points
        )
        ordered, features = truncate_rows(whole, config.registration_points), unmoved
        if features is None:
            around = reordered(geometry, order[:, : ordered.points.shape[1]])
            features = network.apply(variables, ordered, skip_rows, around, method="encode")
        answer: Any = network.apply(variables, ordered, features, key, method="match")
        increment, targets, determined = _solve(answer.matrix, ordered, centroid, config)
        overlap = None if answer.overlap is None else _at_all(answer.overlap, ordered, whole)
        motion = rigid.compose(increment, motion)
        return motion, (increment, Solved(motion, answer, targets, order, overlap, determined))

    keys = None if dropout_key is None else jax.random.split(dropout_key, solves)
    start = rigid.identity(kept.points.dtype)
    _, steps = jax.lax.scan(once, start, keys, length=solves)
    increment, solved = jax.tree.map(lambda leaf: leaf[-1], steps)
    # Departure: the released code returns the last increment instead of the composed motion.
    return solved._replace(motion=increment) if config.released else solved


def _at_all(logits: Float[Array, "2 n"], seen: Cloud, whole: Cloud) -> Float[Array, "2 m"]:
    """Logits of the points seen, interpolated at all of them."""
    if seen.points.shape[1] == whole.points.shape[1]:
        return logits
    nearest = jax.vmap(interpolation_weights)(whole.points, seen.points, seen.count)
    return jax.vmap(interpolate)(logits[..., None], *nearest)[..., 0]


def _solve(
    matrix: Float[Array, "2 n n"],
    ordered: Cloud,
    centroid: Float[Array, "2 3"],
    config: ModelConfig,
) -> tuple[Rigid, Float[Array, "2 n 3"], Bool[Array, ""]]:
    """R from the first branch's soft correspondences, t from the second's, if there are two.

    The soft targets are returned in the target's own frame, centring undone.
    """
    source, target = ordered.points
    if config.released:
        # Departure: not divided by the row's mass, so slack pulls points to the origin, and every
        # kept row weighs the same.
        soft = jnp.matmul(matrix, target, precision=HIGHEST)
        valid = ordered.valid[0].astype(source.dtype)
        weights = jnp.broadcast_to(valid, matrix.shape[:2])
    else:
        soft, weights = jax.vmap(soft_targets, in_axes=(0, None))(matrix, target)
    of_rotation, singular = rigid.procrustes(source, soft[0], weights[0])
    of_translation = of_rotation
    if config.branches == 2:
        of_translation, _ = rigid.procrustes(source, soft[1], weights[1])
    motion = uncentred(Rigid(of_rotation.rotation, of_translation.translation), centroid)
    finite = jnp.all(jnp.isfinite(motion.rotation)) & jnp.all(jnp.isfinite(motion.translation))
    determined = (singular[1] > 1e-6) & jnp.all(jnp.sum(weights, axis=1) > 1e-6)
    return motion, soft + centroid[None, 1:], finite & determined
