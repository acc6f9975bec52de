"""The parameters of both networks, the architecture they fit, and their initial values."""

from typing import Any

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PRNGKeyArray

from dbdnet_jax.model.config import ModelConfig
from dbdnet_jax.model.overlap import OverlapNetwork
from dbdnet_jax.model.registration import RegistrationNetwork
from dbdnet_jax.types import Cloud


@flax.struct.dataclass
class Params:
    """The parameters of both networks and, as static metadata, the configuration they fit.

    ``jax.jit(register)(params, src, tgt)`` therefore needs no further argument. ``registration``
    is None for an overlap network on its own.
    """

    overlap: Any
    registration: Any
    config: ModelConfig = flax.struct.field(pytree_node=False)


def parameter_shapes(config: ModelConfig) -> Params:
    """Names and shapes of all parameters, as `jax.ShapeDtypeStruct`; nothing is computed."""
    clouds = Cloud(jnp.zeros((2, 16, 3)), jnp.full((2,), 16))
    key = jax.random.key(0)
    overlap, registration = (
        jax.eval_shape(network.init, key, clouds)["params"]
        for network in (OverlapNetwork(config), RegistrationNetwork(config))
    )
    return Params(overlap, registration, config)


def init_params(key: PRNGKeyArray, config: ModelConfig) -> Params:
    """Fresh parameters, distributed as in the released code (torch's defaults).

    One draw serves the whole network: a random operation per parameter takes minutes to compile.
    """
    leaves, tree = jax.tree.flatten_with_path(parameter_shapes(config))
    ends = np.cumsum([leaf.size for _, leaf in leaves])
    draws = np.split(jax.random.uniform(key, (int(ends[-1]),), minval=-1.0), ends[:-1])
    shapes = {path: leaf.shape for path, leaf in leaves}
    drawn = [
        jnp.ones(leaf.shape)
        if path[-1].key == "scale"
        else jnp.asarray(draw.reshape(leaf.shape) * _bound(path, shapes))
        for (path, leaf), draw in zip(leaves, draws, strict=True)
    ]
    return jax.tree.unflatten(tree, drawn)


def _bound(path: tuple, shapes: dict[tuple, tuple[int, ...]]) -> float:
    """Half the width of a kernel's or bias's uniform distribution around zero.

    1 / sqrt(fan in) for convolutions and linear layers; attention's packed projection is
    Glorot-uniform (Glorot & Bengio 2010); its biases, as a norm's, start at zero.
    """
    *parent, leaf = path
    kernel = shapes.get((*parent, jax.tree_util.DictKey("kernel")))
    attention = parent[-1].key in ("in_proj", "out_proj")
    if kernel is None or (attention and leaf.key == "bias"):
        return 0.0
    if parent[-1].key == "in_proj":
        return (6.0 / sum(kernel)) ** 0.5
    return kernel[0] ** -0.5
