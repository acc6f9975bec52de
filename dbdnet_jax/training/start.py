"""The weights that a stage starts from."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import jax

from dbdnet_jax.networks.dbdnet.growing import with_local_geometry
from dbdnet_jax.networks.initial import init_params
from dbdnet_jax.networks.params import Params, flatten, require_shapes
from dbdnet_jax.networks.table import parameter_shapes
from dbdnet_jax.networks.weights import load_params
from dbdnet_jax.training.task import RunConfig


def initial_params(config: RunConfig) -> Params:
    """Fresh parameters, or those of ``config.train.start`` where it holds the network.

    Raises:
        FileNotFoundError: there is no such file.
        CheckpointError: it is damaged, or of another architecture.
    """
    fresh = init_params(jax.random.key(config.train.seed), config.model)
    if not config.train.start:
        return fresh
    return dataclasses.replace(fresh, networks={**fresh.networks, **load_start(config).networks})


def load_start(config: RunConfig) -> Params:
    """The networks in ``config.train.start``: all or some, of the configuration's widths.

    DBDNet's weights without local geometry, or with less of it, are given the rest: zeros at first.
    """
    if not Path(config.train.start).is_file():
        raise FileNotFoundError(
            "config.train.start must be a file of weights; there is none at "
            f"{config.train.start}. Give its path, or '' to start from fresh weights."
        )
    start = load_params(config.train.start)
    radii = getattr(config.model, "local_geometry", 0)
    if 0 <= getattr(start.config, "local_geometry", radii) < radii:
        start = with_local_geometry(start, radii)
    require_shapes(
        {name: array.shape for name, array in flatten(start).items()},
        parameter_shapes(config.model, start.networks),
        f"config.train.start={config.train.start}",
        "Give weights of the same widths as config.model, or set config.train.start=''.",
    )
    return dataclasses.replace(start, config=config.model)
