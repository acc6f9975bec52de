"""The embedded CAD set: its content, its splits, its loader and its builder's parsers."""

import dataclasses
import importlib
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from scipy.spatial import cKDTree

from dbdnet_jax.data import cad
from dbdnet_jax.data.cad import cad_split, load_cad, split_fraction, split_of
from dbdnet_jax.data.shapes import Shapes, select

TOOLS = Path(__file__).parents[2] / "tools"
POINT_STEP = 1 / 32767  # of the stored int16 coordinates
FLOAT32_UNIT = 1e-6  # of a float32 norm near 1


@pytest.fixture
def builder(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.syspath_prepend(str(TOOLS))
    return importlib.import_module("build_cad")


@pytest.fixture
def archives(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.syspath_prepend(str(TOOLS))
    return importlib.import_module("cad_archives")


def keys_of(shapes: Shapes) -> list[str]:
    return [f"{a}|{b}" for a, b in zip(shapes.libraries, shapes.paths, strict=True)]


def spacing_variation(points: np.ndarray) -> float:
    distances = cKDTree(points).query(points, k=2)[0][:, 1]
    return float(distances.std() / distances.mean())


def test_all_models_load() -> None:
    shapes = load_cad()
    assert len(shapes) == 820
    assert shapes.points.shape == shapes.normals.shape == (820, 2048, 3)
    assert shapes.points.dtype == shapes.normals.dtype == np.float32
    assert load_cad() is shapes
    assert len(set(keys_of(shapes))) == 820
    assert keys_of(shapes) == sorted(keys_of(shapes))


def test_every_text_is_there_and_none_is_an_object() -> None:
    for field, array in vars(load_cad()).items():
        if field not in ("points", "normals"):
            assert array.shape == (820,) and array.dtype.kind == "U", field
            assert (array != "").all(), field
    with np.load(cad.CAD_FILE, allow_pickle=False) as arrays:
        assert all(arrays[name].dtype.kind in "iU" for name in arrays.files)


def test_loaded_arrays_are_read_only_and_splits_are_copies() -> None:
    with pytest.raises(ValueError, match="read-only"):
        load_cad().points[0] = 0
    part = cad_split("test")
    part.points[:] = 0
    assert cad_split("test").points.any()
    with pytest.raises(dataclasses.FrozenInstanceError):
        part.points = part.normals  # type: ignore[misc]


def test_shapes_are_normalised() -> None:
    points = load_cad().points.astype(np.float64)
    assert np.abs(points.mean(1)).max() < POINT_STEP
    assert np.abs(np.linalg.norm(points, axis=-1).max(1) - 1).max() < POINT_STEP


def test_normals_are_unit() -> None:
    norms = np.linalg.norm(load_cad().normals, axis=-1)
    assert np.abs(norms - 1).max() < FLOAT32_UNIT


def test_normals_belong_to_their_points() -> None:
    """On a flat model (a carpet) all points lie in the plane across the normals."""
    shapes = load_cad()
    row = keys_of(shapes).index("KatorLegaz|/katorlegaz/oriental-rug/oriental-rug.obj")
    flat = np.abs(np.linalg.svd(shapes.points[row], full_matrices=False)[2][2])
    across = np.abs(shapes.normals[row] @ flat)
    assert np.median(across) > 0.99


def test_points_are_evenly_spaced() -> None:
    """As the ModelNet40 HDF5 clouds (0.28); plain area sampling gives 0.51-0.55."""
    every_tenth = load_cad().points[::10]
    assert 0.20 < np.median([spacing_variation(points) for points in every_tenth]) < 0.30


def test_the_first_half_of_the_points_is_a_fair_draw() -> None:
    """Neither half of the rows is the coarse part of a farthest-point order."""
    points = load_cad().points[::20]
    first = np.median([spacing_variation(p[:1024]) for p in points])
    last = np.median([spacing_variation(p[1024:]) for p in points])
    assert abs(first - last) < 0.03


def test_split_rule_on_known_models() -> None:
    bed = "BlendSwap-CC-0|/blendswap-cc-0/bed1/bed1.obj"
    toaster = "Scopia|/scopia/toaster/toaster.obj"
    assert round(split_fraction(bed), 6) == 0.125929
    assert round(split_fraction(toaster), 6) == 0.999285
    assert split_of(bed) == "train"
    assert split_of(toaster) == "test"


def test_splits_cover_everything_once() -> None:
    parts = {split: keys_of(cad_split(split)) for split in ("train", "val", "test")}
    assert {split: len(part) for split, part in parts.items()} == {
        "train": 642,
        "val": 97,
        "test": 81,
    }
    assert sorted(sum(parts.values(), [])) == keys_of(load_cad()) == keys_of(cad_split("all"))
    assert all(split_of(key) == split for split, part in parts.items() for key in part)


def test_halves_share_no_class() -> None:
    seen, unseen = cad_split("all", "seen"), cad_split("all", "unseen")
    assert len(seen) == len(unseen) == 410
    assert not set(seen.labels) & set(unseen.labels)
    assert set(cad_split("test", "unseen").labels) <= set(unseen.labels)
    assert len(cad_split("test", "seen")) + len(cad_split("test", "unseen")) == 81


def test_select_takes_rows_of_every_field() -> None:
    shapes = load_cad()
    two = select(shapes, np.array([5, 3]))
    assert keys_of(two) == [keys_of(shapes)[5], keys_of(shapes)[3]]
    assert two.names.tolist() == shapes.names[[5, 3]].tolist()
    np.testing.assert_array_equal(two.points[1], shapes.points[3])
    np.testing.assert_array_equal(two.normals[0], shapes.normals[5])


def test_errors_name_rule_value_and_fix() -> None:
    with pytest.raises(ValueError, match=r"split must be one of .*'train'.*got 'trian'"):
        cad_split("trian")
    with pytest.raises(ValueError, match=r"half must be one of .*'seen'.*got 'a'.*Give None"):
        cad_split("test", "a")
    with pytest.raises(ValueError, match=r"'library\|path'; got 'bed1.obj'"):
        split_of("bed1.obj")


def test_a_damaged_or_missing_file_says_reinstall(tmp_path: Path) -> None:
    data = bytearray(cad.CAD_FILE.read_bytes())
    copy = tmp_path / "cad.npz"
    copy.write_bytes(data)
    assert len(load_cad(copy)) == 820
    data[len(data) // 2] ^= 1
    damaged = tmp_path / "damaged.npz"
    damaged.write_bytes(data)
    with pytest.raises(ValueError, match="is damaged. Reinstall"):
        load_cad(damaged)
    with pytest.raises(FileNotFoundError, match="no such file. Reinstall"):
        load_cad(tmp_path / "absent.npz")


def test_attribution_names_every_creator_and_licence() -> None:
    text = cad.CAD_FILE.with_name("CAD_ATTRIBUTION.md").read_text(encoding="utf-8")
    shapes = load_cad()
    assert all(f"- **{creator}**: " in text for creator in set(shapes.creators))
    assert all(licence in text for licence in set(shapes.licences))


def test_obj_parser(archives: ModuleType) -> None:
    text = """# a quad, a triangle by negative indices, then a pentagon
mtllib ignored.mtl
v 0 0 0
v 1 0 0 1.0
v 1 1 0
v 0 1 0
vt 0.5 0.5
vn 0 0 1
f 1/1/1 2/1/1 3//1 4
v 0.5 0.5 1e0
f -5//1 -4//1 -1//1
f 1 2 3 4 5
"""
    vertices, triangles = archives.parse_obj(text)
    expected = [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0.5, 0.5, 1]]
    np.testing.assert_array_equal(vertices, expected)
    fan = [[0, 1, 2], [0, 2, 3], [0, 1, 4], [0, 1, 2], [0, 2, 3], [0, 3, 4]]
    np.testing.assert_array_equal(triangles, fan)


@pytest.mark.parametrize("face", ["f 1 2 4", "f 1 2 -4"])
def test_obj_parser_refuses_indices_of_no_vertex(archives: ModuleType, face: str) -> None:
    with pytest.raises(ValueError, match="one of the 3 vertices"):
        archives.parse_obj(f"v 0 0 0\nv 1 0 0\nv 0 1 0\n{face}\n")


def test_properties_parser(archives: ModuleType) -> None:
    data = (
        b"# comment = no\n! neither = this\n\nname#1=Bill 10\\u20ac\nlatin = caf\xe9\n"
        b"path\\:key\\ two : a\\:b\\=c\\\\d\n  model#2 = /x/\\\n    y.obj\r\nspaced value here\n"
        b"tab=a\\tb\nempty=\nhash=a#b!c\ntwice=1\ntwice=2\n"
        b"ends=a\\\\\nnext=b\n"
    )
    assert archives.parse_properties(data) == {
        "name#1": "Bill 10€",
        "latin": "café",
        "path:key two": "a:b=c\\d",
        "model#2": "/x/y.obj",
        "spaced": "value here",
        "tab": "a\tb",
        "empty": "",
        "hash": "a#b!c",
        "twice": "2",
        "ends": "a\\",
        "next": "b",
    }


TWO_TRIANGLES = "v 0 0 0\nv 4 0 0\nv 0 1 0\nv 0 0 3\nf 1 2 3\nf 1 1 2\nf 1 3 4\n"


def test_a_model_depends_on_its_key_and_rotation_alone(builder: ModuleType) -> None:
    points, normals = builder.sample_model(TWO_TRIANGLES, None, "a|b")
    assert (points.dtype, normals.dtype) == (np.int16, np.int8)
    np.testing.assert_array_equal(builder.sample_model(TWO_TRIANGLES, None, "a|b")[0], points)
    assert (builder.sample_model(TWO_TRIANGLES, None, "a|c")[0] != points).any()
    quarter_turn = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    turned, turned_normals = builder.sample_model(TWO_TRIANGLES, quarter_turn, "a|b")
    np.testing.assert_allclose(turned, points @ quarter_turn.T, atol=1)
    np.testing.assert_allclose(turned_normals, normals @ quarter_turn.T, atol=1)


def test_the_builder_refuses_other_models(builder: ModuleType) -> None:
    builder.check_keys({"a|b"}, {"a|b"})
    with pytest.raises(ValueError, match=r"exactly the 2 models .* 1 are missing \['a\|c'\], 0"):
        builder.check_keys({"a|b"}, {"a|b", "a|c"})
