"""The curves go on where a run goes on, whatever a kill or a full disk left of them."""

import pytest

from dbdnet_jax.training.runlog import RunLog


def test_the_log_drops_what_is_done_again_and_torn_rows(tmp_path):
    with RunLog(tmp_path, 0) as log:
        for step in (10, 20, 30):
            log.write("train", step, {"loss": 1 / step, "rate": 0.1})
        log.write("validation", 30, {"error": 0.5})
    whole = (tmp_path / "train.csv").read_text()
    with (tmp_path / "train.csv").open("a") as file:
        file.write("4")
    with RunLog(tmp_path, 20) as log:
        assert (tmp_path / "train.csv").read_text() == whole[: whole.index("30,")]
        assert not (tmp_path / "validation.csv").exists()
        log.write("train", 30, {"loss": 1 / 30, "rate": 0.1})
    assert (tmp_path / "train.csv").read_text() == whole


@pytest.mark.parametrize("left", [b"", b"\n \n"])
def test_a_curve_without_a_row_begins_anew(tmp_path, left):
    (tmp_path / "train.csv").write_bytes(left)
    begin_anew(tmp_path)


@pytest.mark.parametrize("left", [b"\0" * 64, b"\xff\xfe\n\n", b"step,loss\n\0\0\0\n", b"7,0.5\n"])
def test_a_damaged_curve_begins_anew_with_a_warning(tmp_path, left):
    (tmp_path / "train.csv").write_bytes(left)
    with pytest.warns(RuntimeWarning, match=r"train\.csv has others, which are dropped"):
        begin_anew(tmp_path)


def begin_anew(folder) -> None:
    with RunLog(folder, 20) as log:
        log.write("train", 30, {"loss": 0.5})
    assert (folder / "train.csv").read_text() == "step,loss\n30,0.5\n"


def test_sound_rows_beside_damaged_ones_stay(tmp_path):
    path = tmp_path / "train.csv"
    path.write_bytes(b"step,loss\n1,0.5\n2,\xff\n3\nx,0.5\n4,0.25\n5,0.1\n")
    with pytest.warns(RuntimeWarning, match="has others"), RunLog(tmp_path, 4):
        assert path.read_text() == "step,loss\n1,0.5\n4,0.25\n"


def test_other_files_of_the_folder_are_left_alone(tmp_path):
    notes = "step,remark\n300,looks good\n"
    (tmp_path / "notes.csv").write_text(notes)
    with RunLog(tmp_path, 0):
        pass
    assert (tmp_path / "notes.csv").read_text() == notes
