"""Weights on disk: one ``.npz`` file with the arrays, the configuration and a checksum."""

from __future__ import annotations

import dataclasses
import functools
import hashlib
import io
import json
import math
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from dbdnet_jax.errors import CheckpointError
from dbdnet_jax.io.files import write_atomic
from dbdnet_jax.io.forks import require_own_jax
from dbdnet_jax.networks.params import (
    Params,
    flatten,
    require_finite,
    require_shapes,
    unflatten,
)
from dbdnet_jax.networks.table import DEFAULT_METHOD, LEARNED, method_of, parameter_shapes

PRETRAINED = Path(__file__).parent / "pretrained"
_FORMAT = 1
_WIDEST = 65_536  # features of a layer; the widest known have 1,024
_MOST_MEMBERS = 20_000  # the largest network that a configuration may ask for has 6,000
_HEADER, _CHECKSUM = "header", "sha256"


def save_params(
    path: str | Path, params: Params, *, metadata: Mapping[str, Any] | None = None
) -> None:
    """Write ``params`` and their configuration to one ``.npz`` file.

    The file appears whole or not at all: an interrupted or failed write leaves what was there.

    Args:
      path: the file; its folder must exist. An existing file is replaced.
      params: the parameters of any method, all of its networks or some.
      metadata: anything JSON can hold, for people: origin, data, figures.

    Raises:
      CheckpointError: the arrays do not fit the configuration, or are no finite floating-point
        numbers: such a file could not be loaded.
      OSError: the folder is missing, not writable, or full.
    """
    arrays = flatten(params)
    _check(arrays, params.config, "params")
    content = {
        "format": _FORMAT,
        "model": dataclasses.asdict(params.config),
        "metadata": dict(metadata or {}),
    }
    method = method_of(params.config)
    if method != DEFAULT_METHOD:
        content["method"] = method
    header = json.dumps(content, sort_keys=True)
    path = Path(path)
    if not path.parent.is_dir():
        raise FileNotFoundError(
            f"The folder of a file of weights must exist; {path.parent} does not. Create it."
        )
    members: dict[str, Any] = {_HEADER: header, _CHECKSUM: _checksum(header, arrays), **arrays}
    buffer = io.BytesIO()
    np.savez(buffer, **members)
    write_atomic(path, buffer.getbuffer())


def load_params(path: str | Path) -> Params:
    """Read what ``save_params`` wrote.

    Raises:
      CheckpointError: the file is truncated or altered, has a field or version this release does
        not know, a configuration out of bounds, or arrays that do not fit it or are not finite.
      OSError: the file cannot be opened.
      RuntimeError: the process was forked after JAX was used.
    """
    require_own_jax("load_params")
    header, arrays = _read(path)
    method = header.get("method", DEFAULT_METHOD)
    config = read_model(method, header["model"], str(path))
    _check(arrays, config, str(path))
    native = {name: x.astype(x.dtype.newbyteorder("="), copy=False) for name, x in arrays.items()}
    return unflatten(native, config)


def read_model(method: str, fields: Mapping[str, Any], owner: str) -> Any:
    """The configuration of a method's network from its fields, as JSON holds them.

    Raises:
      CheckpointError: a method or a field that this release does not know, or a value it refuses.
    """
    if not isinstance(method, str) or method not in LEARNED:
        raise CheckpointError(
            f"{owner}: the method must be one of {', '.join(LEARNED)}; got {method!r}. Update "
            "dbdnet_jax: a newer release wrote the file."
        )
    record = LEARNED[method].config
    unknown = sorted(set(fields) - {field.name for field in dataclasses.fields(record)})
    if unknown:
        raise CheckpointError(
            f"{owner}: every field of the configuration must be known; {', '.join(unknown)} "
            "is not. Update dbdnet_jax: a newer release wrote the file."
        )
    for name, value in fields.items():
        for width in value if isinstance(value, list) else ():
            if type(width) is not int or not 1 <= width <= _WIDEST:
                raise CheckpointError(
                    f"{owner}: the configuration cannot be built: {name} must hold whole numbers "
                    f"from 1 to {_WIDEST}; got {width!r:.60}. Save it again with save_params."
                )
    try:
        # JSON has no tuples; a configuration must be hashable.
        return record(**{k: tuple(v) if isinstance(v, list) else v for k, v in fields.items()})
    except (TypeError, ValueError, ArithmeticError) as error:
        raise CheckpointError(f"{owner}: the configuration cannot be built: {error}") from error


def load_pretrained(name: str = "cad") -> Params:
    """The weights of that name that come with the package.

    Raises:
      CheckpointError: there are none of that name; those there are, are listed.
    """
    available = {file.stem: file for file in sorted(PRETRAINED.glob("*.npz"))}
    if name not in available:
        raise CheckpointError(
            f"name must be one of the weights in {PRETRAINED} ({', '.join(available) or 'none'}); "
            f"got {name!r}. Train them with `python train.py --config=configs/cad.py` and read "
            "the result with load_params(path), or read the authors' with from_released(path)."
        )
    return load_params(available[name])


def load_named(name: str) -> Params:
    """Weights by the path of a ``.npz`` file, or by their name in the package.

    Raises:
      FileNotFoundError: no such file.
      CheckpointError: no such name; otherwise as `load_params`.
    """
    if not name.endswith(".npz"):
        return load_pretrained(name)
    if not Path(name).exists():
        raise FileNotFoundError(
            f"weights must be a .npz file, or a name in the package; there is no file {name}. "
            "Train first, or give --params=cad."
        )
    return load_params(name)


def load_once(name: str) -> Params:
    """Weights as `load_named` has them, read anew only where their file has changed."""
    path = Path(name).absolute() if name.endswith(".npz") else None
    if path is None or not path.exists():
        return _load_stamped(name, None)
    status = path.stat()
    return _load_stamped(str(path), (status.st_mtime_ns, status.st_size, status.st_ino))


def weights_digest(name: str) -> str | None:
    """The sha256 of the file that `load_named` reads; None where it is not on this machine."""
    path = Path(name) if name.endswith(".npz") else PRETRAINED / f"{name}.npz"
    return hashlib.sha256(path.read_bytes()).hexdigest() if path.is_file() else None


@functools.lru_cache(maxsize=2)
def _load_stamped(name: str, _: tuple[int, ...] | None) -> Params:
    return load_named(name)


def _checksum(header: str, arrays: Mapping[str, np.ndarray]) -> str:
    """Hash of the header and of every array's name, type, shape and bytes."""
    digest = hashlib.sha256(header.encode())
    for name in sorted(arrays):
        array = np.ascontiguousarray(arrays[name])
        digest.update(f"\n{name} {array.dtype.str} {array.shape}\n".encode())
        digest.update(array.data)
    return digest.hexdigest()


def _read(path: str | Path) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Header and arrays of a file, its checksum verified."""
    try:
        with open(path, "rb") as file:
            arrays = _members(file)
        text, checksum = (str(arrays.pop(name)[()]) for name in (_HEADER, _CHECKSUM))
    except OSError:
        raise
    except Exception as error:  # NumPy and zipfile answer damage with a dozen types of error
        raise CheckpointError(
            f"{path}: the file is truncated, damaged or was not written by save_params "
            f"({type(error).__name__}: {error}). Fetch it or save it again; a PyTorch "
            "checkpoint is read by from_released."
        ) from error
    if _checksum(text, arrays) != checksum:
        raise CheckpointError(
            f"{path}: the content must hash to the sha256 it was saved with, {checksum[:12]}...; "
            "it was altered or damaged. Fetch it or save it again."
        )
    return _header(text, str(path)), arrays


def _members(file: Any) -> dict[str, np.ndarray]:
    """The arrays of an archive as `numpy.savez` writes it: stored, none larger than its bytes.

    `numpy.load` would believe what the archive and its arrays say of their sizes, and a file of a
    few megabytes may unpack to any number of gigabytes.
    """
    size = file.seek(0, io.SEEK_END)
    arrays = {}
    with zipfile.ZipFile(file) as archive:
        members = archive.infolist()
        stored = all(member.compress_type == zipfile.ZIP_STORED for member in members)
        if not stored or sum(member.file_size for member in members) > size:
            raise ValueError("its arrays must be stored uncompressed, as save_params does")
        if len(members) > _MOST_MEMBERS:
            raise ValueError(f"it must hold at most {_MOST_MEMBERS} arrays; got {len(members)}")
        for member in members:
            with archive.open(member) as stream:
                arrays[member.filename.removesuffix(".npy")] = _array(stream, member.file_size)
    return arrays


def _array(stream: Any, size: int) -> np.ndarray:
    """One array of numbers or text in NumPy's format, which must fill ``size`` bytes exactly."""
    version = np.lib.format.read_magic(stream)
    read_head = {(1, 0): "read_array_header_1_0", (2, 0): "read_array_header_2_0"}[version]
    shape, fortran, dtype = getattr(np.lib.format, read_head)(stream)
    data = stream.read(size)
    if dtype.kind not in "fiubU" or math.prod(shape) * dtype.itemsize != len(data):
        raise ValueError(f"an array of {dtype} {shape} does not fill {len(data)} bytes")
    return np.ndarray(shape, dtype, data, order="F" if fortran else "C")


def _header(text: str, path: str) -> dict[str, Any]:
    """The header's fields, their types checked: a checksum says nothing about sense."""
    try:
        header = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise CheckpointError(
            f"{path}: the header must be JSON; {error}. Fetch it or save it again."
        ) from error
    if not isinstance(header, dict) or header.get("format") != _FORMAT:
        got = header.get("format") if isinstance(header, dict) else header
        raise CheckpointError(
            f"{path}: the format must be {_FORMAT}; got {got!r:.60}. Update dbdnet_jax."
        )
    for name in ("model", "metadata"):
        if not isinstance(header.get(name), dict):
            raise CheckpointError(
                f"{path}: the header must hold an object named {name!r}; got "
                f"{header.get(name)!r:.60}. Save it again with save_params."
            )
    return header


def _check(arrays: Mapping[str, np.ndarray], config: Any, owner: str) -> None:
    """Refuse arrays that are not the parameters of the networks they name."""
    expected = parameter_shapes(config, {name.split("/")[0] for name in arrays})
    require_shapes(
        {name: array.shape for name, array in arrays.items()},
        expected,
        owner,
        "Do configuration and arrays come from the same training?",
    )
    wrong = [
        f"{name} ({array.dtype})"
        for name, array in arrays.items()
        if array.dtype.kind != "f" or array.dtype.itemsize > 8
    ]
    if wrong or not arrays:
        raise CheckpointError(
            f"{owner} must hold float16, float32 or float64 parameters; got "
            f"{', '.join(wrong) or 'no array'}. Convert them first."
        )
    require_finite(arrays, owner)
