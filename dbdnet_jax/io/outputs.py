"""Files to be written, checked before any work is done."""

import os
from collections.abc import Iterable, Iterator
from pathlib import Path

TRANSFORM_ENDINGS = (".txt", ".json", ".npy")


def check_output(path: Path, endings: tuple[str, ...]) -> None:
    """Refuse a file that could not be written.

    Raises:
      ValueError: another ending.
      OSError: no such folder, or it is not writable.
    """
    if path.suffix.lower() not in endings:
        raise ValueError(
            f"the ending of an output must be one of {' '.join(endings)}; got {path}. Rename it."
        )
    if path.is_dir():
        raise IsADirectoryError(f"an output must be a file; {path} is a folder. Name a file in it.")
    if path.parent.exists() and not path.parent.is_dir():
        raise NotADirectoryError(
            f"the folder of an output must be a folder; {path.parent} is a file. Name another."
        )
    if not path.parent.is_dir():
        raise FileNotFoundError(
            f"the folder of an output must exist; {path.parent} does not. Create it."
        )
    if not os.access(path.parent, os.W_OK):
        raise PermissionError(f"the folder {path.parent} must be writable. Choose another.")


def require_apart(inputs: Iterable[Path], outputs: Iterable[Path]) -> None:
    """Refuse outputs that would replace an input or one another, by whatever name.

    Links are followed, hard ones compared, and names that differ only in capitals count as one:
    on some file systems they are.

    Raises:
      ValueError: names the output and what it is.
    """
    taken = {key: path for path in inputs for key in _identities(path)}
    for path in outputs:
        keys = list(_identities(path))
        other = next((taken[key] for key in keys if key in taken), None)
        if other is not None:
            raise ValueError(
                f"an output must not replace an input or another output; {path} is also {other}. "
                "Give it another name."
            )
        taken |= dict.fromkeys(keys, path)


def _identities(path: Path) -> Iterator[object]:
    """What is equal for two names of one file, there or not."""
    for name in (os.path.realpath(path), os.path.join(os.path.realpath(path.parent), path.name)):
        yield name.casefold()
    try:
        status = path.stat()
    except (OSError, ValueError):
        return
    yield status.st_dev, status.st_ino
