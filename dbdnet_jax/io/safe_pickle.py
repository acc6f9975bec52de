"""Unpickling of containers, numbers, text, NumPy arrays and tensor records, running nothing.

A pickle is a program: it may name any function of the process and call it. Here it may name the
few things of ``_Reader.find_class``, which are plain functions of this file or bare strings, never
torch's or NumPy's own; every other name is refused before anything is called. Sizes and strides
are checked against the data, so that no header makes more of a file than it holds.
"""

from __future__ import annotations

import io
import math
import mmap
import pickle
import re
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np

from dbdnet_jax.errors import CheckpointError
from dbdnet_jax.io.pickle_bounds import MOST_OPCODES, MOST_OPCODES_OF_TENSORS, check_pickle

_STORAGES = {
    "DoubleStorage": "f8",
    "FloatStorage": "f4",
    "HalfStorage": "f2",
    "LongStorage": "i8",
    "IntStorage": "i4",
    "ShortStorage": "i2",
    "CharStorage": "i1",
    "ByteStorage": "u1",
    "BoolStorage": "b1",
}
_PLAIN_DTYPE = re.compile(r"b1|[iu][1248]|f[248]|c8|c16|[SU]\d{1,6}")
_MAX_DIMENSIONS = 32


class Storage(NamedTuple):
    """The numbers that tensors share: ``length`` of them, of NumPy type ``code``."""

    key: str
    code: str
    length: int


class _Tensor(NamedTuple):
    """A tensor whose storage has not been located yet; offset and strides in elements."""

    storage: Storage
    offset: int
    shape: tuple[int, ...]
    strides: tuple[int, ...]


class _Admitted:
    """A function that a pickle may call and cannot alter."""

    __slots__ = ("_call",)

    def __init__(self, call: Callable[..., Any]):
        self._call = call

    def __call__(self, *args: Any) -> Any:
        return self._call(*args)

    def __setstate__(self, state: Any) -> None:
        raise CheckpointError("A pickle may not set a function's state. Do not trust the file.")


class _Dtype:
    """Stands for ``numpy.dtype``, whose own state setter believes whatever offsets it is given."""

    __slots__ = ("value",)

    def __init__(self, code: Any, *_: Any):
        if not isinstance(code, str) or not _PLAIN_DTYPE.fullmatch(code):
            raise CheckpointError(
                f"Arrays hold plain numbers or text; got dtype {str(code)[:40]!r}. "
                "Save the array as numbers."
            )
        self.value = np.dtype(code)

    def __setstate__(self, state: Any) -> None:
        _, byte_order, base, names, fields = state[:5]
        if (base, names, fields) != (None, None, None):
            raise CheckpointError(
                f"Arrays hold plain numbers or text; got a structured dtype of fields "
                f"{str(names)[:40]}. Save the fields one by one."
            )
        self.value = self.value.newbyteorder(byte_order)


class _Array:
    """Stands for ``numpy.ndarray`` until its state is there and checked."""

    __slots__ = ("value",)

    def __init__(self, value: np.ndarray | None = None):
        self.value = value

    def __setstate__(self, state: Any) -> None:
        _, shape, dtype, fortran, raw = state
        self.value = _array(raw, dtype, shape, "F" if fortran else "C")


class _Ordered(dict):
    """Stands for ``OrderedDict``; its attributes (torch's ``_metadata``) are dropped."""

    def __setstate__(self, state: Any) -> None:
        pass


class _Reader(pickle.Unpickler):
    """Unpickler of one object; see the module."""

    def __init__(self, data: bytes, tensors: bool):
        super().__init__(io.BytesIO(data))
        self._tensors = tensors
        self._budget = len(data)
        self.storages: dict[str, Storage] = {}

    def find_class(self, module: str, name: str) -> Any:
        # NumPy 2 and Python 3 renamed these.
        module = module.replace("numpy._core", "numpy.core").replace("__builtin__", "builtins")
        if module == "torch" and name in _STORAGES:
            return _STORAGES[name]
        admitted: dict[str, Callable[..., Any] | str] = {
            "collections.OrderedDict": lambda *items: _Ordered(*map(self._charged, items)),
            "collections.Counter": lambda *items: _Ordered(*map(self._charged, items)),
            "builtins.set": lambda *items: set(*map(self._charged, items)),
            "builtins.frozenset": lambda *items: frozenset(*map(self._charged, items)),
            "builtins.bytes": lambda: b"",  # protocol 2 writes empty bytes so,
            "_codecs.encode": self._encode,  # and all others so
            "numpy.ndarray": "ndarray",
            "numpy.dtype": _Dtype,
            "numpy.core.multiarray._reconstruct": lambda kind, shape, code: _Array(),
            "numpy.core.multiarray.scalar": lambda dtype, raw: _array(raw, dtype, (), "C")[()],
            "numpy.core.numeric._frombuffer": lambda *args: _Array(_array(*args)),
            "torch.Size": lambda sizes: _counts(sizes, "torch.Size"),
            "torch._utils._rebuild_tensor_v2": _tensor,
            "torch._utils._rebuild_parameter": lambda tensor, requires_grad, hooks: tensor,
        }
        if f"{module}.{name}" not in admitted:
            raise CheckpointError(
                f"Only tensors, arrays and plain containers are read; the file asks for "
                f"{module}.{name}, and nothing of it was run. If you trust its author, have it "
                "saved as a plain state dict: torch.save(model.state_dict(), path)."
            )
        value = admitted[f"{module}.{name}"]
        return value if isinstance(value, str) else _Admitted(value)

    def persistent_load(self, pid: Any) -> Storage:
        kind, code, key, _, length, *view = pid
        if not self._tensors or kind != "storage" or code not in _STORAGES.values() or any(view):
            raise CheckpointError(
                f"Only whole storages of tensors are read; the file refers to {str(pid)[:60]!r}. "
                "Save model.state_dict() with a current torch."
            )
        storage = Storage(str(key), code, *_counts((length,), "The size of a storage"))
        if self.storages.setdefault(storage.key, storage) != storage:
            raise CheckpointError(
                f"A storage has one type and size; {storage.key!r} is declared twice, differently. "
                "Fetch the file or save it again."
            )
        return storage

    def _encode(self, text: str, encoding: str) -> bytes:
        if encoding != "latin1":
            raise CheckpointError(
                f"Bytes are written as latin1; got {str(encoding)[:40]!r}. Do not trust the file."
            )
        return self._charged(text).encode("latin1")

    def _charged(self, items: Any) -> Any:
        # These calls copy their argument, which a hostile file may repeat at a few bytes each;
        # an honest one copies each thing that it contains once.
        self._budget -= len(items)
        if self._budget < 0:
            raise CheckpointError("The file copies more than it contains. Do not trust it.")
        return items


def unpickle(
    data: mmap.mmap | memoryview, start: int, *, tensors: bool = True
) -> tuple[Any, int, dict[str, Storage]]:
    """One pickled object, where its pickle ends, and the storages it refers to by key.

    Arrays and tensors in it are stand-ins: ``finish`` makes them. Raises ``CheckpointError`` for
    what is refused and whatever ``pickle`` raises for what is damaged.
    """
    stream: Any = data if isinstance(data, mmap.mmap) else io.BytesIO(data)
    stream.seek(start)
    check_pickle(stream, MOST_OPCODES_OF_TENSORS if tensors else MOST_OPCODES)
    end = stream.tell()
    reader = _Reader(bytes(data[start:end]), tensors)
    return reader.load(), end, reader.storages


def finish(value: Any, buffers: Mapping[str, memoryview], big_endian: bool = False) -> Any:
    """Copy of the containers of ``value`` with arrays in place of what stood for them.

    ``buffers`` holds each storage's bytes by key. Shared objects stay shared, and a container may
    hold itself.
    """
    done: dict[int, Any] = {}

    def visit(part: Any) -> Any:
        if id(part) in done:
            return done[id(part)]
        result = part
        if isinstance(part, _Tensor):
            result = _view(part, buffers[part.storage.key], big_endian)
        elif isinstance(part, (_Array, _Dtype)):
            result = part.value
        elif isinstance(part, dict):
            result = done[id(part)] = {}
            result.update((visit(key), visit(entry)) for key, entry in part.items())
        elif isinstance(part, list):
            result = done[id(part)] = []
            result.extend(map(visit, part))
        elif isinstance(part, (tuple, set, frozenset)):
            result = type(part)(map(visit, part))
        done[id(part)] = result
        return result

    return visit(value)


def _counts(values: Any, what: str) -> tuple[int, ...]:
    if len(values) > _MAX_DIMENSIONS or not all(type(v) is int and 0 <= v < 2**62 for v in values):
        raise CheckpointError(
            f"{what} must be at most {_MAX_DIMENSIONS} whole numbers from 0; "
            f"got {str(values)[:60]}. Fetch the file or save it again."
        )
    return tuple(values)


def _array(raw: Any, dtype: Any, shape: Any, order: str) -> np.ndarray:
    """Array over the pickled bytes ``raw``, which it must fill exactly."""
    shape = _counts(shape, "The shape of an array")
    if len(raw) != math.prod(shape) * dtype.value.itemsize:
        raise CheckpointError(
            f"An array of shape {shape} and type {dtype.value} does not fill {len(raw)} bytes. "
            "Fetch the file or save it again."
        )
    array = np.ndarray(shape, dtype.value, raw, order="F" if order == "F" else "C")
    array.flags.writeable = False
    return array


def _tensor(storage: Any, offset: Any, shape: Any, strides: Any, *_: Any) -> _Tensor:
    """Tensor record whose last element lies inside its storage."""
    (offset,) = _counts((offset,), "The offset of a tensor")
    shape = _counts(shape, "The shape of a tensor")
    strides = _counts(strides, "The strides of a tensor")
    last = offset + sum((n - 1) * step for n, step in zip(shape, strides, strict=True))
    if math.prod(shape) and last >= storage.length:
        raise CheckpointError(
            f"A tensor must lie inside its storage of {storage.length} numbers; shape {shape}, "
            f"strides {strides} and offset {offset} reach number {last + 1}. Do not trust the file."
        )
    return _Tensor(storage, offset, shape, strides)


def _view(tensor: _Tensor, buffer: memoryview, big_endian: bool) -> np.ndarray:
    dtype = np.dtype(tensor.storage.code).newbyteorder(">" if big_endian else "<")
    if len(buffer) < tensor.storage.length * dtype.itemsize:
        raise CheckpointError(
            f"Storage {tensor.storage.key!r} should hold {tensor.storage.length} numbers of "
            f"{dtype.itemsize} bytes; {len(buffer)} bytes are there. Fetch the file again."
        )
    if not math.prod(tensor.shape):
        return np.empty(tensor.shape, dtype)
    strides = [step * dtype.itemsize for step in tensor.strides]
    return np.ndarray(tensor.shape, dtype, buffer, tensor.offset * dtype.itemsize, strides)
