"""What the parameters of any method start from."""

import math
from typing import Any

import jax
import numpy as np
from jaxtyping import PRNGKeyArray

from dbdnet_jax.networks.params import Params, Shapes, unflatten
from dbdnet_jax.networks.table import learned

_ONES = ("scale", "variance")  # of norms, and of what enters them


def init_params(key: PRNGKeyArray, config: Any) -> Params:
    """Fresh parameters, distributed as in the released codes (torch's defaults).

    One draw serves the whole network: a random operation per parameter takes minutes to compile.
    """
    method = learned(config)
    shapes = method.shapes(config)
    ends = np.cumsum([math.prod(shape) for shape in shapes.values()])
    uniform = np.asarray(jax.random.uniform(key, (int(ends[-1]),), minval=-1.0))
    draws = np.split(uniform, ends[:-1])
    arrays = {
        name: np.ones(shape, np.float32)
        if name.endswith(_ONES)
        else draw.reshape(shape) * np.float32(_bound(name, shapes))
        for (name, shape), draw in zip(shapes.items(), draws, strict=True)
    }
    if method.initial is not None:
        arrays |= method.initial(config)
    return unflatten(arrays, config)


def _bound(name: str, shapes: Shapes) -> float:
    """Half the width of a kernel's or bias's uniform distribution around zero.

    1 / sqrt(fan in) for convolutions and linear layers; attention's packed projection is
    Glorot-uniform (Glorot & Bengio 2010); its biases, as a norm's, start at zero.
    """
    parent, leaf = name.rsplit("/", 1)
    kernel = shapes.get(f"{parent}/kernel")
    if kernel is None or (leaf == "bias" and parent.endswith(("in_proj", "out_proj"))):
        return 0.0
    if parent.endswith("in_proj"):
        return (6.0 / sum(kernel)) ** 0.5
    return kernel[0] ** -0.5
