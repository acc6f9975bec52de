"""What `dbdnet-register` refuses to be asked for."""

import pytest

from dbdnet_jax.cli import main
from dbdnet_jax.cli.statuses import UNUSABLE


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--jobs", "0"], "must be a whole number from 1 to 4096; got '0'"),
        (["--executor", "ray://x:1"], "must be dask://HOST:PORT; got 'ray://x:1'"),
        (["--jobs", "2", "--executor", "dask://x:1"], "--jobs is for processes of this machine"),
        (["--results", "answers.txt"], "must be one of .jsonl .parquet; got answers.txt"),
    ],
)
def test_options_of_no_use_are_refused(tmp_path, capsys, options, message):
    (tmp_path / "pairs.txt").write_text("a.ply b.ply\n")
    try:
        status = main(["--batch", str(tmp_path / "pairs.txt"), *options])
    except SystemExit as exit_:
        status = exit_.code
    assert status == UNUSABLE and message in capsys.readouterr().err


def test_options_of_a_batch_are_not_for_a_pair(capsys):
    with pytest.raises(SystemExit):
        main(["a.ply", "b.ply", "--jobs", "2"])
    assert "--jobs is for --batch" in capsys.readouterr().err
