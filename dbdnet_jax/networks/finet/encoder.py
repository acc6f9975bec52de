"""FINet's encoder: two branches over the same points, each told of the other cloud on the way."""

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool

from dbdnet_jax.networks.chains import Chain, chain_shapes
from dbdnet_jax.networks.params import Shapes
from dbdnet_jax.networks.stacking import pool, to_every_row
from dbdnet_jax.types import Cloud

BRANCHES = ("rotation", "translation")


class TwoBranches(nn.Module):
    """Pooled features of both clouds in both branches.

    ``widths`` are the layers' before, between and after the exchanges: there every point is given
    what the same branch has pooled of the other cloud, cut from the gradient.
    """

    widths: tuple[tuple[int, ...], ...]

    @nn.compact
    def __call__(
        self, source: Cloud, target: Cloud, keep: Bool[Array, "*pairs rows"] | None, training: bool
    ) -> tuple[list[Array], list[Array] | None]:
        """Of the source and the target, for each branch; and without the rows not kept."""
        points = jnp.concatenate([source.points, target.points], axis=-2)
        valid = jnp.concatenate([source.valid, target.valid], axis=-1)
        n, m = source.points.shape[-2], target.points.shape[-2]

        def pool_clouds(x: Array, present: Array) -> Array:
            both = (x[..., :n, :], present[..., :n]), (x[..., n:, :], present[..., n:])
            return jnp.stack([pool(*cloud) for cloud in both], axis=-2)

        pooled, dropped = [], []
        for branch in BRANCHES:
            x, kept = points, []
            for part, widths in enumerate(self.widths):
                if part:
                    other = jax.lax.stop_gradient(pool_clouds(x, valid))
                    told = [to_every_row(other[..., 1, :], n), to_every_row(other[..., 0, :], m)]
                    x = jnp.concatenate([x, jnp.concatenate(told, axis=-2)], axis=-1)
                kept += Chain(widths, bias=False, name=f"{branch}_{part}")(x, training)
                x = kept[-1]
            together = jnp.concatenate(kept, axis=-1)
            pooled.append(pool_clouds(together, valid))
            if keep is not None:
                dropped.append(pool_clouds(together, valid & keep))
        return pooled, None if keep is None else dropped


def two_branches_shapes(name: str, widths: tuple[tuple[int, ...], ...]) -> Shapes:
    """The parameters of `TwoBranches`."""
    found: Shapes = {}
    for branch in BRANCHES:
        fan_in = 3
        for part, sizes in enumerate(widths):
            found |= chain_shapes(f"{name}/{branch}_{part}", fan_in, sizes, bias=False)
            fan_in = 2 * sizes[-1]
    return found
