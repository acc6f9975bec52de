"""Two clouds as the one stack that the networks see, and the way back to their own frames."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from dbdnet_jax.networks.dbdnet.config import ModelConfig
from dbdnet_jax.ops import rigid
from dbdnet_jax.ops.local_geometry import local_geometry
from dbdnet_jax.ops.rigid import HIGHEST
from dbdnet_jax.ops.sampling import (
    divisor,
    farthest_order,
    inverse_order,
    prefix_mask,
    prefix_order,
)
from dbdnet_jax.types import Cloud, Rigid

FEWEST_ROWS = 8  # of a stack: the coarsest of four levels has one row


def pad_rows(x: jax.Array, size: int) -> jax.Array:
    """Pad the rows of ``x`` with zeros to ``size``."""
    return jnp.pad(x, [(0, size - x.shape[0])] + [(0, 0)] * (x.ndim - 1))


def stack_clouds(source: Cloud, target: Cloud) -> Cloud:
    """Two clouds of any static sizes as one stack; padding, as everywhere, changes nothing."""
    size = max(source.points.shape[0], target.points.shape[0], FEWEST_ROWS)
    points = jnp.stack([pad_rows(source.points, size), pad_rows(target.points, size)])
    if points.dtype != jnp.float64:  # half precision, and whole numbers
        points = points.astype(jnp.float32)
    return Cloud(points, jnp.stack([jnp.asarray(source.count), jnp.asarray(target.count)]))


def stack_masked(
    src: Float[Array, "n 3"],
    tgt: Float[Array, "m 3"],
    src_mask: Bool[Array, " n"] | None,
    tgt_mask: Bool[Array, " m"] | None,
) -> tuple[Cloud, Int[Array, "2 rows"]]:
    """Stack two clouds with masks; ``order[c, row]`` is the caller's row of a stacked row."""
    size = max(src.shape[0], tgt.shape[0], FEWEST_ROWS)
    masks = [
        pad_rows(jnp.ones(x.shape[0], bool) if mask is None else mask, size)
        for x, mask in ((src, src_mask), (tgt, tgt_mask))
    ]
    keep = jnp.stack(masks)
    order = jax.vmap(prefix_order)(keep)
    source, target = (Cloud(x, jnp.asarray(x.shape[0])) for x in (src, tgt))
    points = jnp.take_along_axis(stack_clouds(source, target).points, order[..., None], axis=1)
    return Cloud(points, jnp.sum(keep, axis=1)), order


def geometry_of(clouds: Cloud, config: ModelConfig) -> Float[Array, "2 n g"] | None:
    """`ops.local_geometry` of both clouds, from all of their points; None where none is seen.

    No rigid motion changes it: found once, it serves every turn and every start.
    """
    if not config.local_geometry:
        return None
    return jax.lax.map(
        lambda one: local_geometry(one.points, one.count, config.local_geometry), clouds
    )


def reordered(
    geometry: Float[Array, "2 n g"] | None, order: Int[Array, "2 m"]
) -> Float[Array, "2 m g"] | None:
    """The rows of ``geometry`` that ``order`` names for each cloud."""
    if geometry is None:
        return None
    return jnp.take_along_axis(geometry, order[..., None], axis=1)


def centre_and_order(
    clouds: Cloud, config: ModelConfig, limit: int
) -> tuple[Cloud, Int[Array, "2 n"], Int[Array, "2 n"] | None, Float[Array, "2 3"]]:
    """Centre both clouds and bring them into farthest-point order.

    ``limit`` rows are sampled; half of the points where it is 0.

    Returns the clouds, the order, the released code's rows for query-down, and the centroids.
    What stands in the padding is overwritten, so that it cannot matter from here on.
    """
    valid = clouds.valid[..., None]
    points = jnp.where(valid, clouds.points, 0.0)
    centroid = jnp.sum(points, axis=1) / divisor(clouds.count, points.dtype)[:, None]
    if config.released:
        centroid = jnp.zeros_like(centroid)  # departure: the released network sees raw coordinates
    points = jnp.where(valid, points - centroid[:, None, :], 0.0)
    fixed = jax.lax.stop_gradient(points), clouds.count
    order = jax.lax.map(lambda cloud: farthest_order(cloud[0], cloud[1], limit), fixed)
    ordered = Cloud(jnp.take_along_axis(points, order[..., None], axis=1), clouds.count)
    skip_rows = jax.vmap(inverse_order)(order) if config.released else None
    return ordered, order, skip_rows, centroid


def truncate_rows(clouds: Cloud, limit: int) -> Cloud:
    """The first ``limit`` rows of both clouds; all of them where it is 0."""
    if not limit:
        return clouds
    return Cloud(clouds.points[:, :limit], jnp.minimum(clouds.count, limit))


def select(
    probability: Float[Array, " n"], count: Int[Array, ""], threshold: float, at_least: int
) -> tuple[Int[Array, " n"], Int[Array, ""]]:
    """Row order and count of the points that enter registration.

    The rows above the threshold in their given order or, where fewer than ``at_least`` pass, the
    ``at_least`` most probable ones in descending order (the released code's rule for a batch of
    one, here for any batch).
    """
    probability = jnp.where(prefix_mask(probability.shape[0], count), probability, -1.0)
    keep = probability > threshold
    enough = jnp.sum(keep) >= at_least
    order = jnp.where(enough, prefix_order(keep), jnp.argsort(-probability, stable=True))
    kept = jnp.sum(keep).astype(jnp.result_type(count))
    return order, jnp.where(enough, kept, jnp.minimum(at_least, count))


def move_source(clouds: Cloud, motion: Rigid) -> Cloud:
    """The stacked clouds with the first one moved."""
    return clouds._replace(points=clouds.points.at[0].set(rigid.apply(motion, clouds.points[0])))


def centred(motion: Rigid, centroid: Float[Array, "2 3"]) -> Rigid:
    """A motion between clouds as one between the same clouds centred."""
    return uncentred(motion, -centroid)


def uncentred(motion: Rigid, centroid: Float[Array, "2 3"]) -> Rigid:
    """A motion between centred clouds as one between the clouds themselves."""
    shift = centroid[1] - jnp.matmul(motion.rotation, centroid[0], precision=HIGHEST)
    return Rigid(motion.rotation, motion.translation + shift)
