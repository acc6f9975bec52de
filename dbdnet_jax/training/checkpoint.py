"""Checkpoints of a training run: the newest two and the best one, each written as a whole.

``checkpoints/STEP`` in a stage's folder (`dbdnet_jax.training.run_folder`) holds a state at a step.
Weights to share are another matter: see `dbdnet_jax.networks.weights`.
"""

from __future__ import annotations

import contextlib
import json
import logging
import warnings
import zlib
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax.experimental import multihost_utils

from dbdnet_jax.errors import CheckpointError
from dbdnet_jax.io.files import machine_error
from dbdnet_jax.networks.batch_norm import join_batch_stats

KEPT = 2  # newest checkpoints; the second survives when the first is damaged

State = TypeVar("State")


class Resumed(NamedTuple):
    """What a run goes on from: ``window`` holds the steps' numbers since the log's last row."""

    step: int
    state: Any
    window: list[dict[str, float]]


class Checkpoints:
    """The checkpoints of one stage, in ``folder/checkpoints``; created if need be.

    Orbax writes each one under a temporary name and renames it, so that a run killed while
    writing leaves the ones before it as they were. What a kill left is deleted, but for
    ``read_only``, beside which a training may be writing.
    """

    def __init__(self, folder: Path, *, read_only: bool = False):
        from orbax.checkpoint import v1 as ocp

        keep = ocp.training.preservation_policies
        self.folder = folder.absolute() / "checkpoints"
        best = keep.BestN(
            get_metric_fn=lambda metrics: metrics["error"],
            reverse=True,  # the smallest error last, which is the end that Orbax keeps
            n=1,
            keep_checkpoints_without_metrics=False,
        )
        damaged = self._without_metrics()
        if damaged and read_only:
            raise CheckpointError(_advice(damaged))
        _set_aside(damaged)
        try:
            with _logs_silenced():
                self._orbax = ocp.training.Checkpointer(
                    self.folder,
                    preservation_policy=keep.AnyPreservationPolicy([keep.LatestN(KEPT), best]),
                    cleanup_tmp_directories=not read_only,
                )
        except Exception as error:  # Orbax raises many kinds; none of them says what to do
            raise machine_error(error, self.folder) or CheckpointError(
                f"checkpoints must be readable; those in {self.folder} are not "
                f"({first_line(error)}). Move what is no checkpoint out of that folder."
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

    def save(
        self,
        step: int,
        state: Any,
        error: float | None = None,
        window: Sequence[dict[str, float]] = (),
    ) -> None:
        """Write ``state`` and delete what need not be kept; ``error`` is the validation's.

        Raises:
            OSError: the disk is full, or another error of the machine.
        """
        state = jax.device_get(state)  # NumPy arrays: readable whatever devices there are then
        try:
            self._orbax.save(
                step,
                state,
                metrics=None if error is None else {"error": error},
                custom_metadata={"crc32": _checksum(state), "window": list(window)},
                force=True,
            )
        except Exception as failure:  # which kind depends on where Orbax was
            if of_machine := machine_error(failure, self.folder):
                raise of_machine from failure
            raise

    def resume(self, like: State) -> Resumed | None:
        """The newest checkpoint that is whole, as `restore` gives it; None if there is none at all.

        Damaged ones that are newer are renamed ``damaged-STEP``, with a warning.

        Raises:
            CheckpointError: there are checkpoints, and all are damaged.
        """
        damaged: dict[Path, str] = {}
        for step in sorted((found.step for found in self._orbax.checkpoints), reverse=True):
            state, damage = self._read(step, _numpy_like(like))
            if damage:
                damaged[self._path(step)] = damage
                continue
            _set_aside(damaged)
            self._orbax.reload()
            window = self._orbax.metadata(step).custom_metadata.get("window", [])
            return Resumed(step, jax.tree.map(jnp.asarray, state), window)
        if damaged:
            raise CheckpointError(_advice(damaged))
        return None

    def restore(self, step: int, like: State) -> State:
        """The state of ``step``, with the structure, shapes and types of ``like``.

        Raises:
            CheckpointError: it cannot be read, or is not what was written.
            OSError: the machine could not read it, which says nothing of the checkpoint.
        """
        return jax.tree.map(jnp.asarray, self._intact(step, _numpy_like(like)))

    def restore_weights(self, step: int) -> Any:
        """The weights of ``step`` to use: their moving average where one was kept.

        With them the running averages of batch norms, where there are any.
        """
        state = self._intact(step, None)
        weights = state["params"] if state.get("ema") is None else state["ema"]
        if state.get("batch_stats") is not None:
            weights = join_batch_stats(weights, state["batch_stats"])
        return jax.tree.map(jnp.asarray, weights)

    def _intact(self, step: int, like: Any) -> Any:
        state, damage = self._read(step, like)
        if damage:
            raise CheckpointError(_advice({self._path(step): damage}))
        return state

    def _read(self, step: int, like: Any) -> tuple[Any, str]:
        """The state of ``step``, and what is wrong with it ("": nothing)."""
        with _logs_silenced():
            return self._attempt(step, like)

    def _attempt(self, step: int, like: Any) -> tuple[Any, str]:
        try:
            written = self._orbax.metadata(step).custom_metadata["crc32"]
            state = self._orbax.load(step, like)
        except Exception as error:  # which kind depends on which file is damaged
            _LATE.leave_out(self._path(step))
            if failure := machine_error(error, self._path(step)):
                raise failure from error
            return None, first_line(error)
        # Orbax does not notice a flipped bit.
        return state, "" if _checksum(state) == written else "its checksum is wrong"

    def _path(self, step: int) -> Path:
        return self.folder / str(step)

    def _without_metrics(self) -> dict[Path, str]:
        """Checkpoints whose metrics cannot be read, which would keep Orbax from reading any."""
        found = {}
        for path in self.folder.glob("*/metrics/metrics"):
            checkpoint = path.parents[1]
            if not checkpoint.name.isdigit():  # half written, or set aside
                continue
            try:
                float(json.loads(path.read_bytes())["error"])
            except (ValueError, KeyError, TypeError) as error:
                found[checkpoint] = f"its metrics: {first_line(error)}"
        return found


class _Late(logging.Filter):
    """Leaves out what asyncio says of failed tasks when they are collected: it was said before."""

    def __init__(self) -> None:
        super().__init__()
        self._folders: set[str] = set()

    def leave_out(self, folder: Path) -> None:
        """Tasks that failed on what lies in a folder."""
        self._folders.add(f"{folder}/")
        logging.getLogger("asyncio").addFilter(self)  # once, however often it is added

    def filter(self, record: logging.LogRecord) -> bool:
        """Whether a record is of something else."""
        message = record.getMessage()
        return not any(folder in message for folder in self._folders)


_LATE = _Late()


@contextlib.contextmanager
def _logs_silenced() -> Iterator[None]:
    """Of a damaged file libraries log pages; what counts is in the error."""
    before = logging.root.manager.disable
    logging.disable(logging.CRITICAL)
    try:
        yield
    finally:
        logging.disable(before)


def _set_aside(damaged: dict[Path, str]) -> None:
    """Rename damaged checkpoints, each with a warning: the steps are taken again, and saved.

    Of several processes the first does it, and the others wait.
    """
    for path, reason in damaged.items() if jax.process_index() == 0 else ():
        count = sum(1 for _ in path.parent.glob(f"damaged-{path.name}*"))
        aside = path.with_name(f"damaged-{path.name}" + (f"-{count}" if count else ""))
        warnings.warn(
            f"the checkpoint {path} is damaged ({reason}) and skipped; it is now {aside}, which "
            "may be deleted.",
            RuntimeWarning,
            stacklevel=4,
        )
        path.rename(aside)
    multihost_utils.sync_global_devices("damaged checkpoints are set aside")


def _advice(damaged: dict[Path, str]) -> str:
    """Which checkpoints are damaged, why, and what to do."""
    named = ", ".join(f"{path} is damaged ({reason})" for path, reason in damaged.items())
    return (
        f"a checkpoint must be as it was written; {named}. Delete what is named here: the "
        "newest of the others is used then, or training starts anew where there is none."
    )


def _numpy_like(tree: Any) -> Any:
    """What Orbax is told to read: NumPy arrays, whatever devices there are."""
    return jax.tree.map(lambda leaf: np.empty(leaf.shape, leaf.dtype), tree)


def _checksum(tree: Any) -> int:
    """The sum of all leaves' CRC-32: the same whatever containers and order they are read in."""
    return sum(zlib.crc32(np.asarray(leaf).tobytes()) for leaf in jax.tree.leaves(tree))


def first_line(error: BaseException) -> str:
    """What went wrong, short enough to be a part of a sentence."""
    return f"{type(error).__name__}: {error}".splitlines()[0][:200]
