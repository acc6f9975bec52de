"""PLY rows: alike or not, text or binary, in either order of bytes, and what follows them."""

import struct
import sys

import numpy as np
import pytest

from dbdnet_jax.io.point_files import MESH_SAMPLES, read_point_file
from tests.conftest import random_cloud

POINTS = random_cloud(1, 40).round(3)
XYZ = "".join(f"property double {axis}\n" for axis in "xyz")
FACES = "element face {}\nproperty list uchar int vertex_indices\n"
SQUARE = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [2, 0, 0]], float)
TEXT = "".join("{} {} {}\n".format(*p) for p in POINTS.tolist())


def ply(kind: str, body: bytes, count: int = 40, before: str = "", after: str = "") -> bytes:
    head = f"ply\nformat {kind} 1.0\n{before}element vertex {count}\n{XYZ}{after}end_header\n"
    return head.encode() + body


def read(tmp_path, data: bytes, **options):
    (tmp_path / "a.ply").write_bytes(data)
    return read_point_file(tmp_path / "a.ply", **options)


CLOUDS = {
    "text": ply("ascii", TEXT.encode()),
    "text of Windows": ply("ascii", TEXT.replace("\n", "\r\n").encode()),
    "text of old Macintoshes": ply("ascii", TEXT.replace("\n", "\r").encode()),
    "little-endian": ply("binary_little_endian", POINTS.astype("<f8").tobytes()),
    "big-endian": ply("binary_big_endian", POINTS.astype(">f8").tobytes()),
    "no faces": ply("ascii", TEXT.encode(), after=FACES.format(0)),
    "another element first": ply(
        "binary_little_endian",
        struct.pack("<iB2i", 7, 2, 8, 9) + POINTS.astype("<f8").tobytes(),
        before="element camera 1\nproperty int id\nproperty list uchar int flags\n",
    ),
    "lists that vary": ply(
        "binary_little_endian",
        b"".join(struct.pack(f"<{i % 3 + 1}B", i % 3, *range(i % 3)) for i in range(9))
        + POINTS.astype("<f8").tobytes(),
        before="element group 9\nproperty list uchar uchar of\n",
    ),
    "lists that vary in text": ply(
        "ascii",
        b"1 5\n2 6 7\n" + TEXT.encode(),
        before="element group 2\nproperty list uchar int of\n",
    ),
}


@pytest.mark.parametrize("name", CLOUDS)
def test_its_vertices_are_read(tmp_path, monkeypatch, name):
    if "vary" not in name:  # plyfile takes a hundred times as long
        monkeypatch.setitem(sys.modules, "plyfile", None)
    found = read(tmp_path, CLOUDS[name])
    np.testing.assert_array_equal(found.points, POINTS)
    assert found.notes == ()


@pytest.mark.parametrize("word", ["nan", "-nan(ind)", "-NaN", "1.#QNAN", "-1.#IND", "inf"])
def test_a_word_for_no_number_is_one(tmp_path, word):
    found = read(tmp_path, ply("ascii", f"{word} 0 1\n{TEXT}".encode(), 41))
    np.testing.assert_array_equal(found.points, POINTS)
    assert found.notes == ("source (a.ply): 1 of 41 points have NaN or infinity and were left out",)


@pytest.mark.parametrize(
    "faces", [[(0, 1, 2), (0, 2, 3)], [(0, 1, 2, 3)], [(0, 1, 2), (0, 2, 3, 0)]]
)
@pytest.mark.parametrize("text", [True, False])
def test_polygons_alike_or_not_cover_the_same_square(tmp_path, faces, text):
    if text:
        rows = [*SQUARE.astype(int).tolist(), *([len(face), *face] for face in faces)]
        body = "".join(" ".join(map(str, row)) + "\n" for row in rows).encode()
    else:
        body = SQUARE.astype("<f8").tobytes()
        body += b"".join(struct.pack(f"<B{len(face)}i", len(face), *face) for face in faces)
    kind = "ascii" if text else "binary_little_endian"
    data = ply(kind, body, len(SQUARE), after=FACES.format(len(faces)))
    drawn = read(tmp_path, data).points[:MESH_SAMPLES]
    assert (drawn[:, 2] == 0).all() and drawn.min() >= 0 and drawn.max() <= 1
    np.testing.assert_allclose(drawn[:, :2].mean(axis=0), 0.5, atol=0.02)


def test_strips_of_triangles_cover_the_square(tmp_path):
    body = SQUARE.astype("<f8").tobytes() + struct.pack("<5i", 4, 0, 1, 3, 2)
    after = "element tristrips 1\nproperty list int int vertex_indices\n"
    drawn = read(tmp_path, ply("binary_little_endian", body, 5, after=after)).points[:MESH_SAMPLES]
    np.testing.assert_allclose(drawn[:, :2].mean(axis=0), 0.5, atol=0.02)


def test_what_follows_the_rows_is_said(tmp_path):
    found = read(tmp_path, ply("ascii", (TEXT + TEXT).encode()))
    np.testing.assert_array_equal(found.points, POINTS)
    note = f"source (a.ply): {len(TEXT)} bytes after its 40 rows of vertex were not read"
    assert found.notes == (note,)
    body = POINTS.astype("<f8").tobytes()
    assert read(tmp_path, ply("binary_little_endian", body + b"\r\n")).notes == ()
    assert read(tmp_path, ply("binary_little_endian", body + body[:24])).notes != ()


BAD = {
    "text that is called binary": (
        ply("binary_little_endian", 9 * TEXT.encode()),
        "says binary_little_endian, and its rows are text",
    ),
    "a row less": (ply("ascii", TEXT.encode(), 41), "rows of vertex .* row 40 of 41"),
    "a byte less": (
        ply("binary_big_endian", POINTS.tobytes()[:-1]),
        "40 rows of vertex are not all there: .*row 39 of 40",
    ),
    "a corner of no vertex": (
        ply("ascii", (TEXT + "3 0 1 40\n").encode(), after=FACES.format(1)),
        "a face joins vertex 40 of 40",
    ),
    "half a corner": (
        ply("ascii", (TEXT + "3 0 1 1.5\n").encode(), after=FACES.format(1)),
        "a corner of its faces is no whole number",
    ),
    "decimal commas": (ply("ascii", TEXT.replace(".", ",").encode()), "malformed input"),
    "an unknown kind": (ply("binary", POINTS.tobytes()), "is not: "),
}


@pytest.mark.parametrize("name", BAD)
def test_rows_other_than_promised_are_refused(tmp_path, name):
    data, message = BAD[name]
    with pytest.raises(ValueError, match=message):
        read(tmp_path, data)
