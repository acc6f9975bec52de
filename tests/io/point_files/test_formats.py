"""Every format as its own library writes it: whole, cut short, and with rows that are no number."""

import struct

import numpy as np
import pytest

from dbdnet_jax.io.point_files import read_point_file
from tests.conftest import random_cloud

POINTS = random_cloud(1, 40).round(3)
HOLED = np.where(np.arange(40)[:, None] % 4 == 0, np.nan, POINTS)
LOST = "10 of 40 points have NaN or infinity and were left out"


def write_pcd(path, points):
    cloud = pytest.importorskip("pypcd4").PointCloud.from_xyz_points(points.astype("f4"))
    cloud.save(path)


def write_ply(path, points):
    plyfile = pytest.importorskip("plyfile")
    rows = np.array([tuple(p) for p in points], [(axis, "f8") for axis in "xyz"])
    plyfile.PlyData([plyfile.PlyElement.describe(rows, "vertex")]).write(path)


def write_las(path, points):
    laspy = pytest.importorskip("laspy")
    if path.suffix == ".laz":
        pytest.importorskip("lazrs")
    header = laspy.LasHeader(point_format=3, version="1.2")
    header.scales = np.full(3, 0.001)
    las = laspy.LasData(header)
    las.x, las.y, las.z = points.T
    las.write(path)


def write_e57(path, points):
    archive = pytest.importorskip("pye57").E57(str(path), mode="w")
    mark = np.float32(0.123456789)  # pye57 does not write NaN
    marked = np.nan_to_num(points, nan=mark)
    archive.write_scan_raw({f"cartesian{axis}": marked[:, i] for i, axis in enumerate("XYZ")})
    archive.close()
    raw = path.read_bytes()
    pages = (raw[i : i + 1020] for i in range(0, len(raw), 1024))  # a checksum ends each
    content = b"".join(pages).replace(mark.tobytes(), np.float32(np.nan).tobytes())
    pages = (content[i : i + 1020] for i in range(0, len(content), 1020))
    path.write_bytes(b"".join(page + struct.pack(">I", crc32c(page)) for page in pages))


def crc32c(data: bytes) -> int:
    """Castagnoli's checksum, bit by bit."""
    crc = 0xFFFFFFFF
    for byte in data:
        crc ^= byte
        for _ in range(8):
            crc = crc >> 1 ^ (0x82F63B78 if crc & 1 else 0)
    return crc ^ 0xFFFFFFFF


def write_kitti(path, points):
    np.c_[points, np.zeros(len(points))].astype("<f4").tofile(path)


def write_npy(path, points):
    np.save(path, np.c_[points, points])


WRITERS = {
    "pcd": write_pcd,
    "ply": write_ply,
    "las": write_las,
    "laz": write_las,
    "e57": write_e57,
    "bin": write_kitti,
    "npy": write_npy,
}


@pytest.mark.parametrize("ending", WRITERS)
def test_a_file_of_its_own_library_gives_its_points(tmp_path, ending):
    WRITERS[ending](tmp_path / f"a.{ending}", POINTS)
    found = read_point_file(tmp_path / f"a.{ending}")
    np.testing.assert_allclose(found.points, POINTS, atol=1e-6)
    assert found.notes == ()


@pytest.mark.parametrize("ending", WRITERS)
def test_a_file_cut_short_is_refused(tmp_path, ending):
    path = tmp_path / f"a.{ending}"
    WRITERS[ending](path, POINTS)
    path.write_bytes(path.read_bytes()[:-37])
    with pytest.raises(ValueError, match=rf"a\.{ending} is not: "):
        read_point_file(path)


@pytest.mark.parametrize("ending", ["pcd", "ply", "bin", "npy", "e57"])
def test_rows_that_are_no_number_are_dropped_and_counted(tmp_path, ending):
    WRITERS[ending](tmp_path / f"a.{ending}", HOLED)
    found = read_point_file(tmp_path / f"a.{ending}")
    kept = POINTS[np.isfinite(HOLED).all(axis=1)]
    np.testing.assert_allclose(found.points, kept, atol=1e-6)
    assert found.notes == (f"source (a.{ending}): {LOST}",)


@pytest.mark.parametrize("ending", ["las", "laz"])
def test_coordinates_that_a_scale_of_nan_makes_are_dropped_and_counted(tmp_path, ending):
    path = tmp_path / f"a.{ending}"
    write_las(path, POINTS)  # whole numbers: only the head's scale can be none
    data = bytearray(path.read_bytes())
    data[131:139] = struct.pack("<d", np.nan)
    path.write_bytes(data)
    with pytest.raises(ValueError, match=r"got 0. Give more points. \(40 of 40 points have NaN"):
        read_point_file(path)


@pytest.mark.parametrize("columns", [3, 5])
def test_a_bin_of_other_rows_than_four_numbers_is_refused(tmp_path, columns):
    np.c_[POINTS, np.ones((40, 2))][:, :columns].astype("<f4").tofile(tmp_path / "a.bin")
    with pytest.raises(ValueError, match="another number of columns. Save points"):
        read_point_file(tmp_path / "a.bin")


def pcd(fields: str, size: str, kind: str, body: bytes, data: str = "ascii", n: int = 40) -> bytes:
    head = f"FIELDS {fields}\nSIZE {size}\nTYPE {kind}\nWIDTH {n}\nDATA {data}\n"
    return head.encode() + body


ROWS = "".join("{:.3f} {:.3f} {:.3f}\n".format(*tuple(p)) for p in POINTS)


@pytest.mark.parametrize(
    "body",
    [
        ROWS[: len(ROWS) // 2],
        ROWS + "1 2 3\n",
        ROWS.replace(" ", ","),
        ROWS.replace(" ", ";"),
        ROWS.replace(".", ","),
        ROWS.replace("-", "x", 1),
        ROWS.replace("\n", " 7\n", 1),
    ],
)
def test_an_ascii_pcd_of_other_rows_than_promised_is_refused(tmp_path, body):
    (tmp_path / "a.pcd").write_bytes(pcd("x y z", "4 4 4", "F F F", body.encode()))
    with pytest.raises(ValueError, match=r"rows|numbers separated by blanks"):
        read_point_file(tmp_path / "a.pcd")


@pytest.mark.parametrize("kind", ["f8", "f4", "i8", "i4", "i2", "u4"])
def test_a_binary_pcd_keeps_its_type(tmp_path, kind):
    points = (np.abs(POINTS) * 1000).astype(kind)
    letters, sizes = " ".join(kind[0].upper() * 3), " ".join(kind[1] * 3)
    body = points.astype(f"<{kind}").tobytes()
    (tmp_path / "a.pcd").write_bytes(pcd("x y z", sizes, letters, body, "binary"))
    np.testing.assert_array_equal(read_point_file(tmp_path / "a.pcd").points, points)


def test_a_compressed_pcd_that_promises_more_than_it_can_hold_is_refused(tmp_path):
    body = struct.pack("<II", 3, 12 * 10**9 % 2**32) + b"abc"
    path = tmp_path / "a.pcd"
    path.write_bytes(pcd("x y z", "4 4 4", "F F F", body, "binary_compressed", 10**9))
    with pytest.raises(ValueError, match="is not: "):
        read_point_file(path)
