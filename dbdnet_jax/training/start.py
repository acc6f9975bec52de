"""The weights that a stage starts from."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import jax

from dbdnet_jax.errors import CheckpointError
from dbdnet_jax.networks.dbdnet.growing import with_local_geometry
from dbdnet_jax.networks.initial import init_params
from dbdnet_jax.networks.params import Params, flatten, require_shapes
from dbdnet_jax.networks.table import method_of, parameter_shapes
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
    What else of ``config.model`` may be another than theirs is in `describe_start`.

    Raises:
        FileNotFoundError: there is no such file.
        CheckpointError: it is damaged, or of another architecture.
    """
    start = _read_start(config)
    radii = getattr(config.model, "local_geometry", 0)
    if 0 <= getattr(start.config, "local_geometry", radii) < radii:
        start = with_local_geometry(start, radii)
    require_shapes(
        {name: array.shape for name, array in flatten(start).items()},
        parameter_shapes(config.model, start.networks),
        f"config.train.start={config.train.start}",
        "Give weights of the same widths as config.model, or set config.train.start=''.",
    )
    heads = [getattr(model, "heads", None) for model in (start.config, config.model)]
    if heads[0] != heads[1]:
        raise CheckpointError(
            "config.model.heads must be that of the weights, whose channels are divided among so "
            f"many; got {heads[1]} for {config.train.start} with {heads[0]}. Use {heads[0]}."
        )
    return dataclasses.replace(start, config=config.model)


def describe_start(config: RunConfig) -> str:
    """A line that names the fields of ``config.model`` that the weights to start from had not."""
    found = _read_start(config).config
    fields = [(field.name, getattr(found, field.name)) for field in dataclasses.fields(found)]
    pairs = ((name, was, getattr(config.model, name)) for name, was in fields)
    changes = [f"{name} = {was} (now {now})" for name, was, now in pairs if was != now]
    model = ", ".join(changes) or "the same config.model"
    return f"The weights in {config.train.start} were trained with {model}."


def _read_start(config: RunConfig) -> Params:
    if not Path(config.train.start).is_file():
        raise FileNotFoundError(
            "config.train.start must be a file of weights; there is none at "
            f"{config.train.start}. Give its path, or '' to start from fresh weights."
        )
    start = load_params(config.train.start)
    if (method := method_of(start.config)) != config.method:
        raise CheckpointError(
            f"config.train.start must be weights of the method {config.method}; "
            f"{config.train.start} holds some of {method}. Give others, or '' to start from fresh "
            "weights."
        )
    return start
