"""Where the package keeps what it need not make twice, and files that appear whole or not."""

import errno
import functools
import os
import re
import stat
import uuid
import warnings
from pathlib import Path

# What says nothing of a file's content: limits and rights of the process, the disk, its server.
MACHINE_ERRORS = {
    getattr(errno, name)
    for name in (
        *(
            "EMFILE",
            "ENFILE",
            "ENOMEM",
            "EACCES",
            "EPERM",
            "EROFS",
            "ENOSPC",
            "EDQUOT",
            "EFBIG",
            "EIO",
        ),
        *("ESTALE", "ETIMEDOUT", "EAGAIN", "EBUSY"),
    )
}


def cache_folder(name: str) -> Path | None:
    """A private folder for what can be made again; None, and a warning, where there can be none.

    It is ``dbdnet_jax/NAME`` in ``XDG_CACHE_HOME``, else in ``~/.cache``, made with mode 0700. What
    stands in it is executed, so a folder that is another user's, or that others may write to, is
    not used. A cache is never needed: no home, a full disk or a file in its place are no errors.
    """
    try:
        base = _cache_home()
        for folder in (base, base / "dbdnet_jax", base / "dbdnet_jax" / name):
            if not folder.is_dir():
                folder.mkdir(mode=0o700, parents=True, exist_ok=True)
                folder.chmod(0o700)  # whatever the umask
            _refuse_foreign(folder, owned=folder != base)
    except (OSError, ValueError) as error:
        warn_without_cache(str(error))
        return None
    return folder


def require_writable(folder: Path) -> None:
    """Refuse a folder that files cannot be made in, or that cannot be made itself.

    Raises:
      OSError: says why; asked of the disk, since a mode says nothing to root or of a full disk.
    """
    there = next(path for path in (folder, *folder.absolute().parents) if path.exists())
    probe = there / f".{uuid.uuid4().hex}.tmp"
    try:
        probe.write_bytes(b"?")
        probe.unlink()
    except OSError as error:
        raise type(error)(
            f"the folder {folder} must be one that files can be written to; {there}: "
            f"{error.strerror}. Choose another, or make room."
        ) from error


def machine_error(error: BaseException, path: Path) -> OSError | None:
    """The error of the machine (`MACHINE_ERRORS`) that made reading or writing ``path`` fail.

    ``error`` may be any library's: what caused it is looked at too, and TensorStore's text. None
    where no such error is behind it.
    """
    seen: BaseException | None = error
    while seen is not None:
        number = seen.errno if isinstance(seen, OSError) else None
        if isinstance(seen, MemoryError):
            number = errno.ENOMEM
        if number is None and (said := re.search(r"\[OS error (\d+):", str(seen))):
            number = int(said[1])
        if number is not None and number in MACHINE_ERRORS:
            return OSError(number, os.strerror(number), str(path))
        seen = seen.__cause__ or seen.__context__
    return None


@functools.cache  # once for each reason, however many programs are kept
def warn_without_cache(reason: str) -> None:
    """Say that nothing is kept, and go on."""
    warnings.warn(
        f"nothing is kept for the next run, which takes longer for it: {reason.rstrip('.')}. "
        "Set XDG_CACHE_HOME to a folder of your own.",
        RuntimeWarning,
        stacklevel=3,
    )


def _cache_home() -> Path:
    """The folder of all caches of this user, which need not exist yet."""
    given = os.environ.get("XDG_CACHE_HOME", "")
    if os.path.isabs(given):  # the specification says to ignore others
        return Path(given)
    try:
        home = Path.home()
    except (RuntimeError, KeyError) as error:  # neither HOME nor an entry in passwd
        raise ValueError("this user has no home folder") from error
    if not home.is_absolute():
        raise ValueError(f"HOME must be an absolute path; got {str(home)!r}")
    return home / ".cache"


def _refuse_foreign(folder: Path, *, owned: bool = True) -> None:
    """Raise ``PermissionError`` where another user could put files into the folder, or replace it.

    ``owned=False`` is for what others may share: a folder of root's, or one with the sticky bit.
    """
    if not hasattr(os, "geteuid"):  # Windows: a home is its user's
        return
    status = folder.stat()
    trusted = {os.geteuid()} if owned else {os.geteuid(), 0}
    loose = stat.S_IWOTH | (stat.S_IWGRP if owned else 0)
    shared = status.st_mode & loose and (owned or not status.st_mode & stat.S_ISVTX)
    if status.st_uid not in trusted or shared:
        raise PermissionError(
            f"the folder {folder} must be this user's alone; its owner is {status.st_uid}, its "
            f"mode {stat.S_IMODE(status.st_mode):o}. Delete it, or chmod it to 700"
        )


def write_atomic(path: Path, data: bytes | bytearray | memoryview) -> None:
    """Write a file; an interrupted or failed write leaves what was there before.

    Raises:
      OSError: the folder is missing, not writable, or full.
    """
    # In the same folder, since only a rename within a file system is atomic.
    temporary = path.with_name(f".{uuid.uuid4().hex}.tmp")
    try:
        with open(temporary, "xb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)
