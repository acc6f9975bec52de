"""Bad and odd files at every door, each with its outcome; `test_hardening` has the arrays."""

import io
import os
import pickle
import time
import zipfile
from pathlib import Path

import numpy as np
import pytest
import trimesh
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from ml_collections import ConfigDict

from configs import cad
from dbdnet_jax import from_released, load_params, load_pretrained, save_params
from dbdnet_jax.alignment.writing import write_ply
from dbdnet_jax.errors import CheckpointError
from dbdnet_jax.io.point_files import read_points
from dbdnet_jax.io.transform_files import read_transform
from dbdnet_jax.networks.dbdnet.config import ModelConfig
from dbdnet_jax.training.config import read_config
from tests.aligning import pair, tiny_params
from tests.torch_files import Touches

CLOUD = pair()[0][:40]


def mesh(kind: str) -> bytes:
    data = trimesh.creation.box().export(file_type=kind)
    return data.encode() if isinstance(data, str) else data


def npy(array, **options) -> bytes:
    buffer = io.BytesIO()
    np.save(buffer, array, **options)
    return buffer.getvalue()


def archive(members: dict[str, bytes]) -> bytes:
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as file:
        for name, data in members.items():
            file.writestr(name, data)
    return buffer.getvalue()


HEAD = b"ply\nformat ascii 1.0\nelement vertex 99\n" + b"".join(
    b"property float %c\n" % axis for axis in b"xyz"
)
BAD_FILES = {
    "zero.ply": (b"", r"zero\.ply is not: it is empty \(0 bytes\)"),
    "zero.npz": (b"", r"it is empty \(0 bytes\)"),
    "zero.csv": (b"", r"it is empty \(0 bytes\)"),
    "head.ply": (b"ply\n", r"head\.ply is not: "),
    "short.ply": (
        HEAD + b"end_header\n" + b"0 0 1\n" * 20,
        r"are not all there: .*row 20 of 99",
    ),
    "half.ply": (mesh("ply")[:-40], r"half\.ply is not: "),
    "junk.ply": (b"\x00\xff" * 99, r"junk\.ply is not: Not a ply file"),
    "half.stl": (mesh("stl")[:200], r"half\.stl is not: "),
    "half.glb": (mesh("glb")[:300], r"half\.glb is not: "),
    "half.off": (mesh("off")[:40], r"half\.off is not: "),
    "empty.obj": (b"# nothing\n", r"it holds 0 vertices of at least 1"),
    "flat.off": (b"OFF\n3 1 0\n0 0 0\n0 0 0\n0 0 0\n3 0 1 2\n", r"faces have no area"),
    "words.xyz": (b"hello\nworld\n", r"no line has three numbers"),
    "two.csv": (b"1,2\n" * 40, r"no line has three numbers"),
    "word.csv": (b"1,2,3\n1,2,x\n", r"line 2 must have numbers as coordinates; got 'x'"),
    "few.csv": (b"7,2,3\n4,5,7\n", r"source \(few\.csv\) must have at least 16 points; got 2"),
    "image.csv": (b"\x89PNG\r\n\x1a\n" + bytes(99), r"no line has three numbers"),
    "half.npy": (npy(CLOUD)[:-99], r"half\.npy is not: "),
    "huge.npy": (
        npy(CLOUD).replace(b"(40, 3), }        ", b"(9999999999, 3), }"),
        r"huge\.npy is ",
    ),
    "code.npy": (
        npy(np.array([Touches("/tmp/x")] * 20), allow_pickle=True),
        r"Object arrays cannot",
    ),
    "flat.npy": (npy(CLOUD.ravel()), r"source \(flat\.npy\) must be \(n, 3\); got \(120,\)"),
    "half.npz": (archive({"points.npy": npy(CLOUD)})[:-99], r"half\.npz is not: "),
    "many.npz": (archive({"a.npy": npy(CLOUD), "b.npy": npy(CLOUD)}), r"it holds \['a', 'b'\]"),
    "code.npz": (archive({"a": pickle.dumps(Touches("/tmp/x"))}), r"code\.npz is not: "),
    "text.npz": (b"1 2 3\n" * 40, r"text\.npz is not: "),
    "cloud.dxf": (b"0\nEOF", r"the ending of a point file must be one of \.ply .*got '\.dxf'"),
    "noending": (b"1 2 3\n", r"must be one of .*got 'none'"),
    "tree.pickle": (pickle.dumps(Touches("/tmp/x")), r"must be one of .*got '\.pickle'"),
}


@pytest.mark.parametrize("name", BAD_FILES)
def test_a_bad_file_is_refused_by_name(tmp_path, name):
    data, message = BAD_FILES[name]
    (tmp_path / name).write_bytes(data)
    with pytest.raises(ValueError, match=message):
        read_points(tmp_path / name)
    assert not Path("/tmp/x").exists()


def test_an_archive_member_with_a_way_out_stays_inside(tmp_path):
    (tmp_path / "a.npz").write_bytes(archive({"../../out.npy": npy(CLOUD)}))
    np.testing.assert_array_equal(read_points(tmp_path / "a.npz"), CLOUD)
    assert [path.name for path in tmp_path.iterdir()] == ["a.npz"]


@pytest.mark.parametrize(
    ("path", "error", "message"),
    [
        ("missing.ply", FileNotFoundError, r"must exist; .*missing\.ply does not"),
        ("", IsADirectoryError, r"must be a file; .* is a folder"),
        ("a\x00b.ply", FileNotFoundError, r"must exist"),
    ],
)
def test_a_path_that_is_no_file_is_refused(tmp_path, path, error, message):
    with pytest.raises(error, match=message):
        read_points(tmp_path / path)


def test_a_file_of_another_user_is_refused(tmp_path, monkeypatch):
    def refuse(*_, **__):
        raise PermissionError(13, "Permission denied")

    write_ply(tmp_path / "a.ply", CLOUD)
    monkeypatch.setattr("builtins.open", refuse)  # the tests may run as root
    with pytest.raises(PermissionError, match=r"must be readable; .*a\.ply is not for this user"):
        read_points(tmp_path / "a.ply")


def test_a_name_that_is_no_text_is_printed_and_read(tmp_path, monkeypatch, capsys):
    name = os.fsdecode(b"caf\xe9.ply")
    try:
        (tmp_path / name).write_bytes(b"")
    except OSError:
        pytest.skip("the file system wants names in UTF-8")
    write_ply(tmp_path / name, CLOUD)
    assert len(read_points(tmp_path / name)) == len(CLOUD)


BAD_WEIGHTS = {
    "zero bytes": (load_params, b"", r"truncated, damaged or was not written by save_params"),
    "no archive": (
        load_params,
        b"weights",
        r"truncated, damaged or was not written by save_params",
    ),
    "another archive": (load_params, archive({"a.npy": npy(CLOUD)}), r"was not written by"),
    "pickle": (load_params, pickle.dumps({"a": CLOUD}), r"was not written by save_params"),
    "released: zero bytes": (from_released, b"", r"."),
    "released: text": (from_released, b"hello", r"."),
    "released: code": (from_released, pickle.dumps(Touches("/tmp/x")), r"."),
    "released: numbers": (from_released, pickle.dumps([1, 2]), r"."),
}


@pytest.mark.parametrize("name", BAD_WEIGHTS)
def test_bad_weights_are_refused(tmp_path, name):
    read, data, message = BAD_WEIGHTS[name]
    (tmp_path / "w").write_bytes(data)
    with pytest.raises(CheckpointError, match=message):
        read(tmp_path / "w")
    assert not Path("/tmp/x").exists()


def test_weights_with_a_wrong_hash_are_refused(tmp_path):
    save_params(tmp_path / "w.npz", tiny_params())
    with np.load(tmp_path / "w.npz") as held:
        arrays = dict(held)
    name = next(key for key in arrays if key.endswith("kernel"))
    arrays[name] = arrays[name] + 1
    np.savez(tmp_path / "w.npz", **arrays)
    with pytest.raises(CheckpointError, match="must hash to the sha256 it was saved with"):
        load_params(tmp_path / "w.npz")


def test_unknown_weights_are_refused():
    with pytest.raises(CheckpointError, match=r"must be one of the weights in .* got '\.\./x'"):
        load_pretrained("../x")


BAD_CONFIGS = {
    "misspelt": (("train", "learning_rat"), 1e-3, r"Did you mean config\.train\.learning_rate"),
    "unknown set": (("data", "name"), "kitti", r"config\.data\.name must be one of"),
    "no batch": (("overlap", "batch_size"), 0, r"batch_size"),
    "keep 2": (("protocol", "keep"), 2.0, r"keep must be in"),
}


@pytest.mark.parametrize("name", BAD_CONFIGS)
def test_a_bad_configuration_is_refused(name):
    (section, field), value, message = BAD_CONFIGS[name]
    config = ConfigDict(cad.get_config().to_dict())
    config[section][field] = value
    with pytest.raises(ValueError, match=message):
        read_config(config)


@pytest.mark.parametrize(
    ("field", "value"),
    [("heads", 3), ("neighbours", 0), ("overlap_channels", 5), ("neighbour_space", "both")],
)
def test_a_bad_network_is_refused(field, value):
    with pytest.raises(ValueError, match=field):
        ModelConfig(**{field: value})


@pytest.mark.parametrize("content", ["1 2\n", "a b c d\n", "", "{}"])
@pytest.mark.parametrize("ending", ["txt", "json", "npy"])
def test_a_bad_transform_file_is_refused_or_of_another_shape(tmp_path, content, ending):
    path = tmp_path / f"t.{ending}"
    path.write_text(content)
    try:
        assert np.shape(read_transform(path)) != (4, 4)
    except ValueError as error:
        assert "must hold 4x4 numbers" in str(error)


SEEDS = {
    **{f".{kind}": mesh(kind) for kind in ("ply", "obj", "off", "stl", "glb")},
    ".csv": b"x,y,z\n" + b"1.5,2,-3e2\n" * 20,
    ".xyz": b"1.5 2 -3e2\n" * 20,
    ".npy": npy(CLOUD),
    ".npz": archive({"points.npy": npy(CLOUD)}),
}


@pytest.mark.parametrize("ending", SEEDS)
@settings(
    max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(data=st.data())
def test_a_mutilated_file_gives_points_or_a_word_about_it(tmp_path, ending, data):
    content = bytearray(SEEDS[ending])
    for _ in range(data.draw(st.integers(1, 4))):
        content[data.draw(st.integers(0, len(content) - 1))] = data.draw(st.integers(0, 255))
    del content[data.draw(st.integers(1, 4 * len(content))) :]
    path = tmp_path / f"a{ending}"
    path.write_bytes(content)
    start = time.perf_counter()
    try:
        points = read_points(path)
        assert points.dtype == np.float64 and np.isfinite(points).all() and points.shape[1] == 3
    except ValueError as error:
        assert "must" in str(error)
    assert time.perf_counter() - start < 5
