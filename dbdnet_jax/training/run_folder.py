"""The folder of a training run, and the best weights in it.

It holds one folder for each stage, named as the network it trains (``joint``: all of them,
further); in it ``stage.json`` says what the stage trains, of which method, beside the checkpoints.
"""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

from dbdnet_jax.errors import CheckpointError
from dbdnet_jax.io.files import write_atomic
from dbdnet_jax.networks.params import Params
from dbdnet_jax.networks.table import DEFAULT_METHOD, LEARNED
from dbdnet_jax.networks.weights import read_model
from dbdnet_jax.training.checkpoint import Checkpoints, first_line

JOINT = "joint"  # all networks of a method, further


def write_stage(
    folder: Path, record: dict[str, Any], defaults: dict[str, Any] | None = None
) -> None:
    """Put ``stage.json`` into a stage's folder, or check that the one there says the same.

    Raises:
        CheckpointError: as `require_same_run`.
    """
    require_same_run(folder, record, defaults)
    path = folder / "stage.json"
    if not path.exists():
        folder.mkdir(parents=True, exist_ok=True)
        write_atomic(path, (json.dumps(record, indent=1) + "\n").encode())


def require_same_run(
    folder: Path, record: dict[str, Any], defaults: dict[str, Any] | None = None
) -> None:
    """Refuse a stage of another configuration than was begun in ``folder``, or another network.

    The other stages of the run have settings of their own, but are of the same method and model.
    What an older release did not write is taken from ``defaults``, a part of a record.

    Raises:
        CheckpointError: names the first field that differs.
    """
    wanted, known = _flatten(_plain(record)), _flatten(_plain(defaults or {}))
    for path in sorted(folder.parent.glob("*/stage.json")):
        found = {name: known[name] for name in known if name in wanted}
        found |= _flatten(_plain(read_stage(path.parent)))
        names = found.keys() | wanted.keys()
        if path.parent != folder:
            names = {name for name in names if name.split(".")[0] in ("method", "model")}
        for name in sorted(names):
            if found.get(name) != wanted.get(name):
                raise CheckpointError(
                    "a run can only go on with the configuration it was started with; "
                    f"{path.parent} has {name} = {found.get(name)}, this configuration "
                    f"{wanted.get(name)}. Give another --run_dir, or delete that folder to start "
                    "anew."
                )


def read_stage(folder: Path) -> dict[str, Any]:
    """What ``stage.json`` in a stage's folder says.

    Raises:
        CheckpointError: there is none, or it is damaged.
    """
    path = folder / "stage.json"
    try:
        return json.loads(path.read_text())
    except (OSError, ValueError) as error:
        raise CheckpointError(
            f"a stage's folder must hold a readable stage.json; {path} is not "
            f"({first_line(error)}). Give the folder of a run of train.py, or delete {folder} and "
            "train again."
        ) from error


def load_best(run_dir: str | Path, *, joint: bool = True) -> Params:
    """The best weights of a run: of each stage that was trained, the smallest validation error.

    Those of the joint stage where it has any, unless ``joint`` is False.

    Raises:
        CheckpointError: no stage has a validated checkpoint, one is damaged, or the stages' models
            differ.
    """
    networks: dict[str, Any] = {}
    models: dict[Path, Any] = {}
    method = _method(Path(run_dir))
    parts = LEARNED[method].parts
    for stage in (*parts, JOINT) if joint else parts:
        folder = Path(run_dir) / stage
        if not (folder / "checkpoints").is_dir():
            continue
        with Checkpoints(folder, read_only=True) as checkpoints:
            step = checkpoints.best_step()
            if step is not None:
                found = checkpoints.restore_weights(step)
                networks |= found if stage == JOINT else {stage: found}
                models[folder] = _model_config(folder, method)
    if not models:
        raise CheckpointError(
            f"a run folder must hold a validated checkpoint; {run_dir} has none. Train first: "
            "python train.py --config=configs/NAME.py --run_dir=..."
        )
    return Params(networks, _only_model(models))


def was_trained(run_dir: str | Path) -> bool:
    """Whether a folder holds checkpoints of any stage."""
    return any(Path(run_dir).glob("*/checkpoints"))


def _method(run_dir: Path) -> str:
    """The method that a run's stages train; that of every stage must be the same."""
    found = {
        path.parent.name: read_stage(path.parent).get("method", DEFAULT_METHOD)
        for path in sorted(run_dir.glob("*/stage.json"))
    }
    methods = set(found.values()) or {DEFAULT_METHOD}
    if len(methods) > 1 or not methods <= LEARNED.keys():
        raise CheckpointError(
            f"all stages of a run must train one method out of {', '.join(LEARNED)}; those in "
            f"{run_dir} are of {found}. Give each method a --run_dir of its own, or use the "
            "version of dbdnet_jax that trained it."
        )
    return methods.pop()


def _model_config(folder: Path, method: str) -> Any:
    try:
        return read_model(method, read_stage(folder)["model"], str(folder / "stage.json"))
    except (KeyError, TypeError, CheckpointError) as error:
        raise CheckpointError(
            f"'model' in {folder / 'stage.json'} must be the fields of "
            f"{LEARNED[method].config.__name__} ({first_line(error)}). Use the version of "
            "dbdnet_jax that trained it, or train again."
        ) from error


def _only_model(models: dict[Path, Any]) -> Any:
    """The configuration of a run's networks, which that of every stage must be."""
    (first, model), *others = models.items()
    for folder, other in others:
        for field in dataclasses.fields(model):
            values = getattr(model, field.name), getattr(other, field.name)
            if values[0] != values[1]:
                raise CheckpointError(
                    f"all networks of a run must be of one configuration; {first} has "
                    f"model.{field.name} = {values[0]}, {folder} {values[1]}. Delete one of the "
                    "two and train it again as the other one, or in another --run_dir."
                )
    return model


def _plain(record: dict[str, Any]) -> dict[str, Any]:
    """A record as JSON gives it back, with the method that it leaves out."""
    return {"method": DEFAULT_METHOD, **json.loads(json.dumps(record))}


def _flatten(record: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    flat: dict[str, Any] = {}
    for name, value in record.items():
        flat |= (
            _flatten(value, f"{prefix}{name}.")
            if isinstance(value, dict)
            else {prefix + name: value}
        )
    return flat
