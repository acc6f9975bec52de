"""Where the package keeps what it need not make twice, and files that appear whole or not."""

import os
import uuid
from pathlib import Path


def cache_folder() -> Path:
    """The user's cache folder for this package; it need not exist yet."""
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "dbdnet_jax"


def write_atomic(path: Path, data: bytes | bytearray | memoryview) -> None:
    """Write a file; an interrupted or failed write leaves what was there before.

    Raises:
      OSError: the folder is missing, not writable, or full.
    """
    # In the same folder, since only a rename within a file system is atomic.
    temporary = path.with_name(f".{path.name}.{uuid.uuid4().hex[:8]}.tmp")
    try:
        with open(temporary, "xb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)
