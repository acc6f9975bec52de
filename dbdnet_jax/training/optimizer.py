"""The optimizer of every stage: Adam or AdamW, its learning rate, its clipping."""

from collections.abc import Sequence
from typing import Any

import jax.numpy as jnp
import optax


def make_schedule(
    peak: float,
    steps: int,
    warmup_steps: int,
    *,
    kind: str = "cosine",
    milestones: Sequence[int] = (),
    factor: float = 0.1,
    decay_steps: int = 0,
) -> optax.Schedule:
    """Linear warm-up to ``peak``, then what ``kind`` says.

    "cosine" ends at 0 after ``steps``; "steps" multiplies the rate by ``factor`` from each of the
    ``milestones`` (steps) on; "constant" keeps it until the last ``decay_steps``, over which a
    cosine ends at 0: more steps then change nothing of those before.
    """
    warmup_steps = min(warmup_steps, steps - 1)
    first = peak / (warmup_steps + 1)  # not 0: the first step counts too
    if kind == "cosine":
        if warmup_steps < 1:
            return optax.cosine_decay_schedule(peak, max(steps, 1))
        return optax.warmup_cosine_decay_schedule(first, peak, warmup_steps, steps)

    def rate(step: Any) -> Any:
        passed = sum(jnp.asarray(step >= milestone, jnp.float32) for milestone in milestones)
        warm = jnp.minimum(1.0, (step + 1) / (warmup_steps + 1)) if warmup_steps > 0 else 1.0
        left = jnp.clip((steps - step) / decay_steps, 0.0, 1.0) if decay_steps else 1.0
        decay = 0.5 - 0.5 * jnp.cos(jnp.pi * left)
        return peak * warm * decay * jnp.asarray(factor, jnp.float32) ** passed

    return rate


def make_optimizer(
    schedule: optax.Schedule,
    *,
    weight_decay: float,
    clip_norm: float = 0.0,
    networks: Sequence[str] = (),
    kind: str = "adamw",
) -> optax.GradientTransformation:
    """AdamW (decay on every parameter, as the released code), or Adam; ``clip_norm`` 0: none.

    "adam" adds the decay to the gradient, as torch's Adam does. Where the parameters are several
    ``networks`` by name, each one's gradient is clipped by its own norm, so that the larger does
    not silence the smaller.
    """
    if kind == "adamw":
        update = optax.adamw(schedule, weight_decay=weight_decay)
    else:
        update = optax.chain(optax.add_decayed_weights(weight_decay), optax.adam(schedule))
    if not clip_norm:
        return update
    clip = optax.clip_by_global_norm(clip_norm)
    if networks:
        clip = optax.partition({name: clip for name in networks}, {name: name for name in networks})
    return optax.chain(clip, update)
