"""Log-domain Sinkhorn normalisation with one slack row and one slack column."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

# Stands for log 0: exp of it is 0 in float32, and sums of a few of them stay finite.
LOG_ZERO = -1e9


def sinkhorn(
    affinity: Float[Array, "n m"],
    row_valid: Bool[Array, " n"],
    column_valid: Bool[Array, " m"],
    iterations: int,
) -> Float[Array, "n m"]:
    """Log of an almost doubly stochastic matrix (RPM-Net, Yew & Lee 2020; Sinkhorn 1964).

    Each iteration normalises the rows, then the columns; a slack row and column of affinity 0
    take what matches nothing and are never normalised themselves. Columns of the result sum to
    at most one, rows to about one at most. Masked rows and columns hold ``LOG_ZERO`` or less,
    so their exponential is zero.
    """
    both = row_valid[:, None] & column_valid[None, :]
    inner = jnp.where(both, affinity, LOG_ZERO)
    # Masked rows and columns have their slack too and give it all they hold; without it,
    # normalising them would lift LOG_ZERO to log(1 / m), which valid columns would then share.
    slack_column = jnp.zeros(affinity.shape[0], affinity.dtype)
    slack_row = jnp.zeros(affinity.shape[1], affinity.dtype)

    def step(carry: tuple[Array, ...], _: None) -> tuple[tuple[Array, ...], None]:
        inner, slack_column, slack_row = carry
        total = _logsumexp(inner, slack_column, axis=1)
        inner, slack_column = inner - total[:, None], slack_column - total
        total = _logsumexp(inner, slack_row, axis=0)
        return (inner - total[None, :], slack_column, slack_row - total), None

    (inner, _, _), _ = jax.lax.scan(
        jax.checkpoint(step), (inner, slack_column, slack_row), length=iterations
    )
    return jnp.where(both, inner, LOG_ZERO)


def _logsumexp(
    inner: Float[Array, "n m"], slack: Float[Array, " rest"], axis: int
) -> Float[Array, " rest"]:
    """log(sum exp) over one axis of the matrix and the slack entry that belongs to it."""
    largest = jnp.maximum(jnp.max(inner, axis=axis), slack)
    largest = jax.lax.stop_gradient(largest)
    total = jnp.sum(jnp.exp(inner - jnp.expand_dims(largest, axis)), axis=axis)
    return largest + jnp.log(total + jnp.exp(slack - largest))
