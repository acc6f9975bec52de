"""A transform as trackers, viewers and people write it."""

import json

import numpy as np
import pytest

from dbdnet_jax.io.transform_files import read_transform

MATRIX = np.round(np.random.default_rng(0).normal(size=(4, 4)), 4)
ROWS = [" ".join(map(repr, row)) for row in MATRIX.tolist()]
PLAIN = "\n".join(ROWS)
TEXTS = {
    "plain": PLAIN,
    "comments": "# from the tracker\n\n" + PLAIN.replace("\n", "  // a row\n") + "\n\n",
    "mark": "\ufeff" + PLAIN,
    "windows": PLAIN.replace("\n", "\r\n"),
    "tabs": PLAIN.replace(" ", "\t"),
    "commas": PLAIN.replace(" ", ", "),
    "semicolons": PLAIN.replace(" ", ";"),
    "one line": " ".join(ROWS),
    "a number a line": PLAIN.replace(" ", "\n"),
    "nested list": str(MATRIX.tolist()),
    "printed": str(MATRIX),
    "repr": "T = np." + repr(MATRIX),
}


@pytest.mark.parametrize("name", TEXTS)
@pytest.mark.parametrize("encoding", ["utf-8", "utf-16"])
def test_every_spelling_of_sixteen_numbers_is_read(tmp_path, name, encoding):
    (tmp_path / "t.txt").write_bytes(TEXTS[name].encode(encoding))
    np.testing.assert_array_equal(read_transform(tmp_path / "t.txt"), MATRIX)


@pytest.mark.parametrize("held", [MATRIX.tolist(), {"transform": MATRIX.tolist()}])
@pytest.mark.parametrize("mark", ["", "\ufeff"])
def test_json_is_a_list_or_our_own(tmp_path, held, mark):
    (tmp_path / "t.json").write_text(mark + json.dumps(held), encoding="utf-8")
    np.testing.assert_array_equal(read_transform(tmp_path / "t.json"), MATRIX)


BAD = {
    "decimal commas": PLAIN.replace(".", ","),
    "words": "the identity",
    "short row": PLAIN.rsplit(" ", 1)[0],
    "empty": "# nothing\n",
    "deep": "[" * 100_000,
    "long": "1 " * 100_000,
}


@pytest.mark.parametrize("name", BAD)
@pytest.mark.parametrize("ending", ["txt", "json", "npy"])
def test_another_file_is_refused_or_of_another_shape(tmp_path, name, ending):
    (tmp_path / f"t.{ending}").write_text(BAD[name])
    try:
        assert np.shape(read_transform(tmp_path / f"t.{ending}")) != (4, 4)
    except ValueError as error:
        assert "must hold 4x4 numbers" in str(error) and "Write four rows" in str(error)


def test_a_folder_is_refused(tmp_path):
    with pytest.raises(IsADirectoryError, match="is a folder"):
        read_transform(tmp_path)
