"""A network small enough for tests, parameters that hide nothing, and clouds to feed it."""

import functools

import jax
import jax.numpy as jnp
import numpy as np

from dbdnet_jax.model.config import ModelConfig
from dbdnet_jax.model.params import Params, init_params
from dbdnet_jax.types import Cloud
from tests.conftest import Tolerance

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

# Compiling is most of these tests' time: without the optimisation of machine code, two thirds.
compiled = functools.partial(jax.jit, compiler_options={"xla_backend_optimization_level": 0})


def perturbed(variables, seed: int):
    """Parameters moved off their initial values in float64: none is zero, one or like another."""
    rng = np.random.default_rng(seed)
    return jax.tree.map(
        lambda x: jnp.asarray(np.asarray(x, np.float64) + 0.2 * rng.normal(size=x.shape)), variables
    )


def small_params(seed: int = 0, config: ModelConfig = SMALL) -> Params:
    """Parameters of both networks in float64 (needs x64)."""
    return perturbed(init_params(jax.random.key(seed), config), seed)


def whole(points) -> Cloud:
    """A cloud without padding."""
    return Cloud(jnp.asarray(points), jnp.asarray(len(points)))


def padded(points, size: int, garbage: float) -> Cloud:
    """A cloud of ``size`` rows, ``garbage`` in those after ``points``."""
    rest = np.full((size - len(points), points.shape[1]), garbage)
    return Cloud(jnp.asarray(np.vstack([points, rest])), jnp.asarray(len(points)))
