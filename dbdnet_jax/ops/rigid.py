"""Rigid motions: apply, compose, invert, draw, and estimate from weighted point pairs."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from dbdnet_jax.types import Rigid

# Distances, covariances and motions are computed at full precision: TF32 on a GPU keeps ten bits
# of the mantissa, which is a millimetre in a metre.
HIGHEST = jax.lax.Precision.HIGHEST


def identity(dtype: jnp.dtype = jnp.float32) -> Rigid:
    """The motion that moves nothing."""
    return Rigid(jnp.eye(3, dtype=dtype), jnp.zeros(3, dtype))


def apply(b_from_a: Rigid, points: Float[Array, "n 3"]) -> Float[Array, "n 3"]:
    """Move points of frame a into frame b: ``rotation @ x + translation`` for every row."""
    rotated = jnp.matmul(points, b_from_a.rotation.T, precision=HIGHEST)
    return rotated + b_from_a.translation[None, :]


def compose(c_from_b: Rigid, b_from_a: Rigid) -> Rigid:
    """The motion c_from_a that applies ``b_from_a`` first and ``c_from_b`` after it."""
    rotation = jnp.matmul(c_from_b.rotation, b_from_a.rotation, precision=HIGHEST)
    translation = jnp.matmul(c_from_b.rotation, b_from_a.translation, precision=HIGHEST)
    return Rigid(rotation, translation + c_from_b.translation)


def invert(b_from_a: Rigid) -> Rigid:
    """The motion a_from_b that undoes ``b_from_a``."""
    rotation = b_from_a.rotation.T
    return Rigid(rotation, -jnp.matmul(rotation, b_from_a.translation, precision=HIGHEST))


def rotation_from_euler(angles: Float[Array, "3"]) -> Float[Array, "3 3"]:
    """The rotation ``Rz(c) Ry(b) Rx(a)`` of Euler angles (a, b, c) in radians.

    SciPy calls the same convention extrinsic: ``Rotation.from_euler("xyz", angles)``.
    """
    (ca, cb, cc), (sa, sb, sc) = jnp.cos(angles), jnp.sin(angles)
    return jnp.stack(
        [
            jnp.stack([cc * cb, cc * sb * sa - sc * ca, cc * sb * ca + sc * sa]),
            jnp.stack([sc * cb, sc * sb * sa + cc * ca, sc * sb * ca - cc * sa]),
            jnp.stack([-sb, cb * sa, cb * ca]),
        ]
    )


def cross_matrix(vectors: Float[Array, "*stack 3"]) -> Float[Array, "*stack 3 3"]:
    """The matrix of each vector: ``cross_matrix(v) @ x`` is ``v x x``."""
    x, y, z = (vectors[..., i] for i in range(3))
    zero = jnp.zeros_like(x)
    rows = [jnp.stack(row, axis=-1) for row in ((zero, -z, y), (z, zero, -x), (-y, x, zero))]
    return jnp.stack(rows, axis=-2)


def rotation_about(axis: Float[Array, "3"], angle: Float[Array, ""]) -> Float[Array, "3 3"]:
    """Rotation about a unit axis by an angle in radians (Rodrigues' formula)."""
    cross = cross_matrix(axis)
    square = jnp.matmul(cross, cross, precision=HIGHEST)
    return jnp.eye(3, dtype=axis.dtype) + jnp.sin(angle) * cross + (1 - jnp.cos(angle)) * square


def random_rigid(key: PRNGKeyArray, max_angle: float, max_translation: float) -> Rigid:
    """A motion with Euler angles in [-max_angle, max_angle] (radians) and bounded translation.

    Each angle and each translation component is uniform and independent (the protocol of DCP,
    Wang & Solomon 2019, and of the paper).
    """
    angle_key, translation_key = jax.random.split(key)
    angles = jax.random.uniform(angle_key, (3,), minval=-max_angle, maxval=max_angle)
    translation = jax.random.uniform(
        translation_key, (3,), minval=-max_translation, maxval=max_translation
    )
    return Rigid(rotation_from_euler(angles), translation)


@jax.custom_vjp
def rotation_from_covariance(
    covariance: Float[Array, "3 3"],
) -> tuple[Float[Array, "3 3"], Float[Array, "3"]]:
    """The rotation R that maximises ``trace(R @ covariance)``, and singular values (Kabsch 1976).

    ``covariance`` is ``sum_i w_i s_i q_i^T`` for R moving s onto q. Always a rotation (det +1);
    its derivative is written out below and stays finite where the singular vectors are not
    unique (coplanar, collinear or vanishing input). No derivative passes through the singular
    values, largest first.
    """
    return _rotation_fwd(covariance)[0]


def _kabsch(
    covariance: Float[Array, "3 3"],
) -> tuple[Float[Array, "3 3"], Float[Array, "3 3"], Float[Array, "3"]]:
    """The rotation, V, and the signed singular values (s1, s2, d s3), largest first."""
    u, singular, vt = jnp.linalg.svd(covariance)
    sign = jnp.sign(jnp.linalg.det(u) * jnp.linalg.det(vt))
    signs = jnp.stack([jnp.ones_like(sign), jnp.ones_like(sign), sign])
    v = vt.T
    rotation = jnp.matmul(v * signs[None, :], u.T, precision=HIGHEST)
    return rotation, v, singular * signs


def _rotation_fwd(
    covariance: Float[Array, "3 3"],
) -> tuple[tuple[Array, Array], tuple[Array, Array, Array]]:
    rotation, v, signed = _kabsch(covariance)
    return (rotation, jnp.abs(signed)), (rotation, v, signed)


def _rotation_bwd(
    residual: tuple[Array, Array, Array], cotangents: tuple[Array, Array]
) -> tuple[Float[Array, "3 3"]]:
    """-2 R^T V [(V^T A V)_ij / (b_i + b_j)] V^T with A = (G R^T - R G^T) / 2.

    ``b_i + b_j`` vanishes where the rotation about an axis is undetermined (collinear input, or
    a reflection with equal smallest values); it is clamped there, since only a bounded step along
    such an axis is of use.
    """
    rotation, v, b = residual
    generator = jnp.matmul(cotangents[0], rotation.T, precision=HIGHEST)
    generator = 0.5 * (generator - generator.T)
    inner = jnp.matmul(jnp.matmul(v.T, generator, precision=HIGHEST), v, precision=HIGHEST)
    gap = b[:, None] + b[None, :]
    # A covariance of zero has no scale of its own; dividing by a tiny one would overflow.
    floor = 1e-4 * jnp.where(b[0] > 0, b[0], 1.0)
    inner = inner / jnp.maximum(gap, floor)
    left = jnp.matmul(rotation.T, v, precision=HIGHEST)
    return (-2.0 * jnp.matmul(jnp.matmul(left, inner, precision=HIGHEST), v.T, precision=HIGHEST),)


rotation_from_covariance.defvjp(_rotation_fwd, _rotation_bwd)


def procrustes(
    source: Float[Array, "n 3"], target: Float[Array, "n 3"], weights: Float[Array, " n"]
) -> tuple[Rigid, Float[Array, "3"]]:
    """The rigid motion minimising ``sum_i w_i |R s_i + t - q_i|^2`` (Kabsch 1976).

    Returns ``target_from_source`` and the singular values of the normalised covariance, largest
    first: the second one is near zero where the rotation is not determined (collinear or equal
    points). Always a rotation (det +1). Weights need not sum to one; where they sum to zero the
    motion is the identity. There, and for collinear, coplanar and identical points, value and
    gradient are finite.
    """
    total = jnp.sum(weights)
    # Below, the derivative of the quotient (1 / total^2) would overflow.
    enough = total > jnp.finfo(weights.dtype).tiny ** 0.5
    weights = jnp.where(enough, weights, 0.0) / jnp.where(enough, total, 1.0)
    source_centroid = jnp.matmul(weights, source, precision=HIGHEST)
    target_centroid = jnp.matmul(weights, target, precision=HIGHEST)
    weighted = (target - target_centroid[None, :]) * weights[:, None]
    covariance = jnp.matmul((source - source_centroid[None, :]).T, weighted, precision=HIGHEST)
    # The rotation does not depend on the covariance's scale; the clamps of its derivative do.
    scale = jax.lax.stop_gradient(jnp.max(jnp.abs(covariance)))
    covariance = covariance / jnp.where(scale > 0, scale, 1)
    rotation, singular = rotation_from_covariance(covariance)
    translation = target_centroid - jnp.matmul(rotation, source_centroid, precision=HIGHEST)
    return Rigid(rotation, translation), singular
