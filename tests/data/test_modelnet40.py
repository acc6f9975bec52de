"""ModelNet40's HDF5 folder: what is read, and what is said of a folder that cannot be."""

import h5py
import numpy as np
import pytest

from dbdnet_jax.data.modelnet40 import CATEGORIES, FILES, load_modelnet40

ADDRESS = r"https://shapenet\.cs\.stanford\.edu/media/modelnet40_ply_hdf5_2048\.zip"
LABELS = (0, 19, 20, 39)  # the first and the last category of either half


def write_file(path, labels, seed, **replaced):
    """One file in the official format; ``replaced`` overrides an array, None leaves it out."""
    rng = np.random.default_rng(seed)
    points = rng.normal(size=(len(labels), 2048, 3)).astype(np.float32)
    arrays = {
        "data": points / np.linalg.norm(points, axis=-1, keepdims=True).max(1, keepdims=True),
        "normal": points / np.linalg.norm(points, axis=-1, keepdims=True),
        "label": np.array(labels, dtype=np.uint8)[:, None],
        "faceId": np.zeros((len(labels), 2048), np.int32),
    } | replaced
    with h5py.File(path, "w") as file:
        for key, values in arrays.items():
            if values is not None:
                file.create_dataset(key, data=values, compression="gzip")
    return arrays


@pytest.fixture
def folder(tmp_path):
    for split in FILES.values():
        for number, name in enumerate(split):
            write_file(tmp_path / name, LABELS, number)
    return tmp_path


def test_reads_files_in_order(folder):
    second = write_file(folder / "ply_data_train1.h5", (7, 30, 3), seed=11)
    shapes = load_modelnet40(folder, "train")
    assert len(shapes) == 4 * len(LABELS) + 3
    np.testing.assert_array_equal(shapes.points[4:7], second["data"])
    np.testing.assert_array_equal(shapes.normals[4:7], second["normal"])
    assert shapes.points.dtype == shapes.normals.dtype == np.float32
    assert list(shapes.labels[3:8]) == ["xbox", "car", "sofa", "bench", "airplane"]
    assert list(shapes.names[3:6]) == [
        "ply_data_train0.h5#3",
        "ply_data_train1.h5#0",
        "ply_data_train1.h5#1",
    ]


def test_category_halves(folder):
    whole = load_modelnet40(folder, "test", categories="all")
    seen = load_modelnet40(folder, "test", categories="seen")
    unseen = load_modelnet40(folder, "test", categories="unseen")
    assert len(whole) == 8 and len(seen) == len(unseen) == 4
    assert list(seen.labels) == ["airplane", "lamp"] * 2
    assert list(unseen.labels) == ["laptop", "xbox"] * 2
    assert set(seen.halves) == {"seen"} and set(unseen.halves) == {"unseen"}
    np.testing.assert_array_equal(unseen.points, whole.points[whole.halves == "unseen"])
    assert list(unseen.names[:2]) == ["ply_data_test0.h5#2", "ply_data_test0.h5#3"]


def test_forty_categories_in_alphabetical_order():
    assert len(set(CATEGORIES)) == 40 and list(CATEGORIES) == sorted(CATEGORIES)


def test_half_without_a_shape_is_empty(folder):
    for number, name in enumerate(FILES["test"]):
        write_file(folder / name, (0,), number)
    shapes = load_modelnet40(folder, "test", categories="unseen")
    assert shapes.points.shape == (0, 2048, 3) and shapes.labels.shape == (0,)


def test_label_without_second_axis(folder):
    write_file(folder / "ply_data_test0.h5", (1, 2), 0, label=np.array([1, 2]))
    assert list(load_modelnet40(folder, "test").labels[:2]) == ["bathtub", "bed"]


@pytest.mark.parametrize(
    ("replaced", "message"),
    [
        ({"normal": None}, r"ply_data_test1\.h5 must hold .* lacks normal and holds data, faceId"),
        ({"data": np.zeros((4, 1024, 3))}, r"must be \(s, 2048, 3\).* got \(4, 1024, 3\)"),
        ({"label": np.zeros((3, 1))}, r"'label' \(s, 1\); got .* and \(3, 1\)"),
        ({"data": np.float32(1)}, r"must be \(s, 2048, 3\).* got \(\)"),
        ({"label": np.full((4, 1), 40)}, r"'label' in .*test1\.h5 must lie in 0\.\.39; got 40"),
        ({"label": np.array([b"a"] * 4)}, r"test1\.h5 must be a whole HDF5 file of numbers"),
    ],
)
def test_wrong_arrays(folder, replaced, message):
    path = folder / "ply_data_test1.h5"
    if np.ndim(replaced.get("data")) == 0 and replaced.get("data") is not None:
        with h5py.File(path, "w") as file:  # a scalar takes no compression
            for key in ("data", "normal", "label"):
                file[key] = replaced["data"]
    else:
        write_file(path, LABELS, 0, **replaced)
    with pytest.raises(ValueError, match=f"{message}.*{ADDRESS}"):
        load_modelnet40(folder, "test")


@pytest.mark.parametrize("key", ["data", "normal"])
@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_values_that_are_not_finite(folder, key, value):
    bad = np.zeros((4, 2048, 3), np.float32)
    bad[2, 5, 1] = value
    write_file(folder / "ply_data_test0.h5", LABELS, 0, **{key: bad})
    with pytest.raises(ValueError, match=f"'{key}' in .*test0.h5 must be finite.*row 2.*{ADDRESS}"):
        load_modelnet40(folder, "test")


@pytest.mark.parametrize("kept", [0.0, 0.5, 0.99])
def test_truncated_file(folder, kept):
    path = folder / "ply_data_test0.h5"
    data = path.read_bytes()
    path.write_bytes(data[: int(kept * len(data))])
    with pytest.raises(ValueError, match=f"ply_data_test0.h5 must be a whole HDF5.*{ADDRESS}"):
        load_modelnet40(folder, "test")


def test_damaged_bytes_inside_an_array(folder):
    path = folder / "ply_data_test0.h5"
    data = bytearray(path.read_bytes())
    data[len(data) // 3 : len(data) // 3 + 4096] = bytes(4096)
    path.write_bytes(data)
    with pytest.raises(ValueError, match=f"ply_data_test0.h5 .*{ADDRESS}"):
        load_modelnet40(folder, "test")


def test_missing_folder_and_files(folder):
    with pytest.raises(FileNotFoundError, match=f"there is none at .*nowhere.*{ADDRESS}"):
        load_modelnet40(folder / "nowhere", "train")
    (folder / "ply_data_train2.h5").unlink()
    (folder / "ply_data_train4.h5").unlink()
    with pytest.raises(
        FileNotFoundError, match=f"lacks ply_data_train2.h5, ply_data_train4.h5.*{ADDRESS}"
    ):
        load_modelnet40(folder, "train")
    assert len(load_modelnet40(str(folder), "test")) == 8


def test_unknown_choices(folder):
    with pytest.raises(ValueError, match="split must be one of .*train.*got 'val'"):
        load_modelnet40(folder, "val")
    with pytest.raises(ValueError, match="categories must be 'seen'.*got 'both'"):
        load_modelnet40(folder, "test", categories="both")
