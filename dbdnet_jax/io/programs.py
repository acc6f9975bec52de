"""Compiled and traced programs kept on disk: making them takes seconds, reading them back none."""

import functools
import hashlib
from collections.abc import Callable
from pathlib import Path

import jax
from jax import export

from dbdnet_jax.io.files import cache_folder, write_atomic

TRACED = (
    "types.py",
    "ops/*.py",
    "classical/refine.py",
    "networks/**/*.py",
    "alignment/search.py",
)


def keep_compiled_programs() -> None:
    """Let JAX keep compiled programs in the user's cache folder: compiling takes most of a run.

    Where JAX has been told of another folder (``JAX_COMPILATION_CACHE_DIR``), that one is used.
    """
    if jax.config.values["jax_compilation_cache_dir"] is None:
        jax.config.update("jax_compilation_cache_dir", str(cache_folder() / "programs"))
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.2)


def load_or_trace(function: Callable, name: str, *arguments) -> Callable:
    """``function`` jitted for arguments like these, through a file where JAX keeps its programs.

    That is ``jax_compilation_cache_dir``; where it is not set, plain `jax.jit`. ``arguments`` and
    results must be arrays in dicts, lists and tuples. The file's name is the hash of ``name``, the
    arguments' structure and shapes, the source that is traced and JAX's version.
    """
    folder = jax.config.values["jax_compilation_cache_dir"]
    if folder is None:
        return jax.jit(function)
    shapes = jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype), arguments)
    precision = (
        jax.config.values["jax_enable_x64"],
        jax.config.values["jax_default_matmul_precision"],
    )
    built = jax.__version__, jax.default_backend(), precision, _source_hash()
    identity = repr((name, shapes, *built))
    path = Path(folder) / f"{hashlib.sha256(identity.encode()).hexdigest()[:32]}.stablehlo"
    try:
        exported = export.deserialize(bytearray(path.read_bytes()))
    except OSError:
        exported = export.export(jax.jit(function))(*shapes)
        path.parent.mkdir(parents=True, exist_ok=True)
        write_atomic(path, exported.serialize())
    return jax.jit(exported.call)


@functools.cache
def _source_hash() -> str:
    """Of the files that a program is traced through: yesterday's source must not run today."""
    package = Path(__file__).parents[1]
    digest = hashlib.sha256()
    for path in sorted(path for name in TRACED for path in package.glob(name)):
        digest.update(path.read_bytes())
    return digest.hexdigest()
