"""One training at a time in a folder."""

from __future__ import annotations

import contextlib
import os
import shlex
import socket
import sys
import warnings
from collections.abc import Iterator
from pathlib import Path

LOCK = "training.lock"


@contextlib.contextmanager
def sole_training(folder: Path) -> Iterator[None]:
    """Keep other processes from training in ``folder``, which is made if need be.

    The lock is the kernel's and ends with the process, however that ends; the file that carries it
    says whose it is, and stays. A file system without locks costs a warning.

    Raises:
        BlockingIOError: another process holds it; says which.
    """
    import fcntl

    folder.mkdir(parents=True, exist_ok=True)
    path = folder / LOCK
    with path.open("a+", errors="replace") as file:
        try:
            fcntl.lockf(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except (BlockingIOError, PermissionError) as error:  # POSIX allows either
            file.seek(0)
            raise BlockingIOError(
                f"only one training may work in a folder; in {folder} there is "
                f"{file.read().strip() or 'another one'}. Wait for it or stop it, or give another "
                "--run_dir."
            ) from error
        except OSError as error:
            warnings.warn(
                f"the file system of {folder} has no locks ({error.strerror}): take care that no "
                "second training is started there.",
                RuntimeWarning,
                stacklevel=3,
            )
        file.truncate(0)
        file.write(f"process {os.getpid()} on {socket.gethostname()} ({shlex.join(sys.argv)})\n")
        file.flush()
        yield
