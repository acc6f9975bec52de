"""Compiled and traced programs kept on disk: making them takes seconds, reading them back none."""

import contextlib
import functools
import hashlib
import json
import threading
import time
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jaxlib
from jax import export

from dbdnet_jax.io.files import cache_folder, require_writable, warn_without_cache, write_atomic

TRACED = (
    "types.py",
    "ops/*.py",
    "classical/refine.py",
    "networks/**/*.py",
    "alignment/pose_programs.py",
)
_FOLDER = "jax_compilation_cache_dir"
_NOTED = "whole.json"  # the entries that were found whole
_SPENT = threading.local()
_ZSTANDARD = b"\x28\xb5\x2f\xfd"  # how its frames begin


def keep_compiled_programs() -> None:
    """Let JAX keep compiled programs in the user's cache folder: compiling takes most of a run.

    Where JAX has been told of another folder (``JAX_COMPILATION_CACHE_DIR``), that one is used. A
    folder that cannot be used is said so, once, and nothing is kept.
    """
    given = jax.config.values[_FOLDER]
    if given == "" or "://" in (given or ""):  # none is wanted, or it is no file system's
        return
    folder = cache_folder("programs") if given is None else Path(given)
    if folder is not None:
        try:
            folder.mkdir(parents=True, exist_ok=True)
            require_writable(folder)
            _drop_damaged(folder)
        except (OSError, ValueError) as error:
            warn_without_cache(str(error))
            folder = None
    if folder is None or given is None:
        jax.config.update(_FOLDER, None if folder is None else str(folder))
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.2)


def require_device() -> None:
    """Start JAX on the platform that it is told to use.

    Raises:
      ValueError: this machine has no such platform.
    """
    try:
        jax.devices()
    except Exception as error:  # which one depends on the platform: an AssertionError for CUDA
        said = " ".join(str(error).split())[:300]
        raise ValueError(
            "JAX_PLATFORMS must name platforms that this machine has; got "
            f"{jax.config.values['jax_platforms']!r}{said and f' ({said})'}. Unset it, or use "
            "JAX_PLATFORMS=cpu."
        ) from error


def load_or_trace(function: Callable, name: str, *arguments: Any) -> Callable:
    """``function`` compiled for arguments like these, through a file where JAX keeps its programs.

    That is ``jax_compilation_cache_dir``; where it is not set, without one. ``arguments`` and
    results must be arrays in dicts, lists and tuples. The file's name is the hash of ``name``, the
    arguments' structure and shapes, the source that is traced, precisions and versions; it starts
    with the hash of the rest, so that a damaged one is made again. A folder that cannot be written
    costs a warning.
    """
    start = time.perf_counter()
    try:
        return _compiled(function, name, arguments)
    finally:
        _SPENT.seconds = loading_seconds() + time.perf_counter() - start


def loading_seconds() -> float:
    """How long this thread has spent in `load_or_trace`: no part of an alignment's work."""
    return getattr(_SPENT, "seconds", 0.0)


def _compiled(function: Callable, name: str, arguments: tuple) -> Callable:
    folder = jax.config.values[_FOLDER]
    shapes = jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype), arguments)
    if not folder:
        return jax.jit(function).lower(*shapes).compile()
    # Of this thread, where a context manager may have changed them.
    names = ("jax_enable_x64", "jax_default_matmul_precision")
    precision = [getattr(jax.config, name) for name in names]
    versions = jax.__version__, jaxlib.__version__
    identity = repr((name, shapes, versions, jax.default_backend(), precision, _source_hash()))
    path = Path(folder) / f"{hashlib.sha256(identity.encode()).hexdigest()[:32]}.stablehlo"
    exported = _read_kept(path)
    if exported is None:
        exported = export.export(jax.jit(function))(*shapes)
        _keep(path, exported)
    return jax.jit(exported.call).lower(*shapes).compile()


def _read_kept(path: Path) -> export.Exported | None:
    """The program in a file; None where there is none, or none that is whole."""
    try:
        data = path.read_bytes()
        size = hashlib.sha256().digest_size
        if hashlib.sha256(data[size:]).digest() != data[:size]:
            return None
        return export.deserialize(bytearray(data[size:]))
    except Exception:  # whatever is the matter with it: it is made again, and replaced
        return None


def _keep(path: Path, exported: export.Exported) -> None:
    """Write a program behind its hash; other processes may do the same at the same time."""
    data = bytes(exported.serialize())
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        write_atomic(path, hashlib.sha256(data).digest() + data)
    except OSError as error:
        warn_without_cache(str(error))


def _drop_damaged(folder: Path) -> None:
    """Delete JAX's entries that are not whole: it would compile anew each time, and replace none.

    JAX deflates them, and a deflated stream ends with a checksum; entries of zstandard, where that
    is installed, have none, and are left to JAX. What was found whole is noted by its size and the
    time of its last change, and not unpacked again until one of these differs.
    """
    noted, whole = _read_noted(folder / _NOTED), {}
    for path in folder.glob("*-cache"):
        with contextlib.suppress(FileNotFoundError):  # another process was faster
            state = path.stat()
            mark = [state.st_size, state.st_mtime_ns]
            if noted.get(path.name) != mark:
                data = path.read_bytes()
                if data[:4] != _ZSTANDARD and not _is_deflated(data):
                    path.unlink()
                    continue
            whole[path.name] = mark
    if whole != noted:
        write_atomic(folder / _NOTED, json.dumps(whole).encode())


def _read_noted(path: Path) -> dict[str, Any]:
    """What a note says of the entries; nothing where there is none, or it is damaged."""
    try:
        noted = json.loads(path.read_bytes())
    except (OSError, ValueError):
        return {}
    return noted if isinstance(noted, dict) else {}


def _is_deflated(data: bytes) -> bool:
    """Whether it is one deflated stream and no more, unpacked in parts of bounded size."""
    stream = zlib.decompressobj()
    try:
        while data and not stream.eof:
            stream.decompress(data, 1 << 24)
            data = stream.unconsumed_tail
    except zlib.error:
        return False
    return stream.eof and not stream.unused_data


@functools.cache
def _source_hash() -> str:
    """Of the files that a program is traced through: yesterday's source must not run today."""
    package = Path(__file__).parents[1]
    digest = hashlib.sha256()
    for path in sorted(path for name in TRACED for path in package.glob(name)):
        digest.update(path.read_bytes())
    return digest.hexdigest()
