"""The optimizer of every stage: AdamW, its learning rate, its clipping."""

from collections.abc import Sequence

import optax


def make_schedule(
    peak: float, steps: int, warmup_steps: int, decay_steps: int = 0
) -> optax.Schedule:
    """Linear warm-up to ``peak``, then a cosine that ends at 0 after ``steps``.

    With ``decay_steps`` the rate stays at ``peak`` until the last of so many steps, over which the
    cosine goes: more steps then change nothing of those before.
    """
    warmup_steps = max(min(warmup_steps, steps - 1), 0)
    first = peak / (warmup_steps + 1)  # not 0: the first step counts too
    if 0 < decay_steps < steps - warmup_steps:
        rising = optax.linear_schedule(first, peak, max(warmup_steps, 1))
        falling = optax.cosine_decay_schedule(peak, decay_steps)
        ends = [warmup_steps, steps - decay_steps]
        return optax.join_schedules([rising, optax.constant_schedule(peak), falling], ends)
    if warmup_steps < 1:
        return optax.cosine_decay_schedule(peak, max(steps, 1))
    return optax.warmup_cosine_decay_schedule(first, peak, warmup_steps, steps)


def make_optimizer(
    schedule: optax.Schedule,
    *,
    weight_decay: float,
    clip_norm: float = 0.0,
    networks: Sequence[str] = (),
) -> optax.GradientTransformation:
    """AdamW (decay on every parameter, as the released code); ``clip_norm`` 0: no clipping.

    Where the parameters are several ``networks`` by name, each one's gradient is clipped by its
    own norm, so that the larger does not silence the smaller.
    """
    adamw = optax.adamw(schedule, weight_decay=weight_decay)
    if not clip_norm:
        return adamw
    clip = optax.clip_by_global_norm(clip_norm)
    if networks:
        clip = optax.partition({name: clip for name in networks}, {name: name for name in networks})
    return optax.chain(clip, adamw)
