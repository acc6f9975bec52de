"""Errors with a meaning of their own, what loads an extra, and errors as records."""

import importlib.util
import re
import traceback
from types import ModuleType
from typing import Literal, NamedTuple


class CheckpointError(ValueError):
    """A file that cannot be read: refused, damaged, or not what its reader expects."""


class MissingExtraError(ImportError):
    """A library is not installed; the text says which, and what to install."""


class Failure(NamedTuple):
    """Why there is no answer: an error as a record, which any process can pass to any other.

    ``kind`` is "input" (unusable, and ``message`` says why), "memory", "crash" (the process died)
    or "unexpected"; ``where`` is the traceback, if there was one.
    """

    kind: Literal["input", "memory", "crash", "unexpected"]
    message: str
    where: str = ""


def failure_of(error: BaseException) -> Failure:
    """An error as a record, its message a sentence."""
    what, where = str(error), "".join(traceback.format_exception(error))
    if isinstance(error, MemoryError) or re.search("RESOURCE_EXHAUSTED|[Oo]ut of memory", what):
        what = f"out of memory: {what.splitlines()[0] if what else 'no details'}"
        return Failure("memory", f"{what}. Give fewer points, or stop other programs.", where)
    if isinstance(error, ValueError | OSError | ImportError):
        return Failure("input", what, where)
    what = " ".join(what.split())[:1000]
    return Failure("unexpected", f"unexpected {type(error).__name__}: {what}.", where)


def load_open3d(needed_by: str) -> ModuleType:
    """Import Open3D; ``needed_by`` begins the sentence that says it is missing.

    Raises:
        MissingExtraError: it is not installed, or does not start.
    """
    try:
        import open3d
    except (ImportError, OSError) as error:  # OSError: the wheel is there, a system library is not
        raise MissingExtraError(
            f"{needed_by} needs Open3D; importing it failed ({error}). Install it with "
            '`pip install "dbdnet_jax[baselines]"`; on Debian also '
            "`apt-get install libusb-1.0-0 libgl1 libgomp1`."
        ) from error
    return open3d


def require_drawing() -> None:
    """Refuse, before any work is done, to draw without the libraries that do.

    Raises:
        MissingExtraError: one is missing.
    """
    missing = [x for x in ("plotly", "matplotlib", "jinja2") if importlib.util.find_spec(x) is None]
    if missing:
        raise MissingExtraError(
            f"reports and pictures need {', '.join(missing)}; not installed. "
            'Run `pip install "dbdnet_jax[report]"`.'
        )
