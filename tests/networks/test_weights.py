"""Weights on disk: exact, checked, and never half-written."""

import dataclasses
import errno
import json
import os

import jax
import numpy as np
import pytest

from dbdnet_jax.networks import weights
from dbdnet_jax.networks.dbdnet.config import ModelConfig, check_field
from dbdnet_jax.networks.params import unflatten
from dbdnet_jax.networks.table import parameter_shapes
from dbdnet_jax.networks.weights import CheckpointError, load_params, save_params
from tests.torch_files import save_zip, tensor

CONFIG = ModelConfig(
    overlap_channels=4,
    overlap_blocks=1,
    registration_channels=4,
    shared_blocks=1,
    rotation_blocks=1,
    translation_blocks=1,
    neighbours=7,
    dropout=0.25,
    released=True,
)


def make(seed=0, networks=("overlap", "registration")):
    rng = np.random.default_rng(seed)
    shapes = parameter_shapes(CONFIG, networks)
    return unflatten({n: rng.normal(size=s).astype("f4") for n, s in shapes.items()}, CONFIG)


@pytest.fixture
def path(tmp_path):
    save_params(tmp_path / "w.npz", make(), metadata={"data": "CAD", "steps": 3})
    return tmp_path / "w.npz"


def same(a, b) -> bool:
    assert jax.tree.structure(a) == jax.tree.structure(b)  # the configuration included
    return all(np.array_equal(x, y) for x, y in zip(*map(jax.tree.leaves, (a, b)), strict=True))


def members(path) -> dict[str, np.ndarray]:
    with np.load(path) as archive:
        return dict(archive)


def rewrite(path, content, *, valid: bool):
    """Write members back; ``valid`` renews the checksum, as a newer release would."""
    if valid:
        arrays = {n: x for n, x in content.items() if n not in ("header", "sha256")}
        content["sha256"] = np.array(weights._checksum(str(content["header"]), arrays))
    np.savez(path, **content)


def rewrite_header(path, **changes):
    content = members(path)
    header = json.loads(str(content["header"])) | changes
    content["header"] = np.array(json.dumps(header))
    rewrite(path, content, valid=True)


@pytest.mark.parametrize("networks", [("overlap", "registration"), ("overlap",)])
def test_the_round_trip_is_exact(tmp_path, networks):
    params = make(networks=networks)
    save_params(tmp_path / "w.npz", params)
    loaded = load_params(tmp_path / "w.npz")
    assert same(loaded, params) and loaded.config == CONFIG
    assert all(isinstance(leaf, jax.Array) for leaf in jax.tree.leaves(loaded))


def test_metadata_stands_in_the_header(path):
    header = json.loads(str(members(path)["header"]))
    assert header["metadata"] == {"data": "CAD", "steps": 3}


def test_the_same_weights_give_the_same_file(path, tmp_path):
    save_params(tmp_path / "again.npz", make(), metadata={"steps": 3, "data": "CAD"})
    assert (tmp_path / "again.npz").read_bytes() == path.read_bytes()


def test_every_truncation_is_named(path):
    data = path.read_bytes()
    for size in [0, 1, 10, *range(100, len(data), len(data) // 40), len(data) - 1]:
        path.write_bytes(data[:size])
        with pytest.raises(CheckpointError, match=r"w\.npz: the file is truncated, damaged or"):
            load_params(path)


def test_altered_content_is_found(path):
    content = members(path)
    for name in ("overlap/linear/bias", "header"):
        changed = dict(content)
        changed[name] = (
            np.array(str(content[name]).replace("0.25", "0.5"))
            if name == "header"
            else np.nextafter(content[name], np.float32(np.inf))
        )
        rewrite(path, changed, valid=False)
        with pytest.raises(CheckpointError, match="must hash to the sha256"):
            load_params(path)
    swapped = dict(content)
    swapped["overlap/encoder/fusion_1/conv/bias"] = content["overlap/encoder/neck_2/conv/bias"]
    swapped["overlap/encoder/neck_2/conv/bias"] = content["overlap/encoder/fusion_1/conv/bias"]
    rewrite(path, swapped, valid=False)
    with pytest.raises(CheckpointError, match="must hash"):
        load_params(path)
    rewrite(path, content, valid=False)
    assert same(load_params(path), make())


def test_the_checksum_is_of_names_and_arrays():
    arrays = {"a": np.zeros(3, "f4"), "b": np.ones(3, "f4")}
    given = weights._checksum("header", arrays)
    for other in (
        {"a": arrays["b"], "b": arrays["a"]},
        {"a": arrays["a"], "c": arrays["b"]},  # the same bytes in the same order
        {"a": arrays["a"].reshape(3, 1), "b": arrays["b"]},
    ):
        assert weights._checksum("header", other) != given
    assert weights._checksum("header", dict(reversed(arrays.items()))) == given


def test_newer_files_are_refused_by_what_is_new(path):
    model = dataclasses.asdict(CONFIG)
    rewrite_header(path, model=model | {"wings": 2, "fins": 1})
    with pytest.raises(CheckpointError, match=r"must be known; fins, wings is not\. Update"):
        load_params(path)
    rewrite_header(path, model=model, format=2)
    with pytest.raises(CheckpointError, match="format must be 1; got 2"):
        load_params(path)


def test_a_configuration_that_cannot_be_built_is_refused(path):
    rewrite_header(path, model=dataclasses.asdict(CONFIG) | {"overlap_channels": 6})
    with pytest.raises(CheckpointError, match="cannot be built: overlap_channels must be"):
        load_params(path)


def test_arrays_must_fit_the_configuration(path):
    rewrite_header(path, model=dataclasses.asdict(CONFIG) | {"overlap_channels": 8})
    with pytest.raises(CheckpointError, match=r"overlap/linear|misshapen: .*instead of"):
        load_params(path)
    content = members(path)
    rewrite_header(path, model=dataclasses.asdict(CONFIG))
    del content["overlap/linear/bias"]
    content["header"] = members(path)["header"]
    rewrite(path, content, valid=True)
    with pytest.raises(CheckpointError, match="1 missing: overlap/linear/bias"):
        load_params(path)


def test_what_could_not_be_loaded_is_not_saved(tmp_path):
    params = make()
    integers = jax.tree.map(lambda x: np.asarray(x).astype(np.int32), params)
    with pytest.raises(CheckpointError, match=r"float16, float32 or float64.*\(int32\)"):
        save_params(tmp_path / "w.npz", integers)
    with pytest.raises(CheckpointError, match="misshapen"):
        save_params(tmp_path / "w.npz", params.replace(config=ModelConfig()))
    with pytest.raises(CheckpointError, match="no array"):
        save_params(tmp_path / "w.npz", params.replace(networks={}))
    with pytest.raises(FileNotFoundError, match="absent does not. Create it"):
        save_params(tmp_path / "absent" / "w.npz", params)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("failure", ["interrupt", "disk full", "rename"])
def test_a_failed_save_leaves_the_old_file(path, monkeypatch, failure):
    before = path.read_bytes()

    def interrupt(*_):  # the bytes are written, but to no file of that name
        raise KeyboardInterrupt

    def full(*_):
        raise OSError(errno.ENOSPC, "No space left on device")

    target, name, action = {
        "interrupt": (os, "fsync", interrupt),
        "disk full": (os, "fsync", full),
        "rename": (os, "replace", full),
    }[failure]
    monkeypatch.setattr(target, name, action)
    with pytest.raises(KeyboardInterrupt if failure == "interrupt" else OSError):
        save_params(path, make(seed=1))
    assert path.read_bytes() == before
    assert list(path.parent.iterdir()) == [path]
    monkeypatch.undo()
    save_params(path, make(seed=1))
    assert same(load_params(path), make(seed=1)) and list(path.parent.iterdir()) == [path]


def test_other_files_are_told_apart(tmp_path):
    save_zip(tmp_path / "x.pth", {"a": tensor(np.ones(3))})
    with pytest.raises(CheckpointError, match="not written by save_params .*from_released"):
        load_params(tmp_path / "x.pth")
    np.savez(tmp_path / "objects.npz", header=np.array([None]), sha256=np.array("x"))
    with pytest.raises(CheckpointError, match="not written by save_params"):
        load_params(tmp_path / "objects.npz")
    with pytest.raises(FileNotFoundError, match="absent"):
        load_params(tmp_path / "absent.npz")


def test_pretrained_weights_go_by_name(path, tmp_path, monkeypatch):
    monkeypatch.setattr(weights, "PRETRAINED", tmp_path)
    assert same(weights.load_pretrained("w"), make())
    for name in ("cad", "../w", str(path)):
        with pytest.raises(CheckpointError, match=r"\(w\); got .* train.py --config=configs/cad"):
            weights.load_pretrained(name)
    monkeypatch.setattr(weights, "PRETRAINED", tmp_path / "absent")
    with pytest.raises(CheckpointError, match=r"\(none\); got 'cad'"):
        weights.load_pretrained()


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("overlap_blocks", 10**9),
        ("overlap_blocks", -1),
        ("heads", 0),
        ("heads", True),
        ("neighbours", 16.5),
        ("neighbours", float("nan")),
        ("overlap_threshold", float("nan")),
        ("overlap_threshold", float("inf")),
        ("dropout", "0.1"),
        ("overlap_channels", [4]),
        ("neighbour_space", None),
        ("released", 1),
        ("parameter_width", 2**40),
    ],
)
def test_a_header_of_wrong_types_or_out_of_bounds_is_refused(path, field, value):
    rewrite_header(path, model=dataclasses.asdict(CONFIG) | {field: value})
    with pytest.raises(CheckpointError, match=f"(?s)cannot be built: .*{field}"):
        load_params(path)
    # The tests' own checks of types come before those of the record.
    with pytest.raises(ValueError, match=f"{field} must be .*; got .* Use "):
        check_field(field, value, type(getattr(ModelConfig, field)))


@pytest.mark.parametrize(
    "header",
    ["[]", "3", "null", "{}", "{", "[" * 100_000, '{"format": 1}', '{"format": [1]}']
    + [f'{{"format": 1, "metadata": {{}}, "model": {x}}}' for x in ("null", "[]", '"x"', "3")]
    + ['{"format": 1, "model": {}, "metadata": 3}'],
)
def test_a_header_that_is_none_is_refused(path, header):
    rewrite(path, members(path) | {"header": np.array(header)}, valid=True)
    with pytest.raises(CheckpointError, match=r"w\.npz: the (header|format) must"):
        load_params(path)


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, 1e300])
def test_numbers_that_are_not_finite_are_neither_saved_nor_loaded(path, value):
    name = "overlap/linear/bias"
    content = members(path)
    content[name] = np.full_like(content[name], value, dtype=np.float64)
    rewrite(path, content, valid=True)
    with pytest.raises(CheckpointError, match=f"must hold finite numbers; .* 1 of .*: {name}"):
        load_params(path)
    params = make()
    params.overlap["linear"]["bias"] = np.full(1, value)
    with pytest.raises(CheckpointError, match="must hold finite numbers"):
        save_params(path, params)


def test_an_archive_that_unpacks_to_more_than_it_is_is_refused(tmp_path):
    np.savez_compressed(tmp_path / "w.npz", header=np.zeros(10**6), sha256=np.array("x"))
    with pytest.raises(CheckpointError, match="must be stored uncompressed"):
        load_params(tmp_path / "w.npz")
    np.savez(tmp_path / "w.npz", header=np.zeros(10), sha256=np.array("x"))
    data = (tmp_path / "w.npz").read_bytes()
    (tmp_path / "w.npz").write_bytes(data.replace(b"(10,), ", b"(9999,)"))
    with pytest.raises(CheckpointError, match="was not written by save_params"):
        load_params(tmp_path / "w.npz")


def test_arrays_of_another_byte_order_are_read(path):
    content = members(path)
    for name in [name for name in content if "/" in name]:
        content[name] = content[name].astype(">f4")
    rewrite(path, content, valid=True)
    assert same(load_params(path), make())
