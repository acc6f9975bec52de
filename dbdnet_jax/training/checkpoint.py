"""Checkpoints of a training run: the newest two and the best one, each written as a whole.

A run folder holds one folder for each stage, named as the network it trains (``joint``: all of
them, further); in it ``stage.json`` says what the stage trains, of which method, and
``checkpoints/STEP`` holds a state at a step.
Weights to share are another matter: see `dbdnet_jax.networks.weights`.
"""

from __future__ import annotations

import json
import zlib
from pathlib import Path
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from dbdnet_jax.errors import CheckpointError
from dbdnet_jax.io.files import write_atomic
from dbdnet_jax.networks.batch_norm import join_batch_stats
from dbdnet_jax.networks.params import Params
from dbdnet_jax.networks.table import DEFAULT_METHOD, LEARNED
from dbdnet_jax.networks.weights import read_model

JOINT = "joint"  # all networks of a method, further
KEPT = 2  # newest checkpoints; the second survives when the first is damaged

State = TypeVar("State")


class Checkpoints:
    """The checkpoints of one stage, in ``folder/checkpoints``; created if need be.

    Orbax writes each one under a temporary name and renames it, so that a run killed while
    writing leaves the ones before it as they were.
    """

    def __init__(self, folder: Path):
        from orbax.checkpoint import v1 as ocp

        keep = ocp.training.preservation_policies
        self.folder = folder.absolute() / "checkpoints"
        best = keep.BestN(
            get_metric_fn=lambda metrics: metrics["error"],
            reverse=True,  # the smallest error last, which is the end that Orbax keeps
            n=1,
            keep_checkpoints_without_metrics=False,
        )
        try:
            self._orbax = ocp.training.Checkpointer(
                self.folder,
                preservation_policy=keep.AnyPreservationPolicy([keep.LatestN(KEPT), best]),
                cleanup_tmp_directories=True,
            )
        except Exception as error:  # Orbax raises many kinds; none of them says what to do
            raise CheckpointError(
                f"checkpoints must be readable; those in {self.folder} are not "
                f"({_first_line(error)}). Delete that folder and start the stage again."
            ) from error

    def __enter__(self) -> Checkpoints:
        return self

    def __exit__(self, *_: object) -> None:
        self._orbax.close()

    def latest_step(self) -> int | None:
        """The newest checkpoint's step; None when there is none."""
        newest = self._orbax.latest
        return None if newest is None else newest.step

    def best_step(self) -> int | None:
        """The step with the smallest validation error (the latest of equals), if any."""
        validated = [c for c in self._orbax.checkpoints if c.metrics is not None]
        return (
            min(validated, key=lambda c: (c.metrics["error"], -c.step)).step if validated else None
        )

    def save(self, step: int, state: Any, error: float | None = None) -> None:
        """Write ``state`` and delete what need not be kept; ``error`` is the validation's."""
        state = jax.device_get(state)  # NumPy arrays: readable whatever devices there are then
        self._orbax.save(
            step,
            state,
            metrics=None if error is None else {"error": error},
            custom_metadata={"crc32": _checksum(state)},
            force=True,
        )

    def restore(self, step: int, like: State) -> State:
        """The state of ``step``, with the structure, shapes and types of ``like``.

        Raises:
            CheckpointError: it cannot be read, or is not what was written.
        """
        like = jax.tree.map(lambda leaf: np.empty(leaf.shape, leaf.dtype), like)
        return jax.tree.map(jnp.asarray, self._read(step, like))

    def restore_weights(self, step: int) -> Any:
        """The weights of ``step`` to use: their moving average where one was kept.

        With them the running averages of batch norms, where there are any.
        """
        state = self._read(step, None)
        weights = state["params"] if state.get("ema") is None else state["ema"]
        if state.get("batch_stats") is not None:
            weights = join_batch_stats(weights, state["batch_stats"])
        return jax.tree.map(jnp.asarray, weights)

    def _read(self, step: int, like: Any) -> Any:
        try:
            written = self._orbax.metadata(step).custom_metadata["crc32"]
            state = self._orbax.load(step, like)
            intact = _checksum(state) == written  # Orbax does not notice a flipped bit
            reason = "its checksum is wrong"
        except Exception as error:
            intact, reason = False, _first_line(error)
        if not intact:
            others = [c.step for c in self._orbax.checkpoints if c.step < step]
            then = f"the one before it, step {others[-1]}," if others else "the start"
            raise CheckpointError(
                f"a checkpoint must be as it was written; {self.folder / str(step)} is damaged "
                f"({reason}). Delete that folder: training then goes on from {then} again."
            )
        return state


def write_stage(
    folder: Path, record: dict[str, Any], defaults: dict[str, Any] | None = None
) -> None:
    """Put ``stage.json`` into a stage's folder, or check that the one there says the same.

    What an older release did not write is taken from ``defaults``, a part of a record.

    Raises:
        CheckpointError: the folder is of another configuration; names the first field that differs.
    """
    path = folder / "stage.json"
    record = json.loads(json.dumps(record))
    if not path.exists():
        folder.mkdir(parents=True, exist_ok=True)
        write_atomic(path, (json.dumps(record, indent=1) + "\n").encode())
        return
    wanted, known = _flatten(record), _flatten(json.loads(json.dumps(defaults or {})))
    found = {name: known[name] for name in known if name in wanted}
    found |= _flatten(read_stage(folder))
    for name in sorted(found.keys() | wanted.keys()):
        if found.get(name) != wanted.get(name):
            raise CheckpointError(
                f"a run can only go on with the configuration it was started with; {folder} has "
                f"{name} = {found.get(name)}, this configuration {wanted.get(name)}. Give another "
                "--run_dir, or delete that folder to start anew."
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
            f"({_first_line(error)}). Give the folder of a run of train.py, or delete {folder} and "
            "train again."
        ) from error


def load_best(run_dir: str | Path, *, joint: bool = True) -> Params:
    """The best weights of a run: of each stage that was trained, the smallest validation error.

    Those of the joint stage where it has any, unless ``joint`` is False.

    Raises:
        CheckpointError: no stage has a validated checkpoint, or one is damaged.
    """
    networks: dict[str, Any] = {}
    model = None
    method = _method(Path(run_dir))
    parts = LEARNED[method].parts
    for stage in (*parts, JOINT) if joint else parts:
        folder = Path(run_dir) / stage
        if not (folder / "checkpoints").is_dir():
            continue
        with Checkpoints(folder) as checkpoints:
            step = checkpoints.best_step()
            if step is not None:
                found = checkpoints.restore_weights(step)
                networks |= found if stage == JOINT else {stage: found}
                model = _model_config(folder, method)
    if model is None:
        raise CheckpointError(
            f"a run folder must hold a validated checkpoint; {run_dir} has none. Train first: "
            "python train.py --config=configs/NAME.py --run_dir=..."
        )
    return Params(networks, model)


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
            f"{LEARNED[method].config.__name__} ({_first_line(error)}). Use the version of "
            "dbdnet_jax that trained it, or train again."
        ) from error


def _checksum(tree: Any) -> int:
    """The sum of all leaves' CRC-32: the same whatever containers and order they are read in."""
    return sum(zlib.crc32(np.asarray(leaf).tobytes()) for leaf in jax.tree.leaves(tree))


def _flatten(record: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    flat: dict[str, Any] = {}
    for name, value in record.items():
        flat |= (
            _flatten(value, f"{prefix}{name}.")
            if isinstance(value, dict)
            else {prefix + name: value}
        )
    return flat


def _first_line(error: BaseException) -> str:
    return f"{type(error).__name__}: {error}".splitlines()[0][:200]
