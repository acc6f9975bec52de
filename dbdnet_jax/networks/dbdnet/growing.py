"""Weights that go on with more inputs than they were trained with."""

from __future__ import annotations

import dataclasses

import numpy as np

from dbdnet_jax.networks.params import Params, flatten, unflatten

_FIRST_LAYER = "encoder/stage1_conv1/conv_0/kernel"


def with_local_geometry(params: Params, radii: int) -> Params:
    """The same weights where the encoders also see the local geometry at ``radii`` radii.

    The new rows of their first layers are zero, so that the answers are as before until they are
    trained.

    Raises:
        ValueError: fewer radii than the weights have already, or more than there are.
    """
    if radii < params.config.local_geometry:
        raise ValueError(
            f"radii must be at least the {params.config.local_geometry} that the weights have; "
            f"got {radii}. Local geometry can be added, not taken away."
        )
    config = dataclasses.replace(params.config, local_geometry=radii)
    arrays = flatten(params)
    more = config.inputs - params.config.inputs
    for name in (f"{network}/{_FIRST_LAYER}" for network in params.networks):
        if name in arrays:
            # The kernel of [f_j - f_i, f_i]: the new inputs follow the old ones in both halves.
            halves = np.split(arrays[name], 2)
            arrays[name] = np.concatenate([np.pad(half, ((0, more), (0, 0))) for half in halves])
    return unflatten(arrays, config)
