"""The overlap network's own soft matches of both clouds, and what follows from them.

Not in the paper, whose overlap head knows of the other cloud only what cross-attention and a
maximum over it bring (`ModelConfig.overlap_matching` is False there). A point that has no
counterpart matches nothing well, and lies off the other cloud once both are coarsely registered.
"""

import math
from typing import NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from dbdnet_jax.networks.params import Shapes
from dbdnet_jax.ops import rigid
from dbdnet_jax.ops.grouping import squared_distances
from dbdnet_jax.ops.rigid import HIGHEST
from dbdnet_jax.ops.sinkhorn import sinkhorn
from dbdnet_jax.types import Cloud, Rigid

WIDTHS = (0.05, 0.1, 0.2, 0.4)  # of the bells through which distances are seen
FIT_FEATURES = 1 + 2 * len(WIDTHS)
FAR = 1e3  # stands for the distance to a point that is not there


class SoftMatches(NamedTuple):
    """Soft matches of two clouds, and the motion that they ask for.

    ``log_matrix[i, j]`` is the logarithm of the mass that source point i gives to target point j,
    very negative where one of them is padding.
    """

    clouds: Cloud  # stacked: the points that were matched
    log_matrix: Float[Array, "n m"]
    motion: Rigid


class MatchingLayer(nn.Module):
    """Two numbers, how feature distances become affinities: ``-softplus(beta) (d^2 - alpha)``."""

    iterations: int

    @nn.compact
    def __call__(self, clouds: Cloud, features: Float[Array, "2 n d"]) -> SoftMatches:
        """Match two stacked clouds by their features and solve for the motion."""
        beta = self.param("beta", nn.initializers.zeros, ()).astype(features.dtype)
        alpha = self.param("alpha", nn.initializers.zeros, ()).astype(features.dtype)
        distance = squared_distances(features[0], features[1])
        affinity = -nn.softplus(beta) * (distance - alpha)
        rows, columns = clouds.valid
        log_matrix = sinkhorn(affinity, rows, columns, self.iterations)
        soft, mass = soft_targets(jnp.exp(log_matrix), clouds.points[1])
        motion, _ = rigid.procrustes(clouds.points[0], soft, mass)
        return SoftMatches(clouds, log_matrix, motion)


def matching_shapes(name: str) -> Shapes:
    """The parameters of a `MatchingLayer`."""
    return {f"{name}/alpha": (), f"{name}/beta": ()}


def initial_matching(name: str, width: int) -> dict[str, np.ndarray]:
    """What a `MatchingLayer` on features of this width starts from.

    Fresh features, normalised, lie about sqrt(2 width) apart: soft matches, half of the mass.
    """
    return {
        f"{name}/alpha": np.array(1.5 * width, np.float32),
        f"{name}/beta": np.array(math.log(math.expm1(4.0 / width)), np.float32),
    }


def soft_targets(
    matrix: Float[Array, "n m"], targets: Float[Array, "m 3"]
) -> tuple[Float[Array, "n 3"], Float[Array, " n"]]:
    """The mean of the targets under each row's mass, and that mass; the origin where it is 0."""
    mass = jnp.sum(matrix, axis=1)
    soft = jnp.matmul(matrix, targets, precision=HIGHEST)
    return soft / jnp.where(mass > 1e-12, mass, 1.0)[:, None], mass


def match_features(matched: SoftMatches) -> Float[Array, "2 n f"]:
    """How well each point of both clouds fits in the other one.

    Its mass; then, through bells of several widths, its distance to the nearest point of the
    other cloud and to its own soft match there, both after the motion. The distances have no
    derivative: the motion is to be learned from its own loss.
    """
    clouds, log_matrix, motion = matched
    matrix = jnp.exp(log_matrix)
    points = jnp.stack([rigid.apply(motion, clouds.points[0]), clouds.points[1]])
    valid = clouds.valid
    distance = squared_distances(points[0], points[1])
    distance = jnp.where(valid[0][:, None] & valid[1][None, :], distance, FAR)

    def fit(matrix: Array, distance: Array, own: Array, other: Array) -> Array:
        soft, mass = soft_targets(matrix, other)
        squares = [jnp.min(distance, axis=1), jnp.sum((own - soft) ** 2, axis=1)]
        bells = [jnp.exp(-square / width**2) for square in squares for width in WIDTHS]
        return jnp.stack([mass, *jax.lax.stop_gradient(bells)], axis=1)

    of_source = fit(matrix, distance, points[0], points[1])
    of_target = fit(matrix.T, distance.T, points[1], points[0])
    return jnp.stack([of_source, of_target])
