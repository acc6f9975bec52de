"""Unit quaternions (w, x, y, z): rotation matrices from them and to them, and their product."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray


def rotation_from_quaternion(q: Float[Array, "*stack 4"]) -> Float[Array, "*stack 3 3"]:
    """The rotation matrix of a unit quaternion; q and -q have the same."""
    w, x, y, z = (q[..., i] for i in range(4))
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return jnp.stack([jnp.stack(row, axis=-1) for row in rows], axis=-2)


def quaternion_from_rotation(rotation: Float[Array, "*stack 3 3"]) -> Float[Array, "*stack 4"]:
    """The unit quaternion of a rotation matrix whose w is not negative.

    Of the four ways to compute it (Shepperd 1978) the one with the largest divisor, so that no
    angle is badly conditioned. At 180 degrees w is 0 and the sign of the rest is arbitrary.
    """
    (a, b, c), (d, e, f), (g, h, i) = (
        tuple(rotation[..., r, k] for k in range(3)) for r in range(3)
    )
    candidates = jnp.stack(
        [
            jnp.stack([1 + a + e + i, h - f, c - g, d - b], axis=-1),
            jnp.stack([h - f, 1 + a - e - i, b + d, c + g], axis=-1),
            jnp.stack([c - g, b + d, 1 - a + e - i, f + h], axis=-1),
            jnp.stack([d - b, c + g, f + h, 1 - a - e + i], axis=-1),
        ],
        axis=-2,
    )
    largest = jnp.argmax(jnp.diagonal(candidates, axis1=-2, axis2=-1), axis=-1)
    q = jnp.take_along_axis(candidates, largest[..., None, None], axis=-2)[..., 0, :]
    q = q / jnp.linalg.norm(q, axis=-1, keepdims=True)
    return jnp.where(q[..., :1] < 0, -q, q)


def multiply(
    c_from_b: Float[Array, "*stack 4"], b_from_a: Float[Array, "*stack 4"]
) -> Float[Array, "*stack 4"]:
    """The quaternion c_from_a of the rotation ``b_from_a`` followed by ``c_from_b``."""
    w1, x1, y1, z1 = (c_from_b[..., i] for i in range(4))
    w2, x2, y2, z2 = (b_from_a[..., i] for i in range(4))
    return jnp.stack(
        [
            w1 * w2 - x1 * x2 - y1 * y2 - z1 * z2,
            w1 * x2 + x1 * w2 + y1 * z2 - z1 * y2,
            w1 * y2 - x1 * z2 + y1 * w2 + z1 * x2,
            w1 * z2 + x1 * y2 - y1 * x2 + z1 * w2,
        ],
        axis=-1,
    )


def any_rotation(key: PRNGKeyArray) -> Float[Array, "3 3"]:
    """A rotation, uniform over all: that of a random unit quaternion (Shoemake 1992)."""
    quaternion = jax.random.normal(key, (4,))
    return rotation_from_quaternion(quaternion / jnp.linalg.norm(quaternion))
