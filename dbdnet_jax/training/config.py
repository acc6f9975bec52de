"""A configuration as records: what `configs/*.py` says, checked once, before anything starts.

Every field has its default in its record; a configuration states the differences.
"""

from __future__ import annotations

import dataclasses
import difflib
import typing
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ml_collections import ConfigDict

from dbdnet_jax.data.config import DataConfig
from dbdnet_jax.data.pairs import Protocol
from dbdnet_jax.networks.table import DEFAULT_METHOD, LEARNED
from dbdnet_jax.training.table import STAGES
from dbdnet_jax.training.task import RunConfig, TrainConfig

LARGEST = 1e15  # of any number: whole numbers below it are exact as floats, and no count is larger


def default_config(method: str = DEFAULT_METHOD) -> ConfigDict:
    """Every field there is for a method, at its default; locked, so that a typo is an error.

    The batch size and learning rate of DBDNet's stages follow those of ``config.train`` until set.
    A method of a single stage takes its own from ``config.STAGE``.
    """
    config = ConfigDict({"method": method})
    for name, record in _sections(method).items():
        config[name] = ConfigDict(dataclasses.asdict(record()))
    if len(STAGES[method]) > 1:
        for stage in STAGES[method]:
            for field in ("batch_size", "learning_rate"):
                config[stage][field] = config.train.get_oneway_ref(field)
    return config.lock()


def read_config(config: ConfigDict) -> RunConfig:
    """The records of a configuration.

    Raises:
        ValueError: an unknown method or field (the nearest valid one is named), a missing one, or a
            value that its record refuses.
    """
    given = config.to_dict()
    method = given.pop("method", DEFAULT_METHOD)
    if not isinstance(method, str) or method not in LEARNED:
        raise ValueError(
            f"config.method must be one of {', '.join(LEARNED)}; got {method!r}. Choose one."
        )
    sections = _sections(method)
    _require_known(given, sections, "config", "the sections of the method")
    missing = [name for name in sections if name not in given]
    if missing:
        raise ValueError(
            f"config must hold every section of the method {method}; it lacks "
            f"{', '.join(missing)}. Start from `default_config` and state only the differences."
        )
    records = {
        name: read_record(record, given[name], f"config.{name}")
        for name, record in sections.items()
    }
    stages = {name: records.pop(name) for name in STAGES[method]}
    return RunConfig(method=method, stages=stages, **records)


def _sections(method: str) -> dict[str, type]:
    """The records of a configuration by their names in it."""
    shared = {"model": LEARNED[method].config, "data": DataConfig, "protocol": Protocol}
    stages = {name: stage.record for name, stage in STAGES[method].items()}
    return {**shared, "train": TrainConfig, **stages}


def _require_known(given: Mapping[str, Any], known: Mapping[str, Any], where: str, of: str) -> None:
    for name in given:
        if name not in known:
            near = difflib.get_close_matches(name, known, n=1, cutoff=0.0)[0]
            raise ValueError(
                f"{where} must hold only {of}; got {where}.{name}. Did you mean {where}.{near}?"
            )


def read_record(record: type, section: Mapping[str, Any], where: str) -> Any:
    """``record`` from a mapping of its fields, the others at their defaults; nested ones alike."""
    types = typing.get_type_hints(record)
    _require_known(section, types, where, f"the fields of {record.__name__}")
    values = {
        name: _read_value(types[name], value, f"{where}.{name}") for name, value in section.items()
    }
    try:
        return record(**values)
    except ValueError as error:
        if str(error).startswith("config."):
            raise
        raise ValueError(f"in {where}: {error}") from error


def _read_value(kind: Any, value: Any, where: str) -> Any:
    """A field's value: of the field's type, and finite; for a nested record, the record."""
    if dataclasses.is_dataclass(kind):
        if not isinstance(value, Mapping):
            raise ValueError(
                f"{where} must be a section of fields; got {value!r:.60}. Start from a config in "
                "configs/."
            )
        return read_record(typing.cast(type, kind), value, where)
    if typing.get_origin(kind) is tuple:
        if not isinstance(value, tuple | list):
            raise ValueError(
                f"{where} must be of type tuple; got {value!r:.60} ({type(value).__name__}). Give "
                "a value of that type."
            )
        inside = typing.get_args(kind)
        kinds = inside[:1] * len(value) if inside[-1:] == (...,) else inside
        if len(kinds) != len(value):
            raise ValueError(
                f"{where} must be {len(kinds)} values; got {len(value)}. Give so many."
            )
        return tuple(map(_read_value, kinds, value, [where] * len(value)))
    accepted = (int, float) if kind is float else kind
    if not isinstance(value, accepted) or (isinstance(value, bool) and kind is not bool):
        raise ValueError(
            f"{where} must be of type {kind.__name__}; got {value!r:.60} "
            f"({type(value).__name__}). Give a value of that type."
        )
    if isinstance(value, int | float) and not abs(value) < LARGEST:
        raise ValueError(
            f"{where} must be finite and below {LARGEST:g}; got {value!r:.60}. Give such a number."
        )
    return float(value) if kind is float else value


def stage_record(config: RunConfig, stage: str) -> dict[str, Any]:
    """What decides the outcome of a stage, as plain JSON values: a run may resume only with it.

    Where the rate is constant but for the last epochs, a run may be prolonged or cut short.
    """
    stages = (*STAGES[config.method][stage].reads, stage)
    record = {
        name: dataclasses.asdict(section)
        for name, section in (
            ("model", config.model),
            ("data", config.data),
            ("protocol", config.protocol),
            ("train", config.train),
            *((name, config.stages[name]) for name in stages),
        )
    }
    if config.train.schedule == "constant":
        del record[stage]["epochs"]
    # Of the first three only rounding depends; the stage holds the last two.
    for name in ("devices", "accumulate", "remat", "batch_size", "learning_rate"):
        del record["train"][name]
    return record if config.method == DEFAULT_METHOD else {"method": config.method, **record}


def stage_defaults(config: RunConfig) -> dict[str, Any]:
    """`stage_record` at the defaults: what the fields of older releases' runs are completed by."""
    return {name: dataclasses.asdict(record()) for name, record in _sections(config.method).items()}


def parse_flags(arguments: list[str]) -> list[str]:
    """``flags_parser`` of `absl.app.run` that says in one line what is wrong with ``--config``."""
    from absl import app, flags
    from ml_collections import config_flags

    try:
        rest = app.parse_flags_with_usage(arguments)
    except (AttributeError, KeyError) as error:  # from ml_collections, for an unknown field
        message = error.args[0]
        while isinstance(message, BaseException):
            message = message.args[0]
        field, *hint = str(message).splitlines()
        raise SystemExit(
            f"error: only fields of the configuration can be set; it has no {field}. "
            f"{' '.join(hint)}".rstrip()
        ) from None
    except (ValueError, TypeError) as error:  # a value that is of another type than its field
        raise SystemExit(f"error: {error}") from None
    path = config_flags.get_config_filename(flags.FLAGS["config"])
    if not Path(path).is_file():
        raise SystemExit(
            f"error: --config must be a file such as configs/cad.py; there is none at {path}. "
            "Start in the folder that holds configs/, or give the whole path."
        )
    return rest
