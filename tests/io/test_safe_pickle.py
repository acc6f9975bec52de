"""The unpickler: plain containers and arrays of every protocol, and nothing that runs."""

import copyreg
import pickle
import struct
import tracemalloc
import zipfile
from collections import Counter

import numpy as np
import pytest

from dbdnet_jax.errors import CheckpointError
from dbdnet_jax.io.torch_pickle import load_pickle, load_torch
from tests.torch_files import MAGIC, Touches, write


def in_stream(data: bytes) -> bytes:
    """A pickle where the stream format has its object."""
    system = {"little_endian": True}
    head = b"".join(pickle.dumps(part, 2) for part in (MAGIC, 1001, system))
    return head + data + pickle.dumps([], 2)


def in_zip(path, data: bytes):
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("a/data.pkl", data)
    return path


@pytest.mark.parametrize("protocol", range(6))
def test_arrays_and_containers_of_every_protocol(tmp_path, protocol):
    values = [
        np.arange(6.0).reshape(2, 3),
        np.asfortranarray(np.arange(6, dtype=np.int32).reshape(2, 3)),
        np.zeros((0, 3)),
        np.array(True),
        np.arange(3, dtype=">i4"),
        np.array(["chair", "é"]),
        np.float32(2.5),
        {"rot": [np.eye(3)], "src": ["a", "b"], 3: (None, True, -(2**80), 1.5)},
        b"",
        b"\x00\xff",
        {1, 2},
        frozenset([3]),
        Counter("aab"),
    ]
    path = write(tmp_path / "x.pkl", pickle.dumps(values, protocol))
    for got, expected in zip(load_pickle(path), values, strict=True):
        if isinstance(expected, dict) and "rot" in expected:
            assert np.array_equal(got["rot"].pop(), expected["rot"].pop())
        assert type(got) is (dict if isinstance(expected, Counter) else type(expected))
        assert np.array_equal(got, expected)
        if isinstance(expected, np.ndarray):
            assert got.dtype == expected.dtype and got.shape == expected.shape


def test_shared_and_recursive_containers(tmp_path):
    shared = [1]
    value = {"a": shared, "b": (shared, shared)}
    value["self"] = value
    loaded = load_pickle(write(tmp_path / "x.pkl", pickle.dumps(value)))
    assert loaded["a"] is loaded["b"][0] is loaded["b"][1] and loaded["self"] is loaded


def test_the_payload_would_have_run(tmp_path):
    marker = tmp_path / "ran"
    data = pickle.dumps(Touches(marker))
    with pytest.raises(CheckpointError, match="mkdir"):
        load_pickle(write(tmp_path / "x.pkl", data))
    assert not marker.exists()
    pickle.loads(data)
    assert marker.exists()


@pytest.mark.parametrize(
    "name",
    [
        "builtins eval",
        "builtins getattr",
        "builtins dict",
        "functools partial",
        "torch load",
        "torch.storage _load_from_bytes",
        "torch._utils _rebuild_tensor_v2.__globals__",
        "numpy load",
        "numpy memmap",
        "models.dbdnet DBDNet",
    ],
)
def test_other_names_are_refused(tmp_path, name):
    data = f"c{name.replace(' ', chr(10))}\n.".encode()
    for path in (
        write(tmp_path / "x.pth", in_stream(data)),
        in_zip(tmp_path / "y.pth", data),
    ):
        with pytest.raises(CheckpointError, match=f"asks for {name.replace(' ', '[.]')}, and"):
            load_torch(path)


@pytest.mark.parametrize(
    "data, message",
    [
        (b"ccollections\nOrderedDict\n}b.", "may not set a function's state"),
        (b"ctorch._utils\n_rebuild_tensor_v2\n(N}S'__defaults__'\nNstb.", "function's state"),
        (b"ctorch\nFloatStorage\n(tR.", "not callable"),
        (b"cnumpy\nndarray\n)\x81.", "NEWOBJ"),
        (b"\x80\x02Nr\xff\xff\xff\x7f.", "LONG_BINPUT 2147483647"),
        (b"Np123456789\n.", "PUT 123456789"),
        (b"\x8e\xff\xff\xff\xff\xff\xff\xff\x7f.", "truncated, damaged"),
        (b"c_codecs\nencode\n(Vx\nVrot13\ntR.", "latin1"),
        (b"cbuiltins\nbytes\n(I1000000000\ntR.", "truncated, damaged"),
        (b"(Vmodule\nNNNNtQ.", "refers to .*module"),
        (b"(Vstorage\nVf4\nV0\nVcpu\nI1\n(V0\nI0\nI1\nttQ.", "Only whole storages"),
        (
            b"(Vstorage\nVf4\nV0\nVcpu\nI-1\ntQ.",
            "size of a storage must be at most 32 whole numbers from 0",
        ),
        (b"]" * 100000 + b"a" * 99999 + b".", "at most 200 levels"),
    ],
)
def test_crafted_pickles_are_refused(tmp_path, data, message):
    with pytest.raises(CheckpointError, match=message):
        load_torch(write(tmp_path / "x.pth", in_stream(data)))


def test_registered_extension_codes_are_refused(tmp_path):
    copyreg.add_extension("os", "getpid", 201)
    try:
        with pytest.raises(CheckpointError, match="EXT1 201"):
            load_pickle(write(tmp_path / "x.pkl", b"\x80\x02\x82\xc9)R."))
    finally:
        copyreg.remove_extension("os", "getpid", 201)


@pytest.mark.parametrize(
    "function, argument",
    [
        (b"c_codecs\nencode\n", b"(X" + struct.pack("<I", 10**6) + b"x" * 10**6 + b"Vlatin1\nt"),
        (b"cbuiltins\nset\n", b"((" + b"".join(b"I%d\n" % i for i in range(50000)) + b"lt"),
    ],
)
def test_repeated_copies_do_not_multiply_the_file(tmp_path, function, argument):
    data = function + b"q\x00" + argument + b"q\x01R0](" + b"h\x00h\x01R" * 10000 + b"e."
    path = write(tmp_path / "x.pkl", data)
    tracemalloc.start()
    try:
        with pytest.raises(
            CheckpointError, match="copies more than it contains|64 parts for each opcode"
        ):
            load_pickle(path)
        # Python's objects take tens of bytes for each of the file's; 10,000 copies would not fit.
        assert tracemalloc.get_traced_memory()[1] < 100 * len(data)
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize(
    "array, message",
    [
        (np.array([None, {}]), "got dtype 'O8'"),
        (np.zeros(2, [("a", "f4"), ("b", "i8")]), "got dtype 'V12'"),
        (np.zeros(2, "datetime64[s]"), "got dtype 'M8'"),
    ],
)
def test_arrays_of_objects_and_records_are_refused(tmp_path, array, message):
    with pytest.raises(CheckpointError, match=message):
        load_pickle(write(tmp_path / "x.pkl", pickle.dumps(array)))


def test_a_dtype_may_not_hide_fields_in_its_state(tmp_path):
    data = pickle.dumps(np.zeros(2), 2).replace(b"NNN", b"NX\x01\x00\x00\x00aN")
    with pytest.raises(CheckpointError, match="structured dtype"):
        load_pickle(write(tmp_path / "x.pkl", data))


def test_an_array_must_fill_its_bytes(tmp_path):
    data = pickle.dumps(np.zeros(200, np.uint8), 3)
    larger = data.replace(b"K\xc8\x85", b"K\xc9\x85")
    assert larger != data
    with pytest.raises(CheckpointError, match=r"shape \(201,\) and type uint8 does not fill 200"):
        load_pickle(write(tmp_path / "x.pkl", larger))


def test_a_storage_is_declared_once(tmp_path):
    one, two = (b"(Vstorage\nVf4\nV0\nVcpu\nI%d\ntQ" % size for size in (1, 2))
    with pytest.raises(CheckpointError, match="'0' is declared twice"):
        load_torch(write(tmp_path / "x.pth", in_stream(b"(" + one + two + b"l.")))
