"""Dense layers with batch norms in a row, as the peers have them, and poses as they carry them."""

from typing import NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from dbdnet_jax.networks.batch_norm import DenseBatchNorm, dense_batch_norm_shapes
from dbdnet_jax.networks.params import Shapes
from dbdnet_jax.ops import quaternion
from dbdnet_jax.ops.rigid import HIGHEST
from dbdnet_jax.types import Rigid


class Chain(nn.Module):
    """Layers named layer_0, layer_1 and so on; gives what each of them gives."""

    widths: tuple[int, ...]
    bias: bool = True
    slope: float = 0.0

    @nn.compact
    def __call__(self, x: Float[Array, "*rows c"], training: bool = False) -> list[Array]:
        """With folded parameters; in training by the batch's statistics."""
        found = []
        for i, width in enumerate(self.widths):
            layer = DenseBatchNorm(width, bias=self.bias, slope=self.slope, name=f"layer_{i}")
            x = layer(x, training)
            found.append(x)
        return found


def chain_shapes(name: str, fan_in: int, widths: tuple[int, ...], *, bias: bool = True) -> Shapes:
    """The parameters of a `Chain`."""
    found: Shapes = {}
    for i, width in enumerate(widths):
        found |= dense_batch_norm_shapes(f"{name}/layer_{i}", fan_in, width, bias=bias)
        fan_in = width
    return found


class QuaternionPose(NamedTuple):
    """A rigid motion ``target_from_source``: unit quaternion (w, x, y, z) and translation."""

    quaternion: Float[Array, "*pairs 4"]
    translation: Float[Array, "*pairs 3"]

    @property
    def rigid(self) -> Rigid:
        """The same with a rotation matrix."""
        return Rigid(quaternion.rotation_from_quaternion(self.quaternion), self.translation)


def quaternion_pose(target_from_source: Rigid) -> QuaternionPose:
    """The same with a quaternion whose w is not negative."""
    q = quaternion.quaternion_from_rotation(target_from_source.rotation)
    return QuaternionPose(q, target_from_source.translation)


def no_motion(points: Float[Array, "*pairs n 3"]) -> QuaternionPose:
    """The pose that moves nothing, for each pair."""
    pairs, dtype = points.shape[:-2], points.dtype
    one = jnp.zeros((*pairs, 4), dtype).at[..., 0].set(1.0)
    return QuaternionPose(one, jnp.zeros((*pairs, 3), dtype))


def after(increment: QuaternionPose, pose: QuaternionPose) -> QuaternionPose:
    """``pose``, then ``increment``; no gradient passes to the earlier one."""
    pose = jax.lax.stop_gradient(pose)
    rotation = quaternion.rotation_from_quaternion(increment.quaternion)
    moved = jnp.einsum("...ij,...j->...i", rotation, pose.translation, precision=HIGHEST)
    return QuaternionPose(
        quaternion.multiply(increment.quaternion, pose.quaternion), moved + increment.translation
    )


def unit(q: Float[Array, "*pairs 4"]) -> Float[Array, "*pairs 4"]:
    """Divided by its length; a vanishing one stays what it is, and its gradient finite."""
    square = jnp.sum(q * q, axis=-1, keepdims=True)
    return q * jax.lax.rsqrt(jnp.maximum(square, jnp.finfo(q.dtype).tiny))


def pose_terms(pose: QuaternionPose, truth: QuaternionPose) -> tuple[Array, Array]:
    """Mean absolute difference of the quaternions, mean square of the translations'.

    The truth has w >= 0; the prediction's sign is not aligned with it, so -q is wrong.
    """
    return (
        jnp.mean(jnp.abs(pose.quaternion - truth.quaternion)),
        jnp.mean((pose.translation - truth.translation) ** 2),
    )
