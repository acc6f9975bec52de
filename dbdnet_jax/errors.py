"""Files that cannot be read, and libraries that only an extra of the package brings."""

import importlib.util
from types import ModuleType


class CheckpointError(ValueError):
    """A file that cannot be read: refused, damaged, or not what its reader expects."""


class MissingExtraError(ImportError):
    """A library is not installed; the text says which, and what to install."""


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
