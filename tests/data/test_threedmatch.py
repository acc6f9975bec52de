"""3DMatch's info files and fragments: what is read, what is refused, and one real pair."""

from pathlib import Path

import numpy as np
import pytest

from dbdnet_jax.data.overlap import nearest_within, overlap_labels
from dbdnet_jax.data.threedmatch import load_correspondences, load_fragment, load_info, load_pair
from dbdnet_jax.metrics.recall import correspondence_rmse_m
from tests.data.threedmatch_folder import (
    ADDRESS,
    SCENES,
    table_of_pairs,
    torch_stream,
    torch_zip,
    write_folder,
    write_info,
)

SAMPLE = Path(__file__).parents[2].parent / "shared" / "threedmatch_sample"


@pytest.fixture
def folder(tmp_path):
    write_folder(tmp_path)
    return tmp_path


def test_info(folder):
    info = load_info(folder, "train")
    assert len(info) == 3
    assert info.source[2] == "train/sun3d-lab.v2/cloud_bin_10.pth"
    assert info.scenes == SCENES
    assert list(info.consecutive) == [False, True, False]
    assert info.rotation.shape == (3, 3, 3) and info.translation.shape == (3, 3)
    np.testing.assert_allclose(info.overlap, [0.3, 0.25, 0.4])


@pytest.mark.parametrize(
    ("split", "name"),
    [
        ("train", "train_info.pkl"),
        ("valid", "valid.pkl"),
        ("valid", "val_info.pkl"),
        ("3DMatch", "3DMatch.pkl"),
        ("3DLoMatch", "3DLoMatch.pkl"),
    ],
)
def test_info_files_under_either_name(tmp_path, split, name):
    table = table_of_pairs(np.random.default_rng(1))
    table["trans"] = np.array(table["trans"])[..., 0]  # (p, 3) instead of a list of (3, 1)
    write_info(tmp_path, name, table)
    np.testing.assert_array_equal(load_info(tmp_path, split).translation, table["trans"])


def test_rounded_rotations_are_made_rotations(tmp_path):
    table = table_of_pairs(np.random.default_rng(1))
    exact = np.array(table["rot"])
    table["rot"] = list(exact * 1.0005)
    write_info(tmp_path, "train.pkl", table)
    np.testing.assert_allclose(load_info(tmp_path, "train").rotation, exact, atol=1e-12)


@pytest.mark.parametrize("key", ["src", "tgt"])
@pytest.mark.parametrize(
    "name",
    [
        "../secret/cloud_bin_0.pth",
        "/etc/passwd",
        "train/../cloud_bin_0.pth",
        "train/../../cloud_bin_0.pth",
        "train/a/../../../cloud_bin_0.pth",
        "train\\..\\cloud_bin_0.pth",
        "C:/train/a/cloud_bin_0.pth",
        "train/a/cloud_bin_0.pth\n",
        "train/a/b/cloud_bin_0.pth",
        "train//cloud_bin_0.pth",
        "other/a/cloud_bin_0.pth",
        "train/a/cloud_bin_x.pth",
        "train/a\0/cloud_bin_0.pth",
        7,
    ],
)
def test_paths_cannot_leave_the_folder(tmp_path, key, name):
    table = table_of_pairs(np.random.default_rng(1))
    table[key][1] = name
    write_info(tmp_path, "train.pkl", table)
    with pytest.raises(ValueError, match="train.pkl must be named .* It is not opened") as caught:
        load_info(tmp_path, "train")
    assert f"got {name!r}" in str(caught.value)


def changed(**entries):
    table = table_of_pairs(np.random.default_rng(1))
    table.update(entries)
    return table


@pytest.mark.parametrize(
    ("table", "message"),
    [
        ([1, 2], "must hold a dict of lists src, tgt, rot, trans, overlap .* got a list"),
        ({"src": []}, "must hold a dict of lists .* got a dict with the lengths {'src': 0}"),
        (changed(tgt=["train/a/cloud_bin_0.pth"]), "of one length; .* 'tgt': 1"),
        (changed(src=3), "must hold a dict of lists"),
        (
            {"src": [], "tgt": [], "rot": [], "trans": [], "overlap": []},
            "one row for each of its 0 pairs",
        ),
        (changed(rot=[np.eye(4)] * 3), r"must be \(p, 3, 3\), .* got \(\(3, 4, 4\)"),
        (changed(trans=[np.zeros(2)] * 3), r"must be .* \(3, 2\)"),
        (changed(rot=[np.eye(3), np.eye(4), np.eye(3)]), "must be numbers of one shape each"),
        (changed(overlap=["a"] * 3), "must be numbers of one shape each"),
        (changed(rot=[np.eye(3), 2 * np.eye(3), np.eye(3)]), "rigid motion; row 1 has rotation"),
        (changed(rot=[np.eye(3), np.eye(3), -np.eye(3)]), "rigid motion; row 2 has rotation"),
        (changed(rot=[np.full((3, 3), np.nan)] * 3), "rigid motion; row 0 has rotation"),
        (changed(trans=[np.full(3, np.inf)] * 3), "rigid motion; row 0 .* inf"),
    ],
)
def test_damaged_info(tmp_path, table, message):
    write_info(tmp_path, "train.pkl", table)
    with pytest.raises(ValueError, match=f"train.pkl .*{message}.*{ADDRESS}|{message}.*{ADDRESS}"):
        load_info(tmp_path, "train")


class Payload:
    """Unpickled by pickle itself, it would make a file."""

    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return Path.touch, (self.path,)


def test_code_in_an_info_file_is_refused(tmp_path):
    write_info(tmp_path, "train.pkl", changed(src=Payload(tmp_path / "ran")))
    with pytest.raises(ValueError, match="train.pkl"):
        load_info(tmp_path, "train")
    assert not (tmp_path / "ran").exists()


@pytest.mark.parametrize("form", [torch_stream, torch_zip])
def test_code_in_a_fragment_is_refused(tmp_path, form):
    (tmp_path / "cloud.pth").write_bytes(form(Payload(tmp_path / "ran")))
    with pytest.raises(ValueError, match="cloud.pth"):
        load_fragment(tmp_path, "cloud.pth")
    assert not (tmp_path / "ran").exists()


def test_missing_folder_info_and_fragment(folder):
    with pytest.raises(FileNotFoundError, match=f"there is none at .*nowhere.*{ADDRESS}"):
        load_info(folder / "nowhere", "train")
    with pytest.raises(FileNotFoundError, match=f"valid.pkl or val_info.pkl; .*{ADDRESS}"):
        load_info(folder, "valid")
    with pytest.raises(ValueError, match="split must be one of .*3DLoMatch.*got 'test'"):
        load_info(folder, "test")
    info = load_info(folder, "train")
    (folder / info.target[2]).unlink()
    with pytest.raises(FileNotFoundError, match=f"sun3d-lab.v2/cloud_bin_4.pth.*{ADDRESS}"):
        load_pair(folder, info, 2)


@pytest.mark.parametrize("form", [torch_stream, torch_zip])
@pytest.mark.parametrize("dtype", [np.float32, np.float64, ">f8"])
def test_fragment_in_both_formats(tmp_path, form, dtype):
    points = np.random.default_rng(0).normal(size=(11, 3)).astype(dtype)
    (tmp_path / "cloud.pth").write_bytes(form(points))
    read = load_fragment(tmp_path, "cloud.pth")
    assert read.dtype == np.float64 and read.flags.c_contiguous and read.flags.writeable
    np.testing.assert_array_equal(read, points)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (np.zeros((5, 3), int), "must hold an array of floats; got"),
        ([0.0, 1.0], "must hold an array of floats; got"),
        (np.zeros((5, 4)), r"must hold \(n, 3\) points, n >= 1; got \(5, 4\)"),
        (np.zeros((0, 3)), r"must hold \(n, 3\) points, n >= 1; got \(0, 3\)"),
        (np.full((5, 3), np.nan), "must be finite"),
    ],
)
def test_fragment_of_another_kind(tmp_path, content, message):
    (tmp_path / "cloud.pth").write_bytes(torch_zip(content))
    with pytest.raises(ValueError, match=f"cloud.pth.* {message}.*{ADDRESS}"):
        load_fragment(tmp_path, "cloud.pth")


@pytest.mark.parametrize("form", [torch_stream, torch_zip])
def test_truncated_fragment(tmp_path, form):
    data = form(np.zeros((500, 3)))
    (tmp_path / "cloud.pth").write_bytes(data[: len(data) // 2])
    with pytest.raises(ValueError, match="cloud.pth"):
        load_fragment(tmp_path, "cloud.pth")


@pytest.mark.skipif(not SAMPLE.is_dir(), reason=f"the real pair is not at {SAMPLE}")
def test_real_pair():
    info = load_info(SAMPLE, "3DLoMatch")
    assert len(info) == 1781 and len(set(info.scenes)) == 8
    assert info.consecutive.sum() == 55
    assert info.source[351] == "test/7-scenes-redkitchen/cloud_bin_34.pth"
    assert info.target[351] == "test/7-scenes-redkitchen/cloud_bin_21.pth"
    assert info.overlap[351] == pytest.approx(0.108, abs=5e-4)
    orthogonality = np.swapaxes(info.rotation, 1, 2) @ info.rotation - np.eye(3)
    assert np.abs(orthogonality).max() < 1e-12

    source = load_fragment(SAMPLE, info.source[351])
    target = load_fragment(SAMPLE, info.target[351])
    assert len(source) == 14602 and len(target) == 25337
    moved = source @ info.rotation[351].T + info.translation[351]
    # The info's share is that of the lower-numbered fragment at 0.03 m, on clouds of 1 cm voxels;
    # the stored ones have 2.5 cm.
    near, _ = nearest_within(target, moved, 0.03)
    assert near.mean() == pytest.approx(info.overlap[351], abs=0.01)
    pair = load_pair(SAMPLE, info, 351)
    assert int(pair.source.count) == int(pair.target.count) == 2048
    near_source, near_target = overlap_labels(moved, target, 0.0375)
    for drawn, full in ((pair.source_overlap, near_source), (pair.target_overlap, near_target)):
        assert drawn.mean() == pytest.approx(full.mean(), abs=0.03)  # 3 standard errors
    corresponding = load_correspondences(SAMPLE, info, 351)
    assert correspondence_rmse_m(pair.target_from_source, *corresponding) < 0.0375
