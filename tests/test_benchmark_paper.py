"""The paper's tables: what is trained by which command, kept, scored once, and printed."""

import json
import os
import signal
import sys
import threading
import time

import jax
import numpy as np
import pytest

from benchmarks.paper import of_data, public, published, tables
from benchmarks.paper.recipes import RECIPES, Training, configuration, stages, trainings
from benchmarks.paper.scoring import classical_methods, first, read_row, score_classical, score_runs
from benchmarks.paper.training import Stopped, _cpu_seconds, affordable, spent, train
from dbdnet_jax.data.frozen import cad_test_pairs
from dbdnet_jax.data.test_pairs import PairSet
from dbdnet_jax.networks.initial import init_params
from dbdnet_jax.networks.weights import save_params
from tests.networks.small_peers import CONFIGS
from tests.peers import WEIGHTS

PAIRS = 1200


def tiny_set(count: int = 2) -> PairSet:
    pairs, digest = cad_test_pairs("noise")
    symmetric = np.arange(len(pairs.source.count)) % 2 == 1
    return first(PairSet("cad_test_noise", pairs, digest, symmetric=symmetric), count)


def standing_in(lines: list, *, start: float = 20.0, each: float = 0.1):
    """A stand-in for train.py: notes the command lines, takes some seconds, leaves weights."""

    def run(line):
        lines.append(dict(field.split("=", 1) for field in line if "=" in field))
        path = f"{lines[-1]['--run_dir']}/params.npz"
        save_params(path, init_params(jax.random.key(0), CONFIGS["dcp"]))
        stage, pairs = stages_and_pairs(lines)[-1]
        before = [seen for name, seen in stages_and_pairs(lines)[:-1] if name == stage]
        return start + each * (pairs - max(before, default=0))

    return run


def stages_and_pairs(lines: list) -> list[tuple[str, int]]:
    """Of each command line."""
    return [
        (fields["--stage"], round(642 * float(fields[f"--config.{fields['--stage']}.epochs"])))
        for fields in lines
    ]


def test_every_recipe_has_a_configuration_and_the_ladder_has_every_step():
    for recipe in RECIPES.values():
        assert set(stages(configuration(recipe))) <= set(configuration(recipe).stages)
    steps = [recipe.step for recipe in RECIPES.values() if recipe.step]
    assert sorted(steps) == list(published.ABLATION)
    assert [len(trainings(RECIPES[name], 3, False)) for name in ("dcp", "dgcnn")] == [1, 3]
    assert [len(trainings(RECIPES[name], 3, True)) for name in ("dcp", "dgcnn")] == [1, 0]


def test_two_stages_share_the_pairs_and_then_the_minutes_and_a_second_call_does_nothing(tmp_path):
    folder = tmp_path / "run"
    folder.mkdir()
    lines: list = []
    recipe, run = RECIPES["dual_branches"], standing_in(lines)
    train(recipe, Training(2), folder, pairs=PAIRS, minutes=30, run=run)
    # 900 s each: 80 are spent on 600 pairs, 140 on twice as many more, 380 on thrice all of these,
    # and 300 on what is left, in whole validations.
    assert stages_and_pairs(lines) == [
        ("overlap", 600),
        ("registration", 600),
        *(("overlap", pairs) for pairs in (1800, 5400, 8200)),
        *(("registration", pairs) for pairs in (1800, 5400, 8200)),
    ]
    fields = lines[0]
    assert fields["--config"] == "configs/ablations/dual_branches.py"
    assert fields["--config.train.schedule"] == "constant"
    assert (fields["--config.train.seed"], fields["--config.train.devices"]) == ("2", "1")
    assert fields["--config.train.validate_every"] == "200"  # steps of 2
    assert spent(folder)["cpu_seconds"] == pytest.approx({"overlap": 900, "registration": 900})
    at_the_pairs = json.loads((folder / "pairs.json").read_text())
    assert at_the_pairs["pairs"] == {"overlap": 600, "registration": 600}
    train(recipe, Training(2), folder, pairs=PAIRS, minutes=30, run=pytest.fail)


def test_a_half_of_the_categories_is_trained_for_as_many_pairs_in_a_folder_of_its_own(tmp_path):
    lines: list = []
    half = Training(half=True)
    folder = half.folder(tmp_path, "dcp")
    assert folder == of_data.weights_of("dcp", tmp_path, True).parent
    folder.mkdir()
    train(
        RECIPES["dcp"],
        half,
        folder,
        pairs=400,
        minutes=30,
        points=["pairs"],
        run=standing_in(lines),
    )
    assert lines[0]["--config.data.categories"] == "seen"
    assert float(lines[0]["--config.dcp.epochs"]) == pytest.approx(400 / 313)  # shapes of that half


def test_a_run_that_was_stopped_between_the_points_goes_on(tmp_path):
    lines: list = []
    run = standing_in(lines)
    train(RECIPES["dcp"], Training(), tmp_path, pairs=PAIRS, minutes=30, points=["pairs"], run=run)
    assert stages_and_pairs(lines) == [("dcp", PAIRS)]
    train(RECIPES["dcp"], Training(), tmp_path, pairs=PAIRS, minutes=30, run=run)
    assert [pairs for _, pairs in stages_and_pairs(lines)] == [1200, 3600, 10800, 17200]


def test_what_a_stopped_training_has_used_counts(tmp_path):
    def stop(line):
        (tmp_path / "dcp" / "checkpoints" / "40").mkdir(parents=True)
        raise Stopped(70.0)

    options = {"pairs": PAIRS, "minutes": 30}
    with pytest.raises(Stopped, match="goes on"):
        train(RECIPES["dcp"], Training(), tmp_path, **options, run=stop)
    batch = configuration(RECIPES["dcp"]).stages["dcp"].batch_size
    assert spent(tmp_path) == {"pairs": {"dcp": 40 * batch}, "cpu_seconds": {"dcp": 70.0}}
    with pytest.raises(ValueError, match="train those first"):
        train(RECIPES["dcp"], Training(), tmp_path, **options, points=["minutes"])
    train(RECIPES["dcp"], Training(), tmp_path, **options, run=standing_in(lines := []))
    assert stages_and_pairs(lines)[0] == ("dcp", PAIRS)
    assert spent(tmp_path)["cpu_seconds"]["dcp"] <= 1800


def test_a_training_ends_with_the_process_that_started_it(tmp_path):
    there = tmp_path / "there"
    code = f"import pathlib, time; pathlib.Path({str(there)!r}).touch(); time.sleep(600)"

    def stop_when_there():
        while not there.exists():
            time.sleep(0.01)
        os.kill(os.getpid(), signal.SIGTERM)

    threading.Thread(target=stop_when_there, daemon=True).start()
    with pytest.raises(Stopped) as stopped:
        _cpu_seconds([sys.executable, "-c", code])
    assert stopped.value.seconds > 0


def test_the_minutes_go_on_from_the_pairs(tmp_path):
    both, options = RECIPES["dual_branches"], {"minutes": 30, "points": ["minutes"]}
    with pytest.raises(ValueError, match="train those first"):
        train(both, Training(), tmp_path, pairs=PAIRS, **options)
    half = {"pairs": {"overlap": 600}, "cpu_seconds": {"overlap": 80.0}}
    (tmp_path / "spent.json").write_text(json.dumps(half))  # stopped between the stages
    with pytest.raises(ValueError, match="train those first"):
        train(both, Training(), tmp_path, pairs=PAIRS, **options)


def test_no_minutes_left_are_the_weights_of_the_pairs(tmp_path):
    lines: list = []
    train(RECIPES["dcp"], Training(), tmp_path, pairs=PAIRS, minutes=0, run=standing_in(lines))
    assert stages_and_pairs(lines) == [("dcp", PAIRS)]
    assert (tmp_path / "minutes.npz").read_bytes() == (tmp_path / "pairs.npz").read_bytes()


def test_a_finished_run_from_elsewhere_is_not_trained(tmp_path):
    for name in ("pairs.npz", "minutes.npz"):
        (tmp_path / name).touch()
    train(RECIPES["dcp"], Training(), tmp_path, pairs=PAIRS, minutes=30, run=pytest.fail)
    assert spent(tmp_path) is None


def test_no_pairs_are_affordable_when_the_time_is_up():
    assert affordable(1600, 2.0, 0.0) == affordable(1600, 2.0, 215.0 - 1) == 0
    assert affordable(1600, 2.0, 215.0) == 2000


def test_a_stage_goes_no_further_than_its_rate_is_known():
    assert affordable(1600, 40.0, 1800.0) == 4800
    assert affordable(100, 40.0, 1800.0) == 500  # but one validation always


def test_scores_are_kept_and_only_what_changed_is_scored_again(tmp_path, monkeypatch):
    folder, results, sets = tmp_path / "dcp", tmp_path / "results", {"noise": tiny_set()}
    folder.mkdir()
    save_params(folder / "pairs.npz", init_params(jax.random.key(0), CONFIGS["dcp"]))
    score_runs(["dcp", "omnet"], tmp_path, 3, sets, results)
    assert read_row(results, "omnet") is None
    held = read_row(results, "dcp")
    assert held["measured"]["cpu"] and list(held["seeds"]) == ["0"]
    found = held["seeds"]["0"]["pairs"]["sets"]["noise"]
    assert found["set"] == "cad_test_noise_first_2" and found["all"]["pairs"] == 2
    assert found["plain"]["pairs"] == found["symmetric"]["pairs"] == 1
    assert "overlap" not in found
    monkeypatch.setattr("benchmarks.paper.scoring.figures", lambda *_: {"set": "again"})
    score_runs(["dcp"], tmp_path, 3, sets, results)
    assert read_row(results, "dcp") == held
    save_params(folder / "pairs.npz", init_params(jax.random.key(1), CONFIGS["dcp"]))
    score_runs(["dcp"], tmp_path, 3, sets, results)
    assert read_row(results, "dcp")["seeds"]["0"]["pairs"]["sets"]["noise"] == {"set": "again"}


def test_the_unseen_pairs_are_for_the_weights_of_the_other_half_and_no_others(tmp_path):
    for training, key in ((Training(), 0), (Training(half=True), 1)):
        folder = training.folder(tmp_path, "dcp")
        folder.mkdir()
        save_params(folder / "pairs.npz", init_params(jax.random.key(key), CONFIGS["dcp"]))
    sets = {"noise": tiny_set(), "unseen": tiny_set()}
    score_runs(["dcp"], tmp_path, 1, sets, tmp_path / "results")
    found = read_row(tmp_path / "results", "dcp")["seeds"]
    assert {name: [*row["pairs"]["sets"]] for name, row in found.items()} == {
        "0": ["noise"],
        "seen": ["unseen"],
    }
    of = tables.learned_figures(tmp_path / "results", "dcp", "pairs", "unseen")
    assert of == found["seen"]["pairs"]["sets"]["unseen"]


def test_methods_without_weights_are_scored_on_the_sets_that_lack(tmp_path, monkeypatch):
    identity = {"identity": classical_methods()["identity"]}
    monkeypatch.setattr("benchmarks.paper.scoring.classical_methods", lambda: identity)
    score_classical({"noise": tiny_set()}, tmp_path)
    first_set = read_row(tmp_path, "identity")["sets"]["noise"]
    monkeypatch.setattr("benchmarks.paper.scoring.figures", lambda *_: {"set": "scored"})
    score_classical({"noise": tiny_set(), "unseen": tiny_set()}, tmp_path)
    sets = read_row(tmp_path, "identity")["sets"]
    assert sets == {"noise": first_set, "unseen": {"set": "scored"}}


def summary(error: float) -> dict:
    return {
        "all": {
            "rmse_euler_deg": 1.0,
            "rmse_translation": 0.1,
            "mae_euler_deg": 2.0,
            "mae_translation": 0.2,
            "error_rotation_deg": error,
            "error_translation": 0.3,
        }
    }


def test_the_tables_are_of_what_there_is_and_empty_elsewhere(tmp_path):
    (tmp_path / "icp.json").write_text(json.dumps({"sets": {"noise": summary(38.2)}}))
    for name, errors in (("dcp", [25.5]), ("dgcnn", [40.0, 42.0, 44.0])):
        rows = {str(i): {"pairs": {"sets": {"noise": summary(x)}}} for i, x in enumerate(errors)}
        (tmp_path / f"{name}.json").write_text(json.dumps({"seeds": rows}))
    lines = tables.of_results(tmp_path).splitlines()
    start = lines.index("### noise, the same pairs, the paper's unseen categories, noise beside")
    part = lines[start:]

    def line(begin: str) -> list[str]:
        return next(x for x in part if x.startswith(f"| {begin} |")).strip("| ").split(" | ")

    assert line("DCP")[5:7] == ["25.500", "0.300"] and line("DCP")[-2:] == ["23.184", "0.366"]
    assert line("ICP")[5] == "38.200"
    finet = next(x for x in part if x.startswith("| FINet |"))
    assert finet.endswith("|  |  | 7.748 | 0.117 |")  # nothing of ours
    assert line("1 DGCNN encoder")[1] == "42.000 +- 2.000"
    assert line("1 DGCNN encoder")[-2:] == ["6.716", "0.181"]
    assert tables.spread([3.0], 1) == "3.0" and tables.spread([], 1) == ""


def test_a_data_sets_tables_are_of_the_weights_that_lie_there(tmp_path, monkeypatch):
    monkeypatch.setattr(of_data, "_load", lambda config, runs: tiny_set())
    identity = {"identity": classical_methods()["identity"]}
    monkeypatch.setattr(of_data, "classical_methods", lambda: identity)
    folder = Training().folder(tmp_path, "dcp")
    folder.mkdir()
    save_params(folder / "params.npz", init_params(jax.random.key(0), CONFIGS["dcp"]))
    config = configuration(RECIPES["cad"])
    text = of_data.tables(config, ["dcp", "finet", "dgcnn"], tmp_path, 1)
    titles = [line[4:] for line in text.splitlines() if line.startswith("### ")]
    assert titles == [*of_data.SHAPE_TABLES, "Overlap", "Ablation"]
    rows = [line.split(" | ") for line in text.splitlines() if line.startswith("| DCP")]
    trained = [all(cell for cell in row[1:7]) for row in rows]
    assert trained == [True, False, True, False]  # none was trained on a half of the categories
    assert rows[-1][-6:] == ["16.532", "0.249", "12.022", "0.181", "23.184", "0.366 |"]


def test_public_weights_are_told_by_their_name(tmp_path):
    with pytest.raises(ValueError, match="named after one of dbdnet, dcp, rienet.*got mine.t7"):
        public.public_params(tmp_path / "mine.t7")
    with pytest.raises(ValueError, match="must be a folder with .t7 files"):
        public.tables(tmp_path, {})


# The first 20 pairs: measured, as the whole set takes a minute each. RIENet's wrong answers hang on
# rounding: float64 moves one in twelve by more than 5 degrees, and the mean of 20 by several.
@pytest.mark.skipif(
    not (WEIGHTS / "dcp_v1.t7").exists(), reason="needs ../shared/peers/weights, the authors' files"
)
@pytest.mark.parametrize(
    ("name", "error", "within"), [("dcp_v1", 107.8, 1.0), ("rienet_modelnet-unseen", 126.8, 12.0)]
)
def test_public_weights_fail_on_our_pairs_as_was_recorded(tmp_path, name, error, within):
    (tmp_path / f"{name}.t7").symlink_to(WEIGHTS / f"{name}.t7")
    row = public.tables(tmp_path, {"noise": tiny_set(20)}).splitlines()[-1].split(" | ")
    assert float(row[1]) == pytest.approx(error, abs=within)
