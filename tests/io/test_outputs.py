"""An output never replaces an input or another output, whatever it is called."""

import os

import pytest

from dbdnet_jax.io.outputs import require_apart


@pytest.fixture
def folder(tmp_path):
    """Files with links to them."""
    (tmp_path / "a.ply").write_text("a")
    (tmp_path / "below").mkdir()
    (tmp_path / "again").symlink_to(tmp_path / "below")
    (tmp_path / "soft.ply").symlink_to("a.ply")
    (tmp_path / "dangling.txt").symlink_to("new.txt")
    os.link(tmp_path / "a.ply", tmp_path / "hard.ply")
    return tmp_path


@pytest.mark.parametrize(
    ("inputs", "outputs"),
    [
        (["a.ply"], ["a.ply"]),
        (["a.ply"], ["below/../a.ply"]),
        (["a.ply"], ["soft.ply"]),
        (["soft.ply"], ["a.ply"]),
        (["soft.ply"], ["soft.ply"]),
        (["a.ply"], ["hard.ply"]),
        (["a.ply"], ["A.PLY"]),
        (["missing.ply"], ["missing.ply"]),
        ([], ["below/new.txt", "again/new.txt"]),
        ([], ["new.txt", "dangling.txt"]),
        ([], ["new.txt", "NEW.txt"]),
    ],
)
def test_another_name_of_the_same_file_is_refused(folder, inputs, outputs):
    with pytest.raises(
        ValueError, match=r"must not replace an input or another output; .* is also"
    ):
        require_apart([folder / name for name in inputs], [folder / name for name in outputs])


def test_files_apart_are_fine(folder):
    require_apart([folder / "a.ply", folder / "a.ply"], [folder / "b.ply", folder / "below/a.ply"])
