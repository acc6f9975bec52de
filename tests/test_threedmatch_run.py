"""`configs/threedmatch.py` from a folder of scans to the table, by the scripts themselves."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.data.threedmatch_folder import write_folder

ROOT = Path(__file__).parents[1]
SMALL = {
    "model.encoder": "dgcnn",  # compiles faster, as one branch does
    "model.branches": 1,
    "model.neighbours": 4,
    "model.overlap_channels": 4,
    "model.overlap_blocks": 1,
    "model.registration_channels": 4,
    "model.shared_blocks": 0,
    "model.rotation_blocks": 0,
    "model.translation_blocks": 0,
    "model.dropout": 0.0,
    "model.sinkhorn_iterations": 1,
    "model.head_width": 128,
    "model.parameter_width": 128,
    "model.min_points": 24,
    "protocol.points": 96,
    "protocol.overlap_radius": 0.2,
    "overlap.epochs": 2.0,
    "registration.epochs": 1.0,
    "train.log_every": 1,
    "train.validation_pairs": 2,
    "train.devices": 1,
}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Three pairs, which are all splits; the second pair is consecutive and needs no motion."""
    folder = tmp_path_factory.mktemp("indoor")
    write_folder(folder)
    for split in ("valid", "3DMatch", "3DLoMatch"):
        (folder / f"{split}.pkl").write_bytes((folder / "train.pkl").read_bytes())
    return folder


def run(script: str, folder: Path, *flags: str) -> str:
    """What a script prints; its run and its cache are in ``folder`` too."""
    settings = SMALL | {"data.folder": folder}
    command = [
        *(sys.executable, script),
        *("--config=configs/threedmatch.py", f"--run_dir={folder / 'run'}", *flags),
        *(f"--config.{name}={value}" for name, value in settings.items()),
    ]
    environment = os.environ | {"XDG_CACHE_HOME": str(folder / "cache")}
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return done.stdout


def recalls(content: dict, method: str) -> dict[str, float]:
    (row,) = (row for row in content["rows"] if row["method"] == method)
    names = ("recall_15deg_30cm_", "recall_rmse_20cm_")
    return {name: value for name, value in row.items() if name.startswith(names)}


def test_a_folder_of_scans_is_trained_on_and_evaluated(folder):
    run("train.py", folder, "--noevaluate")
    assert (folder / "run" / "params.npz").is_file()
    assert len(list((folder / "cache" / "dbdnet_jax" / "threedmatch").iterdir())) == 3

    text = run("evaluate.py", folder, "--benchmark=3DLoMatch")
    assert "3 pairs of 3DLoMatch, sha256" in text
    assert (
        "registration recall     R < 15 deg  R < 15 deg       RMSE        RMSE  RMSE, apart" in text
    )
    assert "FGR, true normals" not in text  # scans have none
    content = json.loads((folder / "run" / "evaluation_3DLoMatch.json").read_text())
    # Two pairs are of one scene; only the consecutive one is where it should be.
    assert recalls(content, "identity") == {
        "recall_15deg_30cm_pair_mean": pytest.approx(1 / 3),
        "recall_15deg_30cm_scene_mean": 0.25,
        "recall_rmse_20cm_pair_mean": pytest.approx(1 / 3),
        "recall_rmse_20cm_scene_mean": 0.25,
        "recall_rmse_20cm_scene_mean_apart": 0.0,
    }
    assert None not in recalls(content, "DBDNet").values()
