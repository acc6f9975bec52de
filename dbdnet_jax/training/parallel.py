"""How a batch of pairs meets the hardware: decided here and nowhere else."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax.sharding import AxisType, Mesh, NamedSharding, PartitionSpec
from jaxtyping import Array, Int


def on_all_devices(tree: Any) -> Any:
    """A copy of ``tree`` where `mean_over_pairs` needs it; a step then compiles once."""
    if jax.default_backend() != "cpu":
        return jax.device_put(tree)
    return jax.device_put(tree, NamedSharding(_cpu_mesh(), PartitionSpec()))


def mean_over_pairs(function: Callable[..., Any], count: int, *arguments: Any) -> Any:
    """The mean of ``function(i, *arguments)`` over i in 0..count-1; the one place with a batch.

    On a GPU or TPU all pairs at once. On a CPU one after another on each XLA device: XLA's own
    threads give almost nothing at these sizes, a device for each core does. Bit for bit the same
    for the same number of devices only, as the order of the sum depends on it.
    """
    if jax.default_backend() != "cpu":
        values = jax.vmap(lambda i: function(i, *arguments))(jnp.arange(count, dtype=jnp.int32))
        return jax.tree.map(lambda value: jnp.mean(value, axis=0), values)
    function = jax.jit(function)  # traced once, for its shapes and for the sum
    mesh = _cpu_mesh()
    rounds = math.ceil(count / mesh.size)

    def local(numbers: Int[Array, " rounds"], *arguments: Any) -> Any:
        def add(total: Any, i: Int[Array, ""]) -> tuple[Any, None]:
            value = function(i, *arguments)
            # Numbers from count on only fill the last round.
            return jax.tree.map(lambda t, v: t + jnp.where(i < count, v, 0), total, value), None

        shapes = jax.eval_shape(function, numbers[0], *arguments)
        zero = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), shapes)
        return jax.lax.psum(jax.lax.scan(add, zero, numbers)[0], "pairs")

    total = jax.shard_map(
        local,
        mesh=mesh,
        in_specs=(PartitionSpec("pairs"), *[PartitionSpec()] * len(arguments)),
        out_specs=PartitionSpec(),
        # Checked, jax.grad inside would sum over the devices by itself, pair by pair.
        check_vma=False,
    )(jnp.arange(rounds * mesh.size, dtype=jnp.int32), *arguments)
    return jax.tree.map(lambda value: value / count, total)


def stack_over_devices(function: Callable[..., Any], count: int) -> Any:
    """``function(i)`` for i in 0..count-1, stacked, for what needs the whole batch at once.

    On a CPU the XLA devices share the rows, and XLA divides what is computed from them the same
    way; where the count is no multiple of the devices, each computes all of it.
    """
    values = jax.vmap(function)(jnp.arange(count, dtype=jnp.int32))
    if jax.default_backend() != "cpu" or count % jax.device_count():
        return values
    rows = NamedSharding(_cpu_mesh(), PartitionSpec("pairs"))
    return jax.tree.map(lambda value: jax.lax.with_sharding_constraint(value, rows), values)


def _cpu_mesh() -> Mesh:
    return jax.make_mesh((jax.device_count(),), ("pairs",), axis_types=(AxisType.Auto,))
