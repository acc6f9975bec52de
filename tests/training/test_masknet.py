"""A second method through the whole house: trained, stopped, resumed, saved, loaded, tabled."""

import dataclasses
import itertools
import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from configs.peers import masknet_cad
from dbdnet_jax.data.training_pairs import PairStream, pairs_of_shapes
from dbdnet_jax.errors import CheckpointError
from dbdnet_jax.evaluation.methods import Weights, learned_methods, make_methods
from dbdnet_jax.evaluation.run import Evaluation, constant_overlap, evaluate_method
from dbdnet_jax.evaluation.tables import render
from dbdnet_jax.networks.initial import init_params
from dbdnet_jax.networks.masknet.network import predict
from dbdnet_jax.networks.weights import load_params, save_params
from dbdnet_jax.training.checkpoint import Checkpoints
from dbdnet_jax.training.config import read_config
from dbdnet_jax.training.loop import fit
from dbdnet_jax.training.masknet import masknet_task
from dbdnet_jax.training.run_folder import load_best
from dbdnet_jax.types import Pair
from tests import stand_in
from tests.conftest import EXACT, assert_close


def config():
    """Six steps of four pairs."""
    config = masknet_cad.get_config()
    config.model.encoder, config.model.head = (8, 16), (16,)
    config.protocol.points = 32
    config.train.log_every = config.train.checkpoint_every = 2
    config.train.validate_every = 6
    config.train.validation_pairs = 2
    config.masknet.epochs, config.masknet.batch_size = 6.0, 4
    config.masknet.learning_rate = 3e-3
    return read_config(config)


CONFIG = config()


def source() -> PairStream:
    """The same four pairs in every step, so that six steps show."""
    shapes = stand_in.shapes(count=4, points=32)
    pairs = pairs_of_shapes(shapes, shapes, CONFIG.protocol, seed=0, validation_pairs=2)
    return pairs._replace(
        draw=lambda key, number, arrays: pairs.draw(
            jax.random.fold_in(jax.random.key(1), number % 4), number % 4, arrays
        )
    )


@pytest.fixture(scope="module")
def run_dir(tmp_path_factory):
    folder = tmp_path_factory.mktemp("run")
    fit(CONFIG, "masknet", folder, source())
    return folder


def test_it_learns_and_its_averages_move(run_dir):
    rows = np.genfromtxt(run_dir / "masknet" / "train.csv", delimiter=",", names=True)
    assert rows.dtype.names[:3] == ("step", "mask", "loss") and rows["loss"][-1] < rows["loss"][0]
    np.testing.assert_allclose(rows["learning_rate"], 3e-3)  # constant
    norm = load_best(run_dir).networks["masknet"]["encoder_0"]["batch_norm"]
    assert np.abs(norm["mean"]).max() > 0 and np.abs(norm["variance"] - 1).max() > 0
    record = json.loads((run_dir / "masknet" / "stage.json").read_text())
    assert record["method"] == "masknet" and record["train"]["optimizer"] == "adam"


def test_a_stopped_run_ends_as_an_unbroken_one(run_dir, tmp_path):
    pairs = source()
    stopping = pairs._replace(arrays=lambda start: itertools.islice(pairs.arrays(start), 3))
    with pytest.raises(StopIteration):
        fit(CONFIG, "masknet", tmp_path, stopping)
    fit(CONFIG, "masknet", tmp_path, pairs)
    found, expected = (load_best(folder).networks for folder in (tmp_path, run_dir))
    jax.tree.map(lambda a, b: assert_close(a, b, EXACT), found, expected)
    for name in ("masknet/train.csv", "masknet/validation.csv"):
        assert (tmp_path / name).read_bytes() == (run_dir / name).read_bytes()


def test_its_weights_come_back_and_can_be_gone_on_from(run_dir, tmp_path):
    params = load_best(run_dir)
    path = tmp_path / "masknet.npz"
    save_params(path, params)
    loaded = load_params(path)
    assert loaded.config == CONFIG.model and hash(loaded.config) == hash(CONFIG.model)
    jax.tree.map(lambda a, b: assert_close(a, b, EXACT), loaded.networks, params.networks)
    header = json.loads(str(np.load(path)["header"]))
    assert header["method"] == "masknet"
    train = dataclasses.replace(CONFIG.train, start=str(path))
    task = masknet_task(dataclasses.replace(CONFIG, train=train), tmp_path)
    mean = params.networks["masknet"]["encoder_1"]["batch_norm"]["mean"]
    assert_close(task.batch_stats["encoder_1"]["batch_norm"]["mean"], mean, EXACT)


def test_a_run_of_two_methods_is_refused(run_dir, tmp_path):
    (tmp_path / "masknet").symlink_to(run_dir / "masknet")
    (tmp_path / "overlap").mkdir()
    (tmp_path / "overlap" / "stage.json").write_text("{}")
    with pytest.raises(CheckpointError, match="must train one method.*'overlap': 'dbdnet'"):
        load_best(tmp_path)


def test_validation_and_answers_use_the_folded_network(run_dir):
    params = load_best(run_dir)
    pairs = jax.device_get(source().validation)
    rows = np.genfromtxt(run_dir / "masknet" / "validation.csv", delimiter=",", names=True)
    wrong = points = 0
    for i in range(2):
        pair = jax.tree.map(lambda leaf, i=i: jnp.asarray(leaf[i]), pairs)
        answer = predict(params, pair.source, pair.target)
        for found, label in (
            (answer.source_overlap, pair.source_overlap),
            (answer.target_overlap, pair.target_overlap),
        ):
            wrong += int(np.sum((np.asarray(found) > 0.5) != label))
            points += len(label)
    assert float(np.atleast_1d(rows["error"])[-1]) == pytest.approx(wrong / points, abs=1e-6)


def test_its_rows_fill_the_overlap_columns_only(run_dir):
    pairs: Pair = jax.device_get(source().validation)
    methods = learned_methods(load_best(run_dir), "MaskNet", seed=0)
    assert [(m.name, m.traits.untrained) for m in methods] == [
        ("MaskNet (untrained)", True),
        ("MaskNet", False),
    ]
    rows = [evaluate_method(method, pairs) for method in methods]
    for row in rows:
        assert row.summary is None and row.errors is None and row.overlap is not None
        assert row.seconds_per_pair > 0 and row.traits.learned
    text = render(Evaluation(rows, constant_overlap(pairs), "set", 2, "a1", 0, "command", "cpu"))
    motion, overlap = text.split("overlap prediction")
    line = next(line for line in motion.splitlines() if line.startswith("MaskNet  "))
    assert line.split()[1:-1] == ["-"] * 10
    assert "MaskNet" in overlap


def test_the_state_of_the_best_step_holds_the_averages(run_dir):
    with Checkpoints(run_dir / "masknet") as checkpoints:
        tree = checkpoints.restore_weights(checkpoints.best_step())
    assert tree["encoder_0"]["batch_norm"].keys() == {"scale", "bias", "mean", "variance"}


def test_several_weights_of_one_method_are_told_apart():
    params = init_params(jax.random.key(0), CONFIG.model)
    names = [m.name for m in make_methods([Weights("a", params), Weights("b", params)], seed=0)]
    assert names[-4:] == [
        "MaskNet (a) (untrained)", "MaskNet (a)", "MaskNet (b) (untrained)", "MaskNet (b)",
    ]  # fmt: skip
