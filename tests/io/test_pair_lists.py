"""Lists of pairs as people write them, and the line of those that cannot be read."""

import pytest

from dbdnet_jax.io.pair_lists import read_pairs

NAMES = ["a.ply", "b.ply", "bob's.ply", "x y.ply", "a,b.ply", "scan#1.ply", "below/c.ply"]


@pytest.fixture
def folder(tmp_path):
    """Files of all these names."""
    (tmp_path / "below").mkdir()
    for name in NAMES:
        (tmp_path / name).write_text("")
    return tmp_path


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        ("a.ply b.ply", ("a.ply", "b.ply")),
        ("a.ply b.ply # the first", ("a.ply", "b.ply")),
        ("'x y.ply' \"b.ply\"", ("x y.ply", "b.ply")),
        ("x y.ply\tb.ply", ("x y.ply", "b.ply")),
        ("a.ply,b.ply", ("a.ply", "b.ply")),
        ('"x y.ply"; b.ply', ("x y.ply", "b.ply")),
        ("a,b.ply b.ply", ("a,b.ply", "b.ply")),
        ("bob's.ply b.ply", ("bob's.ply", "b.ply")),
        (r"below\c.ply b.ply", ("below/c.ply", "b.ply")),
        ("missing.ply b.ply", ("missing.ply", "b.ply")),
    ],
)
@pytest.mark.parametrize("mark", ["", "\ufeff"])
def test_a_line_is_read_the_way_that_gives_files(folder, line, expected, mark):
    (folder / "list.txt").write_text(f"{mark}{line}\r\n\r\n# end\r\n", encoding="utf-8")
    (pair,) = read_pairs(folder / "list.txt")
    assert (pair.source, pair.target) == tuple(folder / name for name in expected)
    assert pair.origin == f"{folder}/list.txt:1" and pair.name.startswith("0001_")


def test_utf16_is_read(folder):
    (folder / "list.txt").write_bytes("a.ply b.ply\n".encode("utf-16"))
    assert read_pairs(folder / "list.txt")[0].source == folder / "a.ply"


@pytest.mark.parametrize("line", ["a.ply", "a.ply b.ply a.ply", "'a.ply b.ply", "\x00\x01", ","])
def test_another_line_is_named_with_file_and_line(folder, line):
    (folder / "list.txt").write_text(f"a.ply b.ply\n\n{line}\n")
    with pytest.raises(ValueError, match=r"list\.txt:3 must hold two paths; got"):
        read_pairs(folder / "list.txt")


def test_names_of_outputs_fit_a_file_system(folder):
    (folder / "list.txt").write_text(f"{'a' * 240}.ply {'b' * 240}.ply\n")
    assert len(read_pairs(folder / "list.txt")[0].name) < 200
