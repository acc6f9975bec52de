"""DBDNet as one of the methods of `dbdnet_jax.networks.table`."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool

from dbdnet_jax.networks.dbdnet.config import ModelConfig
from dbdnet_jax.networks.dbdnet.matching import initial_matching
from dbdnet_jax.networks.dbdnet.overlap import overlap_shapes
from dbdnet_jax.networks.dbdnet.register import register_clouds, register_given_overlap
from dbdnet_jax.networks.dbdnet.registration import registration_shapes
from dbdnet_jax.networks.params import Params, Shapes
from dbdnet_jax.types import Answer, Cloud


def shapes(config: ModelConfig) -> Shapes:
    """Shape of every parameter of the networks that the configuration has."""
    if config.overlap != "prior":
        return registration_shapes(config)
    return overlap_shapes(config) | registration_shapes(config)


def initial(config: ModelConfig) -> dict[str, np.ndarray]:
    """What does not start from random numbers."""
    if not config.overlap_matching:
        return {}
    return initial_matching("overlap/matching", 4 * config.overlap_channels)


def predict(params: Params, source: Cloud, target: Cloud) -> Answer:
    """`register` of two clouds, and the overlap it predicts, if any."""
    found = register_clouds(params, source, target)
    if params.config.overlap == "none":
        return Answer(found.motion)
    return Answer(found.motion, found.src_overlap, found.tgt_overlap)


def predict_given_overlap(
    params: Params,
    source: Cloud,
    target: Cloud,
    source_overlap: Bool[Array, " n"],
    target_overlap: Bool[Array, " m"],
) -> Answer:
    """The registration network alone, told which points overlap; solves as often as `register`."""
    labels = (label.astype(jnp.float32) for label in (source_overlap, target_overlap))
    found = register_given_overlap(params, source, target, *labels, solves=params.config.solves)
    return Answer(found.motion)
