"""Points from every kind of file; what is wrong with a file is said, by rule, value and fix."""

import sys

import numpy as np
import pytest
import trimesh

from dbdnet_jax.errors import MissingExtraError
from dbdnet_jax.io.files import write_atomic
from dbdnet_jax.io.point_files import MESH_SAMPLES, read_points
from dbdnet_jax.io.transform_files import read_transform
from tests.conftest import random_cloud

POINTS = random_cloud(1, 40)


def text(separator: str = " ", head: str = "", points=POINTS) -> bytes:
    rows = (separator.join(repr(float(x)) for x in row) for row in points)
    return (head + "\n".join(rows) + "\n").encode()


def geometry(kind: str) -> bytes:
    data = trimesh.PointCloud(POINTS).export(file_type=kind)
    return data.encode() if isinstance(data, str) else data


def archive(tmp_path, **arrays) -> bytes:
    np.savez(tmp_path / "in.npz", **arrays)
    return (tmp_path / "in.npz").read_bytes()


CLOUDS = {
    "ascii.xyz": lambda tmp: text(),
    "colours.xyz": lambda tmp: text(points=np.hstack([POINTS, POINTS])),
    "molecule.xyz": lambda tmp: text(head="40\na comment\n"),
    "hash.txt": lambda tmp: text(head="# x y z\n"),
    "commas.csv": lambda tmp: text(","),
    "semicolons.csv": lambda tmp: text("; "),
    "tabs.csv": lambda tmp: text("\t", "x\ty\tz\n"),
    "named.csv": lambda tmp: text(",", "id,Z,X,Y\n", np.c_[np.zeros(40), POINTS[:, [2, 0, 1]]]),
    "quoted.csv": lambda tmp: text(",", '"x","y","z"\n'),
    "mark.csv": lambda tmp: b"\xef\xbb\xbf" + text(","),
    "windows.csv": lambda tmp: text(",").replace(b"\n", b"\r\n"),
    "CAPITALS.XYZ": lambda tmp: text(),
    "points.npz": lambda tmp: archive(tmp, points=POINTS, other=np.zeros(3)),
    "only.npz": lambda tmp: archive(tmp, cloud=POINTS),
    "binary.ply": lambda tmp: geometry("ply"),
}


@pytest.mark.parametrize("name", CLOUDS)
def test_every_kind_of_cloud_gives_its_points_in_order(tmp_path, name):
    (tmp_path / name).write_bytes(CLOUDS[name](tmp_path))
    found = read_points(tmp_path / name)
    assert found.dtype == np.float64
    np.testing.assert_allclose(found, POINTS, atol=1e-6 if name.endswith("ply") else 0)


def test_npy_keeps_the_precision_and_paths_may_be_text(tmp_path):
    np.save(tmp_path / "a.npy", POINTS)
    np.testing.assert_array_equal(read_points(str(tmp_path / "a.npy")), POINTS)


@pytest.mark.parametrize("kind", ["ply", "obj", "off", "stl", "glb"])
def test_a_mesh_is_sampled_evenly_and_by_its_seed(tmp_path, kind):
    path = tmp_path / f"box.{kind}"
    trimesh.creation.box((1, 2, 4)).export(path)
    points = read_points(path, seed=3)
    assert points.shape == (MESH_SAMPLES, 3)
    np.testing.assert_array_equal(points, read_points(path, seed=3))
    assert not np.array_equal(points, read_points(path, seed=4))
    half = np.array([0.5, 1, 2])
    assert np.allclose(np.max(np.abs(points) / half, axis=1), 1)  # on the surface
    top = np.mean(np.isclose(points[:, 2], 2))
    assert top == pytest.approx(2 / 28, abs=0.01)  # its part of the area


def test_a_scene_of_several_meshes_is_one_cloud(tmp_path):
    boxes = [trimesh.creation.box().apply_translation([x, 0, 0]) for x in (0, 10)]
    trimesh.Scene(boxes).export(tmp_path / "two.glb")
    x = read_points(tmp_path / "two.glb")[:, 0]
    assert np.mean(x > 5) == pytest.approx(0.5, abs=0.02)


def test_pcd_is_read_as_open3d_writes_it(tmp_path):
    open3d = pytest.importorskip("open3d")
    cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(POINTS))
    open3d.io.write_point_cloud(str(tmp_path / "a.pcd"), cloud)
    np.testing.assert_allclose(read_points(tmp_path / "a.pcd"), POINTS, atol=1e-6)


@pytest.mark.parametrize(
    ("ending", "library"), [("las", "laspy"), ("laz", "lazrs"), ("e57", "pye57")]
)
def test_an_absent_library_says_what_to_install(tmp_path, monkeypatch, ending, library):
    if library == "lazrs":
        pytest.importorskip("laspy")
    monkeypatch.setitem(sys.modules, library, None)
    (tmp_path / f"a.{ending}").write_bytes(b"LASF")
    with pytest.raises(MissingExtraError, match=rf"need {library}.*pip install .*formats"):
        read_points(tmp_path / f"a.{ending}")


def test_an_obj_opens_no_other_file(tmp_path):
    (tmp_path / "secret.mtl").write_text("newmtl a\nmap_Kd ../../secret.png\n")
    rows = "".join(f"v {x} {y} {z}\n" for x, y, z in POINTS)
    (tmp_path / "a.obj").write_text(f"mtllib secret.mtl\nusemtl a\n{rows}")
    opened = []
    sys.addaudithook(lambda event, args: event == "open" and opened.append(str(args[0])))
    read_points(tmp_path / "a.obj")
    assert not [name for name in opened if "secret" in name]


@pytest.mark.parametrize("ending", ["txt", "json", "npy"])
def test_a_transform_is_read_back(tmp_path, ending):
    matrix = np.arange(16.0).reshape(4, 4) / 7
    path = tmp_path / f"t.{ending}"
    if ending == "txt":
        np.savetxt(path, matrix, fmt="%.17g")
    elif ending == "npy":
        np.save(path, matrix)
    else:
        path.write_text(f'{{"transform": {matrix.tolist()}}}')
    np.testing.assert_array_equal(read_transform(path), matrix)


@pytest.mark.parametrize("failing", ["fsync", "replace"])
def test_a_failed_write_leaves_the_old_file_and_nothing_else(tmp_path, monkeypatch, failing):
    def fail(*_):
        raise OSError(28, "No space left on device")

    (tmp_path / "a").write_bytes(b"old")
    monkeypatch.setattr(f"os.{failing}", fail)
    with pytest.raises(OSError, match="No space"):
        write_atomic(tmp_path / "a", b"new")
    assert [(path.name, path.read_bytes()) for path in tmp_path.iterdir()] == [("a", b"old")]
