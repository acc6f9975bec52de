"""PyTorch checkpoints and pickled NumPy arrays, read without torch and without running them.

Two formats, as ``torch.serialization`` writes them: a zip archive (records ``data.pkl``,
``data/KEY``, ``byteorder``), and the stream of pickles before it (magic number, version, system,
object, storage keys) with the storages behind. What a pickle may hold is in ``safe_pickle``.
"""

from __future__ import annotations

import io
import mmap
import struct
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from dbdnet_jax.errors import CheckpointError
from dbdnet_jax.io.safe_pickle import finish, unpickle

_STREAM_MAGIC = 0x1950A86A20F9469CFC6C
_STREAM_VERSION = 1001
_MOST_RECORDS = 20_000  # of an archive: reading its directory takes time for each


def load_torch(path: str | Path) -> Any:
    """What ``torch.save`` wrote: tensors as NumPy arrays, ordered dictionaries as ``dict``.

    Args:
      path: a checkpoint in the zip or in the stream format.

    Returns:
      The saved object. Tensors are read-only views of the mapped file in its byte order: they
      cost no memory until they are used, and change if the file is overwritten in place.

    Raises:
      CheckpointError: a name that is not admitted, a damaged or truncated file, a size or stride
        beyond the data. Nothing of the file has run.
      OSError: the file cannot be opened.
    """
    data = _map(path)
    zipped = data[:4] == b"PK\x03\x04"
    return _guarded(path, lambda: _read_zip(path, data) if zipped else _read_stream(data))


def load_pickle(path: str | Path) -> Any:
    """One plain pickle of containers, numbers, text and NumPy arrays (read-only).

    Errors as in ``load_torch``; tensors are refused.
    """
    data = _map(path)
    return _guarded(path, lambda: finish(unpickle(data, 0, tensors=False)[0], {}))


def _map(path: str | Path) -> mmap.mmap:
    with open(path, "rb") as file:
        if not file.seek(0, io.SEEK_END):
            raise CheckpointError(
                f"{path}: a checkpoint holds an object; the file is empty. Fetch it again."
            )
        return mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)


def _guarded(path: str | Path, read: Callable[[], Any]) -> Any:
    """Run ``read``; name the file in its errors, and call every unforeseen one damage."""
    try:
        return read()
    except CheckpointError as error:
        raise CheckpointError(f"{path}: {error}") from None
    except Exception as error:  # pickle and zipfile answer damage with a dozen types of error
        raise CheckpointError(
            f"{path}: the file is truncated, damaged or of another format "
            f"({type(error).__name__}: {error}). Fetch it or save it again."
        ) from error


def _read_zip(path: str | Path, data: mmap.mmap) -> Any:
    end = data.rfind(b"PK\x05\x06", max(0, len(data) - 65_557))  # before any listing is made of it
    (count,) = struct.unpack_from("<H", data, end + 10) if 0 <= end < len(data) - 12 else (0,)
    if _MOST_RECORDS < count:
        raise CheckpointError(
            f"A torch archive must have at most {_MOST_RECORDS} records; this one has {count} or "
            "more. Save fewer tensors."
        )
    with zipfile.ZipFile(path) as archive:
        records = {info.filename: info for info in archive.infolist()}
    roots = [name.removesuffix("data.pkl") for name in records if name.endswith("/data.pkl")]
    if len(roots) != 1:
        raise CheckpointError(
            f"A torch archive holds one data.pkl; this one holds {len(roots)}. "
            "Give a file that torch.save wrote."
        )

    def region(name: str) -> memoryview:
        if roots[0] + name not in records:
            raise CheckpointError(f"Record {name!r} is missing. Fetch the file or save it again.")
        return _stored(data, records[roots[0] + name])

    # Archives from before this record existed are little-endian.
    big = roots[0] + "byteorder" in records and bytes(region("byteorder")) == b"big"
    value, _, storages = unpickle(region("data.pkl"), 0)
    buffers = {key: region(f"data/{key}") for key in storages}
    return finish(value, buffers, big)


def _stored(data: mmap.mmap, info: zipfile.ZipInfo) -> memoryview:
    """The bytes of an uncompressed record, as a view."""
    if info.compress_type != zipfile.ZIP_STORED or info.flag_bits & 1:
        raise CheckpointError(
            f"torch stores records uncompressed; {info.filename!r} is compressed or encrypted. "
            "Write the file with torch.save and do not repack it."
        )
    # The local header is padded differently from the directory's entry: its own lengths count.
    name_length, extra_length = struct.unpack_from("<HH", data, info.header_offset + 26)
    start = info.header_offset + 30 + name_length + extra_length
    return memoryview(data)[start : start + info.file_size]


def _read_stream(data: mmap.mmap) -> Any:
    magic, at, _ = unpickle(data, 0)
    if magic != _STREAM_MAGIC:
        raise CheckpointError(
            "A torch file starts with a zip header or with torch's magic number; this is another "
            "pickle. Give a file that torch.save wrote."
        )
    version, at, _ = unpickle(data, at)
    if version != _STREAM_VERSION:
        raise CheckpointError(
            f"The stream format is version {_STREAM_VERSION}; got {version!r}. "
            "Save the file again with a current torch."
        )
    system, at, _ = unpickle(data, at)
    value, at, storages = unpickle(data, at)
    keys, at, _ = unpickle(data, at)
    big = not system["little_endian"]
    buffers = {}
    for key in keys:
        _, code, expected = storages[key]
        (count,) = struct.unpack_from(">q" if big else "<q", data, at)
        start, end = at + 8, at + 8 + expected * np.dtype(code).itemsize
        if count != expected or end > len(data):
            raise CheckpointError(
                f"Storage {key!r} should hold {expected} numbers; its header says {count}, and "
                f"{len(data) - start} bytes are left. Fetch the file or save it again."
            )
        buffers[key] = memoryview(data)[start:end]
        at = end
    return finish(value, buffers, big)
