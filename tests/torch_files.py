"""Writers of torch's two file formats, for tests without torch."""

import contextlib
import io
import os
import pickle
import struct
import sys
import types
import zipfile
from collections import OrderedDict
from unittest import mock

import numpy as np

MAGIC = 0x1950A86A20F9469CFC6C
_STORAGES = {"f8": "Double", "f4": "Float", "f2": "Half", "i8": "Long", "u1": "Byte", "b1": "Bool"}


class _Storage:
    def __init__(self, numbers):
        self.numbers = numbers


class Tensor:
    """A tensor that shares the flat array ``numbers`` with others; strides in elements."""

    def __init__(self, numbers, shape, strides, offset=0):
        self.numbers, self.shape, self.strides, self.offset = numbers, shape, strides, offset

    def __reduce__(self):
        rebuild = sys.modules["torch._utils"]._rebuild_tensor_v2
        storage = _Storage(self.numbers)
        return rebuild, (storage, self.offset, self.shape, self.strides, False, OrderedDict())


def tensor(array) -> Tensor:
    """The contiguous tensor of an array."""
    array = np.asarray(array)
    strides = tuple(int(np.prod(array.shape[axis + 1 :])) for axis in range(array.ndim))
    return Tensor(array.reshape(-1), array.shape, strides)


class Parameter:
    """A tensor wrapped as torch's modules hold it."""

    def __init__(self, array):
        self.array = array

    def __reduce__(self):
        rebuild = sys.modules["torch._utils"]._rebuild_parameter
        return rebuild, (tensor(self.array), True, OrderedDict())


class Touches:
    """Creates a folder when a pickle that holds it is loaded by ``pickle`` itself."""

    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return os.mkdir, (str(self.path),)


@contextlib.contextmanager
def torch_names():
    """Stand-ins for the modules whose names a checkpoint mentions."""
    torch, utils = types.ModuleType("torch"), types.ModuleType("torch._utils")
    for name in ("_rebuild_tensor_v2", "_rebuild_parameter"):
        function = types.FunctionType((lambda: None).__code__, {}, name)
        function.__module__, function.__qualname__ = "torch._utils", name
        setattr(utils, name, function)
    for name in _STORAGES.values():
        setattr(torch, f"{name}Storage", type(f"{name}Storage", (), {"__module__": "torch"}))
    with mock.patch.dict(sys.modules, {"torch": torch, "torch._utils": utils}):
        yield torch


class _Pickler(pickle.Pickler):
    def __init__(self, file, torch, view):
        super().__init__(file, 2)
        self.torch, self.view, self.storages = torch, view, {}

    def persistent_id(self, obj):
        if not isinstance(obj, _Storage):
            return None
        numbers = obj.numbers
        key = next((k for k, x in self.storages.items() if x is numbers), str(len(self.storages)))
        self.storages[key] = numbers
        kind = getattr(self.torch, _STORAGES[numbers.dtype.str[1:]] + "Storage")
        return ("storage", kind, key, "cpu", numbers.size, *self.view)


def _pickled(value, view) -> tuple[bytes, dict[str, np.ndarray]]:
    with torch_names() as torch:
        file = io.BytesIO()
        pickler = _Pickler(file, torch, view)
        pickler.dump(value)
    return file.getvalue(), pickler.storages


def save_zip(path, value, byteorder="little", compression=zipfile.ZIP_STORED) -> None:
    """Write ``value`` in the zip format."""
    data, storages = _pickled(value, ())
    with zipfile.ZipFile(path, "w", compression) as archive:
        archive.writestr("archive/data.pkl", data)
        archive.writestr("archive/byteorder", byteorder)
        for key, numbers in storages.items():
            order = "<" if byteorder == "little" else ">"
            archive.writestr(
                f"archive/data/{key}", numbers.astype(numbers.dtype.newbyteorder(order)).tobytes()
            )
        archive.writestr("archive/version", "3\n")


def save_stream(path, value, byteorder="little") -> None:
    """Write ``value`` in the stream format."""
    data, storages = _pickled(value, (None,))
    system = {"protocol_version": 1001, "little_endian": byteorder == "little", "type_sizes": {}}
    order = "<" if byteorder == "little" else ">"
    with open(path, "wb") as file:
        for part in (MAGIC, 1001, system):
            pickle.dump(part, file, 2)
        file.write(data)
        pickle.dump(list(storages), file, 2)
        for numbers in storages.values():
            file.write(struct.pack(f"{order}q", numbers.size))
            file.write(numbers.astype(numbers.dtype.newbyteorder(order)).tobytes())


def write(path, *parts: bytes):
    """Make a file of ``parts``; returns its path."""
    path.write_bytes(b"".join(parts))
    return path
