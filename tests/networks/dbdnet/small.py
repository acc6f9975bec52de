"""A network small enough for tests, parameters that hide nothing, and clouds to feed it."""

import jax
import jax.numpy as jnp
import numpy as np

from dbdnet_jax.networks.dbdnet.config import ModelConfig
from dbdnet_jax.networks.initial import init_params
from dbdnet_jax.networks.params import Params
from dbdnet_jax.types import Cloud
from tests.conftest import GRADIENT, Tolerance, assert_close, random_cloud

SMALL = ModelConfig(
    overlap_channels=4,
    overlap_blocks=1,
    registration_channels=4,
    shared_blocks=1,
    rotation_blocks=1,
    translation_blocks=1,
    head_width=128,
    parameter_width=128,
    neighbours=6,
    min_points=12,
)

# Reordered sums of a whole network in float64: a hundred layers carry and stretch the rounding.
NETWORK = Tolerance(rtol=1e-7, atol=1e-8)


def perturbed(variables, seed: int):
    """Float64 NumPy parameters off their initial values: none is zero, one or like another."""
    rng = np.random.default_rng(seed)
    return jax.tree.map(lambda x: np.float64(x) + 0.2 * rng.normal(size=x.shape), variables)


def cast(tree, dtype):
    """All leaves as JAX arrays of ``dtype``."""
    return jax.tree.map(lambda x: jnp.asarray(x, dtype), tree)


def small_params(seed: int = 0, config: ModelConfig = SMALL, dtype=np.float64) -> Params:
    """Parameters of both networks (float64 needs x64)."""
    return cast(perturbed(init_params(jax.random.key(seed), config), seed), dtype)


def overlap_alone(params: Params) -> Params:
    """Without the registration network."""
    return params.replace(networks={"overlap": params.overlap})


def whole(points) -> Cloud:
    """A cloud without padding."""
    return Cloud(jnp.asarray(points), jnp.asarray(len(points)))


def padded(points, size: int, garbage: float) -> Cloud:
    """A cloud of ``size`` rows, ``garbage`` in those after ``points``."""
    rest = np.full((size - len(points), points.shape[1]), garbage)
    return Cloud(jnp.asarray(np.vstack([points, rest])), jnp.asarray(len(points)))


def assert_same_derivative(function, plain, inputs):
    """The derivative of ``function`` is that of central differences of ``plain`` (needs x64)."""
    cotangent = random_cloud(20, plain(*inputs).size, 1).reshape(plain(*inputs).shape)
    gradients = jax.grad(lambda *x: jnp.sum(function(*x) * cotangent), range(len(inputs)))(
        *cast(inputs, np.float64)
    )
    for number, (x, gradient) in enumerate(zip(inputs, gradients, strict=True)):
        for seed in (21, 22):
            direction = random_cloud(seed, x.size, 1).reshape(x.shape)
            ends = [
                np.sum(
                    plain(*inputs[:number], x + step * direction, *inputs[number + 1 :]) * cotangent
                )
                for step in (1e-6, -1e-6)
            ]
            slope = (ends[0] - ends[1]) / 2e-6
            assert_close(jnp.sum(gradient * direction), slope, GRADIENT)
