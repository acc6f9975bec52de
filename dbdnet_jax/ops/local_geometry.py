"""The surface around each point of one cloud, in numbers that no rigid motion changes.

The encoder sees the coordinates of some points of a cloud; these numbers say what *all* of its
points look like around each of them, and so tell points apart whatever the rotation. Not in the
paper (`ModelConfig.local_geometry`).
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from dbdnet_jax.ops.grouping import squared_distances
from dbdnet_jax.ops.rigid import HIGHEST
from dbdnet_jax.ops.sampling import divisor, prefix_mask

RADII = (0.06, 0.12, 0.24, 0.48, 0.96)  # each twice the one before: one bell is a power of another
DEVIATION = 0.6  # of the Gaussian weights, in radii
FEATURES = 8  # for each radius, in the order of `local_invariants`
WEIGHT = 0.3  # of the standardised numbers, beside coordinates in the unit sphere
# Mean and deviation of the eight numbers at each radius over noisy protocol clouds of the training
# shapes (`python -m tools.measure_local_geometry`).
# The last one's mean is 0 by symmetry.
MEAN = (
    (0.5262, 0.2728, 0.1324, 0.2276, -5.341, 0.09194, 0.1971, 0.0),
    (0.6332, 0.333, 0.1605, 0.2429, -4.062, 0.0967, 0.2033, 0.0),
    (0.5812, 0.3038, 0.1454, 0.2788, -2.717, 0.1076, 0.208, 0.0),
    (0.4323, 0.2223, 0.1055, 0.3338, -1.512, 0.1234, 0.2163, 0.0),
    (0.2197, 0.1079, 0.04947, 0.3279, -0.6282, 0.1008, 0.1758, 0.0),
)
SPREAD = (
    (0.1669, 0.09856, 0.06002, 0.09933, 0.7083, 0.04408, 0.05773, 0.01337),
    (0.1487, 0.09235, 0.06118, 0.1168, 0.7473, 0.04893, 0.05711, 0.01471),
    (0.1529, 0.09394, 0.06102, 0.1304, 0.6617, 0.05381, 0.05824, 0.01432),
    (0.1339, 0.08059, 0.0521, 0.1283, 0.5009, 0.05445, 0.05746, 0.01372),
    (0.0756, 0.04654, 0.02952, 0.1243, 0.2716, 0.04936, 0.05743, 0.008272),
)


def local_geometry(
    points: Float[Array, "n 3"], count: Int[Array, ""], radii: int
) -> Float[Array, "n g"]:
    """`local_invariants`, standardised over training clouds and weighted as an input.

    Zero in the padding. No derivative passes through: points are where they are.
    """
    raw = local_invariants(points, count, radii)
    mean = jnp.asarray(MEAN[:radii], raw.dtype).reshape(-1)
    spread = jnp.asarray(SPREAD[:radii], raw.dtype).reshape(-1)
    valid = prefix_mask(points.shape[0], count)[:, None]
    return jnp.where(valid, WEIGHT * (raw - mean[None, :]) / spread[None, :], 0.0)


def local_invariants(
    points: Float[Array, "n 3"], count: Int[Array, ""], radii: int
) -> Float[Array, "n g"]:
    """Eight numbers about each point for each of the first ``radii`` of `RADII`.

    With Gaussian weights of deviation 0.6 r over the valid points, o the offset of their mean from
    the point in units of r and M their covariance in units of r^2: the trace of M, the root of the
    sum of its principal minors, the cube root of its determinant, |o|, the logarithm of the part of
    the cloud that the weights hold, the roots of o'Mo and of |Mo|, and the cube root of
    det[o, Mo, M^2 o], whose sign a reflection turns. Finite for every cloud; rows of the padding
    hold no meaning. No derivative passes through.
    """
    points = jax.lax.stop_gradient(points)
    valid = prefix_mask(points.shape[0], count)[:, None]
    total = divisor(count, points.dtype)
    # Centred, since the covariance is a difference of squares of what is summed.
    centre = jnp.sum(jnp.where(valid, points, 0.0), axis=0) / total
    points = jnp.where(valid, points - centre[None, :], 0.0)
    x, y, z = points.T
    one = jnp.ones_like(x)
    products = [one, x, y, z, x * x, x * y, x * z, y * y, y * z, z * z]
    powers = jnp.where(valid.T, jnp.stack(products), 0.0)
    widest = DEVIATION * RADII[radii - 1]
    bell = jnp.exp(squared_distances(points, points) / (-2.0 * widest * widest))
    found = []
    for radius in reversed(RADII[:radii]):
        # The barrier keeps XLA from computing all of the bell again for each radius. The bell is
        # symmetric: its columns serve as rows, which is the faster product.
        bell = jax.lax.optimization_barrier(bell)
        moments = jnp.matmul(powers, bell, precision=HIGHEST)
        found.append(_invariants(moments, points.T, total, radius))
        bell = bell * bell
        bell = bell * bell  # of half the radius
    return jnp.concatenate(found[::-1]).T


def _invariants(
    moments: Float[Array, "10 n"], points: Float[Array, "3 n"], total: Float[Array, ""], r: float
) -> Float[Array, "8 n"]:
    """The eight numbers of one radius from the weighted sums of the powers of coordinates."""
    mass = jnp.maximum(moments[0], 1e-6)  # a point weighs 1 about itself; nothing in the padding
    mean = moments[1:4] / mass[None, :]
    o = (mean - points) / r
    x, y, z = mean
    products = jnp.stack([x * x, x * y, x * z, y * y, y * z, z * z])
    xx, xy, xz, yy, yz, zz = (moments[4:] / mass[None, :] - products) / (r * r)

    def times(v: Array) -> Array:
        a, b, c = v
        rows = [xx * a + xy * b + xz * c, xy * a + yy * b + yz * c, xz * a + yz * b + zz * c]
        return jnp.stack(rows)

    mo = times(o)
    minors = xx * yy - xy * xy + xx * zz - xz * xz + yy * zz - yz * yz
    determinant = xx * (yy * zz - yz * yz) - xy * (xy * zz - yz * xz) + xz * (xy * yz - yy * xz)
    turn = jnp.sum(o * jnp.cross(mo, times(mo), axis=0), axis=0)

    def root(square: Array) -> Array:
        return jnp.sqrt(jnp.maximum(square, 0.0))  # rounding makes a zero negative

    numbers = [
        xx + yy + zz,
        root(minors),
        jnp.cbrt(jnp.maximum(determinant, 0.0)),
        root(jnp.sum(o * o, axis=0)),
        jnp.log(mass / total),
        root(jnp.sum(o * mo, axis=0)),
        root(root(jnp.sum(mo * mo, axis=0))),
        jnp.cbrt(turn),
    ]
    return jnp.stack(numbers)
