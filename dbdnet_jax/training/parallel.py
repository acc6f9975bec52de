"""How a batch of pairs meets the hardware: decided here and nowhere else."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.experimental import multihost_utils
from jax.sharding import AxisType, Mesh, NamedSharding, PartitionSpec

AXIS = "pairs"
AT_ONCE = 16  # answers of a GPU or TPU; the memory of a larger number may be lacking


def join_processes(
    coordinator: str | None = None, processes: int | None = None, process_id: int | None = None
) -> None:
    """Make this one of several processes that work together, before JAX has made any device.

    ``coordinator`` is the HOST:PORT of process 0. What is None is taken from the scheduler's
    environment, as `jax.distributed.initialize` knows it: Slurm, Open MPI, a TPU pod.

    Raises:
        ValueError: the environment does not say, or the others cannot be reached.
    """
    try:
        jax.distributed.initialize(coordinator, processes, process_id)
    except (ValueError, RuntimeError) as error:
        raise ValueError(
            "processes that work together must know and reach each other; got --coordinator="
            f"{coordinator}, --processes={processes}, --process_id={process_id} "
            f"({str(error).splitlines()[0][:200]}). Give all three, or start them by a scheduler."
        ) from error


def training_mesh(batch_size: int, devices: int = 0) -> Mesh:
    """The first ``devices``, as many of each process, which share each batch; 0: all there are.

    On a CPU, where XLA makes as many devices as it is told to, 0 is the most that the batch can be
    divided among.

    Raises:
        ValueError: there are fewer, or they cannot share the batch; says what would fit.
    """
    processes, there = jax.process_count(), jax.device_count()
    _require_devices(devices)
    if not devices and jax.default_backend() == "cpu":
        shares = range(processes, there + 1, processes)
        devices = max((n for n in shares if batch_size % n == 0), default=there)
    size = devices or there
    if batch_size % size:
        below = batch_size - batch_size % size
        fitting = " or ".join(str(n) for n in (below, below + size) if n)
        raise ValueError(
            f"the batch must be divisible by the {size} devices that share it; got a batch_size of "
            f"{batch_size}. Use a batch_size of {fitting} (any multiple of {size}), or "
            f"--config.train.devices={math.gcd(batch_size, size)}."
        )
    found = sorted(jax.devices(), key=lambda device: (device.process_index, device.id))
    of_each = np.asarray(found).reshape(processes, -1)[:, : size // processes]
    return Mesh(of_each.reshape(-1), (AXIS,), axis_types=(AxisType.Auto,))


def local_mesh(devices: int = 0) -> Mesh:
    """This process's own part of ``devices``, for work that needs no other process; 0: all it has.

    Raises:
        ValueError: there are fewer.
    """
    _require_devices(devices)
    own = jax.local_devices()[: devices // jax.process_count() or None]
    return Mesh(np.asarray(own), (AXIS,), axis_types=(AxisType.Auto,))


def _require_devices(devices: int) -> None:
    processes, there = jax.process_count(), jax.device_count()
    if devices > there or devices % processes:
        raise ValueError(
            f"config.train.devices must be at most the {there} devices there are, and as many in "
            f"each of the {processes} processes; got {devices}. Use 0 for all."
        )


def on_all_devices(mesh: Mesh, tree: Any) -> Any:
    """A copy of ``tree`` on each device of the mesh; a step then compiles once."""
    everywhere = NamedSharding(mesh, PartitionSpec())

    def put(leaf: Any) -> Any:
        # JAX moves no typed key to the devices of other processes, but the numbers in it.
        if jax.process_count() > 1 and jax.dtypes.issubdtype(leaf.dtype, jax.dtypes.prng_key):
            return jax.random.wrap_key_data(put(jax.random.key_data(leaf)))
        return jax.device_put(leaf, everywhere)

    return jax.tree.map(put, tree)


def spread_rows(mesh: Mesh, rows: Any) -> Any:
    """A batch over the devices of the mesh, of which each process has the rows of its own."""
    spread = NamedSharding(mesh, PartitionSpec(AXIS))
    return jax.tree.map(lambda leaf: jax.make_array_from_process_local_data(spread, leaf), rows)


def mean_over_pairs(
    mesh: Mesh,
    function: Callable[..., Any],
    count: int,
    *arguments: Any,
    rounds: int = 1,
    split: bool = False,
) -> Any:
    """The mean of ``function(i, *arguments)`` over i in 0..count-1; the one place with a batch.

    The devices share the numbers; with ``split`` also the first argument, which has a row for each
    number: ``function`` is given that row. On a GPU or TPU each device takes its part in
    ``rounds``, all pairs of a round at once; on a CPU pair by pair: XLA's own threads give almost
    nothing at these sizes, a device for each core does. Bit for bit the same for the same devices
    and rounds only, as the order of the sum depends on them.
    """
    function = jax.jit(function)  # traced once, for its shapes and for the sum
    by_pair = jax.default_backend() == "cpu"
    rounds = 1 if by_pair else rounds
    each = rounds * math.ceil(count / (mesh.size * rounds))  # numbers of a device
    rows, arguments = arguments[:split], arguments[split:]

    def local(own: tuple[Any, ...], *arguments: Any) -> Any:
        def value(one: tuple[Any, ...]) -> Any:
            # Numbers from count on only fill the last round.
            found = function(*one, *arguments)
            return jax.tree.map(lambda leaf: jnp.where(one[0] < count, leaf, 0), found)

        def add(total: Any, some: tuple[Any, ...]) -> tuple[Any, None]:
            if by_pair:
                return jax.tree.map(jnp.add, total, value(some)), None
            values = jax.vmap(value)(some)
            return jax.tree.map(lambda t, v: t + jnp.sum(v, axis=0), total, values), None

        shapes = jax.eval_shape(function, *jax.tree.map(lambda leaf: leaf[0], own), *arguments)
        zero = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), shapes)
        if not by_pair:
            own = jax.tree.map(lambda leaf: leaf.reshape(rounds, -1, *leaf.shape[1:]), own)
        return jax.lax.psum(jax.lax.scan(add, zero, own)[0], AXIS)

    total = jax.shard_map(
        local,
        mesh=mesh,
        in_specs=(PartitionSpec(AXIS), *[PartitionSpec()] * len(arguments)),
        out_specs=PartitionSpec(),
        # Checked, jax.grad inside would sum over the devices by itself, pair by pair.
        check_vma=False,
    )((jnp.arange(each * mesh.size, dtype=jnp.int32), *rows), *arguments)
    return jax.tree.map(lambda value: value / count, total)


def stack_over_devices(mesh: Mesh, function: Callable[..., Any], count: int) -> Any:
    """``function(i)`` for i in 0..count-1, stacked, for what needs the whole batch at once.

    The devices share the rows, and XLA divides what is computed from them the same way.
    """
    values = jax.vmap(function)(jnp.arange(count, dtype=jnp.int32))
    rows = NamedSharding(mesh, PartitionSpec(AXIS))
    return jax.tree.map(lambda value: jax.lax.with_sharding_constraint(value, rows), values)


def map_over_pairs(mesh: Mesh, function: Callable[..., Any], pairs: Any, *arguments: Any) -> Any:
    """``function(pair, *arguments)`` of each of stacked pairs, stacked, as NumPy arrays.

    The devices of a `local_mesh` share the pairs, whatever their number.
    """
    count = len(jax.tree.leaves(pairs)[0])
    each = math.ceil(count / mesh.size)
    at_once = None if jax.default_backend() == "cpu" else min(AT_ONCE, each)

    def local(pairs: Any, *arguments: Any) -> Any:
        return jax.lax.map(lambda pair: function(pair, *arguments), pairs, batch_size=at_once)

    spread, everywhere = PartitionSpec(AXIS), PartitionSpec()
    shared = jax.shard_map(
        local,
        mesh=mesh,
        in_specs=(spread, *[everywhere] * len(arguments)),
        out_specs=spread,
        check_vma=False,
    )
    # The last pair fills up what a device lacks; what comes of that is cut off.
    rows = np.minimum(np.arange(each * mesh.size), count - 1)
    pairs = jax.tree.map(lambda leaf: np.asarray(leaf)[rows], pairs)
    found = jax.device_get(jax.jit(shared)(pairs, *on_all_devices(mesh, arguments)))
    return jax.tree.map(lambda leaf: leaf[:count], found)


def rows_of_process(count: int) -> np.ndarray:
    """Which of ``count`` rows are this process's: as many as any other's.

    The last row fills up what a process lacks; `from_all_processes` cuts that off.
    """
    processes = jax.process_count()
    own = np.arange(math.ceil(count / processes)) * processes + jax.process_index()
    return np.minimum(own, count - 1)


def from_all_processes(found: Any, count: int) -> Any:
    """What each process found of its `rows_of_process`, of all ``count`` rows in their order."""
    if jax.process_count() == 1:
        return found
    gathered = multihost_utils.process_allgather(found)  # processes first

    def in_order(leaf: np.ndarray) -> np.ndarray:
        return np.swapaxes(leaf, 0, 1).reshape(-1, *leaf.shape[2:])[:count]

    return jax.tree.map(in_order, gathered)
