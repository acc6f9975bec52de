"""One step of training: a pure function of its state, a key and what pairs are drawn from."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import flax.struct
import jax
import jax.numpy as jnp
import optax
from jax.sharding import Mesh
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from dbdnet_jax.networks.batch_norm import fold, join_batch_stats
from dbdnet_jax.networks.params import bfloat16_kernels
from dbdnet_jax.training.parallel import mean_over_pairs, stack_over_devices
from dbdnet_jax.types import Pair

Draw = Callable[[PRNGKeyArray, Int[Array, ""], Any], Pair]


@flax.struct.dataclass
class TrainState:
    """Everything that a step changes: ``step`` counts those taken, as an int32 scalar.

    ``ema`` is None where no moving average of the weights is kept, ``batch_stats`` (the running
    averages of batch norms) where the network has none.
    """

    step: Any
    params: Any
    opt_state: Any
    ema: Any
    batch_stats: Any = None


class StepMetrics(NamedTuple):
    """What a step says of itself: means over its pairs, before the update."""

    loss: Float[Array, ""]
    terms: Any
    gradient_norm: Float[Array, ""]
    finite: Bool[Array, ""]


def init_state(
    trainable: Any,
    optimizer: optax.GradientTransformation,
    *,
    ema_decay: float = 0.0,
    batch_stats: Any = None,
) -> TrainState:
    """The state before the first step."""
    ema = jax.tree.map(jnp.copy, trainable) if ema_decay else None
    zero = jnp.zeros((), jnp.int32)
    return TrainState(zero, trainable, optimizer.init(trainable), ema, batch_stats)


def weights_of(state: TrainState) -> Any:
    """The weights to use: their moving average where one is kept, batch norms folded."""
    weights = state.params if state.ema is None else state.ema
    if state.batch_stats is None:
        return weights
    return fold(join_batch_stats(weights, state.batch_stats))


def train_step(
    state: TrainState,
    frozen: Any,
    key: PRNGKeyArray,
    arrays: Any,
    *,
    draw: Draw,
    loss: Callable[..., Any],
    optimizer: optax.GradientTransformation,
    batch_size: int,
    mesh: Mesh,
    batched: bool = False,
    ema_decay: float = 0.0,
    accumulate: int = 1,
    remat: bool = False,
    precision: str = "float32",
) -> tuple[TrainState, StepMetrics]:
    """One step on ``batch_size`` fresh pairs; pure, so its result depends on the arguments only.

    ``batched`` ``arrays`` are the step's own, with a row for each pair, which ``draw`` is given.

    The devices of ``mesh`` share the pairs; on a GPU or TPU each takes its own in ``accumulate``
    parts, one after another. ``remat`` recomputes the loss for its gradient; a ``precision`` of
    "bfloat16" is that of its products. ``loss`` is a task's (`training.task`). Where the loss, a
    term or the gradient is not finite the state comes back as it was, step count included: from the
    same arrays the same step would be taken again, and fail again, until the caller stops. From the
    next batch it would be another one, so the caller looks at each before it takes the next.
    """
    key = jax.random.fold_in(key, state.step)
    loss = _with_bfloat16(loss) if precision == "bfloat16" else loss
    loss = jax.checkpoint(loss) if remat else loss
    batch_stats = None
    if state.batch_stats is None:
        total, terms, gradient = _by_pair(
            state, frozen, key, arrays, draw, loss, batch_size, mesh, accumulate, batched
        )
    else:
        total, terms, gradient, batch_stats = _by_batch(
            state, frozen, key, arrays, draw, loss, batch_size, mesh, batched
        )
    norm = optax.tree.norm(gradient)
    finite = jnp.isfinite(jnp.stack([total, norm, *jax.tree.leaves(terms)])).all()

    updates, opt_state = optimizer.update(gradient, state.opt_state, state.params)
    params = optax.apply_updates(state.params, updates)
    ema = state.ema
    if ema_decay:
        # The first weights are noise: a short memory at first forgets them.
        decay = jnp.minimum(ema_decay, (1 + state.step) / (10 + state.step))
        ema = jax.tree.map(lambda old, new: old + (1 - decay) * (new - old), ema, params)
    moved = TrainState(state.step + 1, params, opt_state, ema, batch_stats)
    state = jax.tree.map(lambda new, old: jnp.where(finite, new, old), moved, state)
    return state, StepMetrics(total, terms, norm, finite)


def _with_bfloat16(loss: Callable[..., Any]) -> Callable[..., Any]:
    """The loss of rounded kernels; its gradient is one of the kernels as they are."""

    def rounded(trainable: Any, frozen: Any, *rest: Any) -> Any:
        return loss(bfloat16_kernels(trainable), bfloat16_kernels(frozen), *rest)

    return rounded


def _by_pair(
    state: TrainState,
    frozen: Any,
    key: PRNGKeyArray,
    arrays: Any,
    draw: Draw,
    loss: Callable[..., Any],
    batch_size: int,
    mesh: Mesh,
    accumulate: int,
    batched: bool,
) -> tuple[Array, Any, Any]:
    """Loss, terms and gradient as means over the pairs, each on its own."""

    def one(i: Array, arrays: Any, params: Any, frozen: Any, step: Array, key: PRNGKeyArray) -> Any:
        draw_key, loss_key = jax.random.split(jax.random.fold_in(key, i))
        pair = draw(draw_key, step * batch_size + i, arrays)
        return jax.value_and_grad(loss, has_aux=True)(params, frozen, pair, loss_key)

    (total, terms), gradient = mean_over_pairs(
        mesh,
        one,
        batch_size,
        *(arrays, state.params, frozen, state.step, key),
        rounds=accumulate,
        split=batched,
    )
    return total, terms, gradient


def _by_batch(
    state: TrainState,
    frozen: Any,
    key: PRNGKeyArray,
    arrays: Any,
    draw: Draw,
    loss: Callable[..., Any],
    batch_size: int,
    mesh: Mesh,
    batched: bool,
) -> tuple[Array, Any, Any, Any]:
    """Loss, terms and gradient of all pairs together, and the new running averages."""

    def one(i: Array) -> Pair:
        draw_key, _ = jax.random.split(jax.random.fold_in(key, i))
        of_pair = jax.tree.map(lambda leaf: leaf[i], arrays) if batched else arrays
        return draw(draw_key, state.step * batch_size + i, of_pair)

    pairs = stack_over_devices(mesh, one, batch_size)
    loss_key = jax.random.fold_in(key, batch_size)
    (total, (terms, batch_stats)), gradient = jax.value_and_grad(loss, has_aux=True)(
        state.params, frozen, pairs, loss_key, state.batch_stats
    )
    return total, terms, gradient, batch_stats
