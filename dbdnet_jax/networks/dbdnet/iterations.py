"""The registration network's iterations: match the selected clouds, solve, move, match again."""

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from dbdnet_jax.networks.dbdnet.config import ModelConfig
from dbdnet_jax.networks.dbdnet.frames import (
    centre_and_order,
    move_source,
    reordered,
    truncate_rows,
    uncentred,
)
from dbdnet_jax.networks.dbdnet.matching import soft_targets
from dbdnet_jax.networks.dbdnet.registration import RegistrationNetwork
from dbdnet_jax.networks.params import Params
from dbdnet_jax.ops import rigid
from dbdnet_jax.ops.rigid import HIGHEST
from dbdnet_jax.types import Cloud, Rigid


def iterate(
    params: Params,
    kept: Cloud,
    geometry: Float[Array, "2 n g"] | None,
    dropout_key: PRNGKeyArray | None,
    solves: int,
) -> tuple[Rigid, Array, Array, Array, Array]:
    """Run the registration network ``solves`` times on the selected clouds.

    Returns the motion, the last correspondences and soft targets of both branches (rows in the
    network's order), that order, and whether the last solve was determined.
    """
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
        ordered, order, skip_rows, centroid = centre_and_order(
            moved, config, config.registration_points
        )
        ordered, features = truncate_rows(ordered, config.registration_points), unmoved
        if features is None:
            around = reordered(geometry, order[:, : ordered.points.shape[1]])
            features = network.apply(variables, ordered, skip_rows, around, method="encode")
        matrix = jnp.asarray(network.apply(variables, ordered, features, key, method="match"))
        increment, targets, solvable = _solve(matrix, ordered, centroid, config)
        motion = rigid.compose(increment, motion)
        return motion, (increment, matrix, targets, order, solvable)

    keys = None if dropout_key is None else jax.random.split(dropout_key, solves)
    start = rigid.identity(kept.points.dtype)
    motion, steps = jax.lax.scan(once, start, keys, length=solves)
    increment, matrix, targets, order, solvable = jax.tree.map(lambda leaf: leaf[-1], steps)
    # Departure: the released code returns the last increment instead of the composed motion.
    return increment if config.released else motion, matrix, targets, order, solvable


def _solve(
    matrix: Float[Array, "2 n n"],
    ordered: Cloud,
    centroid: Float[Array, "2 3"],
    config: ModelConfig,
) -> tuple[Rigid, Float[Array, "2 n 3"], Bool[Array, ""]]:
    """R from the first branch's soft correspondences, t from the second's.

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
    of_translation, _ = rigid.procrustes(source, soft[1], weights[1])
    motion = uncentred(Rigid(of_rotation.rotation, of_translation.translation), centroid)
    finite = jnp.all(jnp.isfinite(motion.rotation)) & jnp.all(jnp.isfinite(motion.translation))
    determined = (singular[1] > 1e-6) & jnp.all(jnp.sum(weights, axis=1) > 1e-6)
    return motion, soft + centroid[None, 1:], finite & determined
