"""The products of the networks, whose precision is that of the parameters."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float


def product(a: Float[Array, "*rows n c"], b: Float[Array, "c d"]) -> Float[Array, "*rows n d"]:
    """``a @ b``, in the type of ``a``; where ``b`` is bfloat16, the factors are rounded to that.

    Sums stay in the type of ``a``, in the derivative too, whose factors are rounded alike: what a
    GPU's or TPU's matrix units do at twice the speed and more.
    """
    return _rounded(a, b) if b.dtype == jnp.bfloat16 else jnp.matmul(a, b)


@jax.custom_vjp
def _rounded(a: Float[Array, "*rows n c"], b: Float[Array, "c d"]) -> Float[Array, "*rows n d"]:
    return jnp.matmul(a.astype(b.dtype), b, preferred_element_type=a.dtype)


def _forward(a: Array, b: Array) -> tuple[Array, tuple[Array, Array, Array]]:
    # What is kept for the derivative takes half of the memory; the last one only holds a type.
    return _rounded(a, b), (a.astype(b.dtype), b, jnp.zeros((), a.dtype))


def _backward(kept: tuple[Array, Array, Array], cotangent: Array) -> tuple[Array, Array]:
    # Left to JAX, it would be products in float32: by the cotangent as it is.
    a, b, like = kept
    factor = cotangent.astype(b.dtype)
    of_a = jnp.matmul(factor, b.T, preferred_element_type=like.dtype)
    a, factor = a.reshape(-1, a.shape[-1]), factor.reshape(-1, factor.shape[-1])
    of_b = jnp.matmul(a.T, factor, preferred_element_type=like.dtype)
    return of_a, of_b.astype(b.dtype)


_rounded.defvjp(_forward, _backward)
