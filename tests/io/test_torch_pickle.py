"""Torch's two file formats: what is read, what is refused, and that nothing runs."""

import os
import pickle
import struct
import tracemalloc
import zipfile
from collections import OrderedDict
from pathlib import Path

import numpy as np
import pytest

from dbdnet_jax.errors import CheckpointError
from dbdnet_jax.io.torch_pickle import load_pickle, load_torch
from tests.torch_files import (
    MAGIC,
    Parameter,
    Tensor,
    Touches,
    save_stream,
    save_zip,
    tensor,
    write,
)

SAMPLE = Path(__file__).parents[3] / "shared" / "threedmatch_sample"
BOTH = pytest.mark.parametrize("save", [save_zip, save_stream])


@BOTH
@pytest.mark.parametrize("byteorder", ["little", "big"])
def test_tensors_of_every_kind(tmp_path, save, byteorder):
    numbers = np.arange(24, dtype=np.float32)
    path = tmp_path / "x.pth"
    value = OrderedDict(
        whole=tensor(numbers.reshape(2, 3, 4)),
        part=Tensor(numbers, (3, 2), (1, 3), 5),
        expanded=Tensor(numbers, (4, 5), (0, 1), 1),
        scalar=Tensor(numbers, (), (), 23),
        empty=tensor(np.zeros((0, 3), np.float64)),
        parameter=Parameter(np.array([1.5, -2.0])),
        half=tensor(np.array([0.5, 65504.0], np.float16)),
        long=tensor(np.array([[-(2**40)], [7]])),
        mask=tensor(np.array([True, False, True])),
    )
    value._metadata = {"version": 1}
    save(
        path,
        {"state_dict": value, "epoch": 3, "seen": {1, 2}, "note": ("é", b"\xff", None)},
        byteorder,
    )
    loaded = load_torch(path)
    assert type(loaded["state_dict"]) is dict
    assert {k: v for k, v in loaded.items() if k != "state_dict"} == {
        "epoch": 3,
        "seen": {1, 2},
        "note": ("é", b"\xff", None),
    }
    expected = {
        "whole": numbers.reshape(2, 3, 4),
        "part": numbers[5:11].reshape(2, 3).T,
        "expanded": np.broadcast_to(numbers[1:6], (4, 5)),
        "scalar": numbers[23],
        "empty": np.zeros((0, 3)),
        "parameter": np.array([1.5, -2.0]),
        "half": np.array([0.5, 65504.0], np.float16),
        "long": np.array([[-(2**40)], [7]]),
        "mask": np.array([True, False, True]),
    }
    assert list(loaded["state_dict"]) == list(expected)
    for name, array in expected.items():
        got = loaded["state_dict"][name]
        assert got.dtype == array.dtype.newbyteorder("<" if byteorder == "little" else ">")
        assert got.shape == array.shape and np.array_equal(got, array), name
    with pytest.raises(ValueError, match="read-only"):
        loaded["state_dict"]["half"][:] = 0


@pytest.mark.skipif(not SAMPLE.exists(), reason="the 3DMatch sample lies beside the repository")
def test_real_files_of_the_stream_format():
    info = load_pickle(SAMPLE / "3DLoMatch.pkl")
    assert len(info["src"]) == 1781 and info["rot"][0].shape == (3, 3)
    cloud = load_torch(SAMPLE / "test" / "7-scenes-redkitchen" / "cloud_bin_34.pth")
    assert cloud.shape == (14602, 3) and cloud.dtype == np.float64
    assert np.abs(cloud).max() < 10.0


@BOTH
def test_a_payload_is_refused_by_name_and_does_not_run(tmp_path, save):
    marker = tmp_path / "ran"
    path = tmp_path / "x.pth"
    save(path, OrderedDict(weight=tensor(np.ones(3, np.float32)), hook=Touches(marker)))
    with pytest.raises(CheckpointError, match=rf"x\.pth: .*asks for {os.mkdir.__module__}\.mkdir"):
        load_torch(path)
    assert not marker.exists()


INSIDE = "must lie inside its storage of 6 numbers; shape"
WHOLE = "must be at most 32 whole numbers from 0; got"


@BOTH
@pytest.mark.parametrize(
    "shape, strides, offset, message",
    [
        ((7,), (1,), 0, INSIDE),
        ((2, 3), (4, 1), 0, INSIDE),
        ((1,), (1,), 6, INSIDE),
        ((2, 3), (3, 1), 1, INSIDE),
        ((2,), (2**61,), 0, INSIDE),
        ((2,), (-1,), 1, f"The strides of a tensor {WHOLE}"),
        ((-2, -3), (1, 1), 0, f"The shape of a tensor {WHOLE}"),
        ((2,), (1,), -1, f"The offset of a tensor {WHOLE}"),
        ((1.0,), (1,), 0, f"The shape of a tensor {WHOLE}"),
        ((1,) * 33, (1,) * 33, 0, f"The shape of a tensor {WHOLE}"),
        ((2, 3), (1,), 0, "damaged"),
        ((2**61, 2**61), (0, 0), 0, "damaged"),
    ],
)
def test_tensors_beyond_their_storage_are_refused(tmp_path, save, shape, strides, offset, message):
    path = tmp_path / "x.pth"
    save(path, [Tensor(np.ones(6, np.float32), shape, strides, offset)])
    with pytest.raises(CheckpointError, match=rf"x\.pth: .*{message}"):
        load_torch(path)


def test_an_expanded_tensor_takes_no_memory(tmp_path):
    path = tmp_path / "x.pth"
    save_zip(path, Tensor(np.ones(2, np.float32), (2**20, 2**20), (0, 1), 0))
    with pytest.raises(CheckpointError):  # reads past the two numbers
        load_torch(path)
    save_zip(path, Tensor(np.ones(2, np.float32), (2**20, 2**20), (0, 0), 1))
    tracemalloc.start()
    try:
        assert load_torch(path).nbytes == 2**42
        assert tracemalloc.get_traced_memory()[1] < 2**20
    finally:
        tracemalloc.stop()


@BOTH
def test_every_truncation_is_named(tmp_path, save):
    path, short = tmp_path / "x.pth", tmp_path / "short.pth"
    save(path, {"a": tensor(np.arange(20.0)), "b": tensor(np.ones(3, np.float32))})
    data = path.read_bytes()
    for size in range(len(data)):
        with pytest.raises(CheckpointError, match=r"short\.pth"):
            load_torch(write(short, data[:size]))


@BOTH
def test_damage_raises_nothing_else(tmp_path, save):
    path, other = tmp_path / "x.pth", tmp_path / "other.pth"
    save(path, {"a": tensor(np.arange(20.0)), "b": [np.eye(2), np.float32(1), {1}]})
    data = np.frombuffer(path.read_bytes(), np.uint8)
    rng = np.random.default_rng(0)
    refused = 0
    for _ in range(400):
        damaged = data.copy()
        where = rng.integers(0, data.size, 3)
        damaged[where] = rng.integers(0, 256, 3)
        try:
            load_torch(write(other, damaged.tobytes()))
        except CheckpointError:
            refused += 1
    assert refused > 100


def test_the_stream_storages_must_have_their_declared_sizes(tmp_path):
    path = tmp_path / "x.pth"
    save_stream(path, tensor(np.arange(5.0)))
    data = path.read_bytes()
    wrong = data[:-48] + struct.pack("<q", 2**40) + data[-40:]
    with pytest.raises(
        CheckpointError, match="should hold 5 numbers; its header says 1099511627776"
    ):
        load_torch(write(path, wrong))


def test_zip_records_are_checked(tmp_path):
    path = tmp_path / "x.pth"
    save_zip(path, tensor(np.arange(5.0)), compression=zipfile.ZIP_DEFLATED)
    with pytest.raises(CheckpointError, match="is compressed or encrypted"):
        load_torch(path)
    save_zip(path, tensor(np.arange(5.0)))
    for size in (None, 39):
        other = tmp_path / "other.pth"
        with zipfile.ZipFile(path) as old, zipfile.ZipFile(other, "w") as new:
            for name in old.namelist():
                data = old.read(name)
                if not name.endswith("data/0"):
                    new.writestr(name, data)
                elif size is not None:
                    new.writestr(name, data[:size])
        with pytest.raises(CheckpointError, match="missing" if size is None else "39 bytes are"):
            load_torch(other)


def test_other_files_are_told_apart(tmp_path):
    with pytest.raises(CheckpointError, match="empty"):
        load_torch(write(tmp_path / "x.pth"))
    with pytest.raises(CheckpointError, match="another pickle. Give a file that torch.save"):
        load_torch(write(tmp_path / "x.pth", pickle.dumps({})))
    with pytest.raises(CheckpointError, match="of another format"):
        load_torch(write(tmp_path / "x.pth", b"ply\nformat ascii 1.0\n"))
    with pytest.raises(CheckpointError, match="version 1001; got 7"):
        load_torch(write(tmp_path / "x.pth", pickle.dumps(MAGIC, 2), pickle.dumps(7, 2)))
    with zipfile.ZipFile(tmp_path / "x.zip", "w") as archive:
        archive.writestr("a.txt", "a")
    with pytest.raises(CheckpointError, match="holds 0. Give a file that torch.save"):
        load_torch(tmp_path / "x.zip")
    with pytest.raises(FileNotFoundError, match="absent"):
        load_torch(tmp_path / "absent.pth")
    save_stream(tmp_path / "x.pth", tensor(np.ones(2)))
    data = (tmp_path / "x.pth").read_bytes()
    with pytest.raises(CheckpointError, match="storage"):
        load_pickle(write(tmp_path / "x.pkl", data[data.index(b"ctorch._utils") - 2 :]))
