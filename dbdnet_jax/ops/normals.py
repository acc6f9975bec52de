"""Normals estimated from one cloud itself."""

import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from dbdnet_jax.ops.grouping import knn
from dbdnet_jax.ops.rigid import HIGHEST


def estimate_normals(
    points: Float[Array, "n 3"], count: Int[Array, ""], k: int
) -> Float[Array, "n 3"]:
    """Unit normals: the flattest direction of each point's k nearest, itself among them.

    Their side is arbitrary, and so is the normal where the neighbours lie on a line or in one
    place. Rows of padding get a unit vector of no meaning. Not to be differentiated.
    """
    neighbours = points[knn(points, points, k, count)]
    offset = neighbours - jnp.mean(neighbours, axis=1, keepdims=True)
    covariance = jnp.einsum("nki,nkj->nij", offset, offset, precision=HIGHEST)
    return jnp.linalg.eigh(covariance)[1][:, :, 0]
