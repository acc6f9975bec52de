"""Both stages with a tiny network, on shapes that the test makes."""

import csv
import dataclasses
import itertools

import jax
import numpy as np
import pytest

from configs import cad
from dbdnet_jax.data.training_pairs import PairStream, pairs_of_shapes
from dbdnet_jax.errors import CheckpointError
from dbdnet_jax.networks.params import Params
from dbdnet_jax.networks.weights import save_params
from dbdnet_jax.training.checkpoint import Checkpoints
from dbdnet_jax.training.config import read_config, stage_record
from dbdnet_jax.training.loop import fit
from dbdnet_jax.training.losses import JointTerms
from dbdnet_jax.training.run_folder import load_best, write_stage
from dbdnet_jax.training.table import STAGES
from dbdnet_jax.training.task import RunConfig, Task
from tests import stand_in, stand_in_train
from tests.conftest import EXACT, Tolerance, assert_close, assert_finite


def config() -> RunConfig:
    """Six steps of two pairs for each stage."""
    config = cad.get_config()
    config.model.overlap_channels = config.model.registration_channels = 4
    config.model.overlap_blocks = 1
    config.model.encoder = "dgcnn"  # compiles in a fifth of the time
    config.model.branches, config.model.shared_blocks = 1, 0
    config.model.overlap_passes = 1  # more start from another random motion in every step
    config.model.heads = 2
    config.model.neighbours = 4
    config.model.min_points = 12
    config.model.dropout = 0.1
    config.model.local_geometry = 0
    stand_in.six_steps(config)
    config.overlap.epochs = config.registration.epochs = config.joint.epochs = 3.0
    config.registration.masks = "predicted"
    return read_config(config)


CONFIG = config()


def make_task(config: RunConfig, stage: str, run_dir) -> Task:
    return STAGES["dbdnet"][stage].make_task(config, run_dir)


def source() -> PairStream:
    """The same two pairs in every step, so that six steps show."""
    shapes = stand_in.shapes(count=4, points=64)
    pairs = pairs_of_shapes(shapes, shapes, CONFIG.protocol, seed=0, validation_pairs=2)
    return pairs._replace(
        draw=lambda key, number, arrays: pairs.draw(
            jax.random.fold_in(jax.random.key(1), number % 2), number % 2, arrays
        )
    )


def losses(folder) -> list[float]:
    with (folder / "train.csv").open() as file:
        return [float(row["loss"]) for row in csv.DictReader(file)]


@pytest.fixture(scope="module")
def run_dir(tmp_path_factory):
    """A run of both stages."""
    folder = tmp_path_factory.mktemp("run")
    for stage in ("overlap", "registration"):
        fit(CONFIG, stage, folder, source())
    return folder


@pytest.mark.parametrize("stage", ["overlap", "registration"])
def test_some_steps_lower_the_loss(run_dir, stage):
    curve = losses(run_dir / stage)
    assert len(curve) == 3 and curve[-1] < curve[0]


def test_the_second_stage_leaves_the_first_one_alone(run_dir):
    params = load_best(run_dir)
    assert params.config == CONFIG.model
    assert_finite((params.overlap, params.registration))
    with Checkpoints(run_dir / "overlap") as checkpoints:
        trained = checkpoints.restore_weights(checkpoints.best_step())
    jax.tree.map(lambda a, b: assert_close(a, b, EXACT), params.overlap, trained)


def test_a_stopped_second_stage_ends_as_an_unbroken_one(run_dir, tmp_path):
    (tmp_path / "overlap").symlink_to(run_dir / "overlap")
    pairs = source()
    stopping = pairs._replace(arrays=lambda start: itertools.islice(pairs.arrays(start), 3))
    with pytest.raises(StopIteration):
        fit(CONFIG, "registration", tmp_path, stopping)
    fit(CONFIG, "registration", tmp_path, pairs)
    found, expected = (load_best(folder).registration for folder in (tmp_path, run_dir))
    jax.tree.map(lambda a, b: assert_close(a, b, EXACT), found, expected)
    for name in ("registration/train.csv", "registration/validation.csv"):
        assert (tmp_path / name).read_bytes() == (run_dir / name).read_bytes()


@pytest.mark.slow
@pytest.mark.parametrize("stage", ["overlap", "registration"])
def test_networks_of_several_passes_go_on_from_weights(run_dir, tmp_path, stage):
    weights = tmp_path / "weights.npz"
    save_params(weights, load_best(run_dir))
    config = dataclasses.replace(
        CONFIG,
        model=dataclasses.replace(CONFIG.model, overlap_passes=2),
        train=dataclasses.replace(CONFIG.train, start=str(weights)),
    )
    config = config.with_stage("overlap", learning_rate=1e-5)
    config = config.with_stage("registration", learning_rate=1e-5, masks="perturbed")
    fit(config, stage, tmp_path, source())
    found, start = (getattr(load_best(folder), stage) for folder in (tmp_path, run_dir))
    jax.tree.map(lambda a, b: assert_close(a, b, Tolerance(rtol=0.0, atol=1e-3)), found, start)
    moved = jax.tree.leaves(jax.tree.map(lambda a, b: bool((a != b).any()), found, start))
    assert np.mean(moved) > 0.9


def test_weights_that_see_coordinates_only_go_on_with_local_geometry(run_dir, tmp_path):
    weights = tmp_path / "weights.npz"
    start = load_best(run_dir)
    save_params(weights, start)
    settings = dataclasses.replace(
        CONFIG,
        model=dataclasses.replace(CONFIG.model, local_geometry=2),
        train=dataclasses.replace(CONFIG.train, start=str(weights)),
    )
    task = make_task(settings, "overlap", tmp_path)
    kernel = task.trainable["encoder"]["stage1_conv1"]["conv_0"]["kernel"]
    before = start.overlap["encoder"]["stage1_conv1"]["conv_0"]["kernel"]
    assert kernel.shape[0] == before.shape[0] + 2 * 16
    assert_close(kernel[:3], before[:3], EXACT)
    assert_close(kernel[19:22], before[3:], EXACT)
    assert not kernel[3:19].any() and not kernel[22:].any()


def test_a_constant_rate_lets_a_run_be_prolonged(tmp_path, monkeypatch):
    quick = STAGES["dbdnet"]["overlap"]._replace(make_task=stand_in_train.task)
    monkeypatch.setitem(STAGES["dbdnet"], "overlap", quick)
    train = dataclasses.replace(CONFIG.train, schedule="constant", decay_epochs=1.0)
    settings = dataclasses.replace(CONFIG, train=train)
    longer = settings.with_stage("overlap", epochs=4.0)
    fit(settings, "overlap", tmp_path, source())
    fit(longer, "overlap", tmp_path, source())
    rows = (tmp_path / "overlap" / "train.csv").read_text().splitlines()
    assert rows[-1].startswith("8,")


def test_a_start_must_be_there(tmp_path):
    train = dataclasses.replace(CONFIG.train, start=str(tmp_path / "gone.npz"))
    with pytest.raises(FileNotFoundError, match="there is none at .*gone.npz. Give its path, or"):
        fit(dataclasses.replace(CONFIG, train=train), "overlap", tmp_path, source())


def test_weights_of_another_width_are_no_start(run_dir, tmp_path):
    weights = tmp_path / "weights.npz"
    save_params(weights, load_best(run_dir))
    config = dataclasses.replace(
        CONFIG,
        model=dataclasses.replace(CONFIG.model, overlap_channels=8),
        train=dataclasses.replace(CONFIG.train, start=str(weights)),
    )
    with pytest.raises(CheckpointError, match="misshapen: overlap/.*config.train.start=''"):
        fit(config, "overlap", tmp_path, source())


def test_a_shape_with_nan_stops_the_overlap_stage(tmp_path):
    pairs = source()
    points = np.array(next(pairs.arrays(0)))
    points[:] = np.nan
    with pytest.raises(FloatingPointError, match="'source_focal' is nan in the step after step 0"):
        fit(CONFIG, "overlap", tmp_path, pairs._replace(arrays=lambda _: itertools.repeat(points)))


@pytest.mark.slow
def test_the_joint_stage_trains_both_networks_further(run_dir, tmp_path):
    weights = tmp_path / "weights.npz"
    save_params(weights, load_best(run_dir))
    config = dataclasses.replace(
        CONFIG,
        model=dataclasses.replace(CONFIG.model, overlap_passes=2),
        train=dataclasses.replace(
            CONFIG.train, start=str(weights), clip_norm=1.0, weight_decay=0.0
        ),
    )
    pairs = source()
    stopping = pairs._replace(arrays=lambda start: itertools.islice(pairs.arrays(start), 3))
    with pytest.raises(StopIteration):
        fit(config, "joint", tmp_path / "run", stopping)
    fit(config, "joint", tmp_path / "run", pairs)
    start = load_best(run_dir)
    with Checkpoints(tmp_path / "run" / "joint") as checkpoints:
        found = Params(checkpoints.restore_weights(6), config.model)
    for before, after in ((start.overlap, found.overlap), (start.registration, found.registration)):
        moved = jax.tree.leaves(jax.tree.map(lambda a, b: bool((a != b).any()), before, after))
        assert np.mean(moved) > 0.9
    with (tmp_path / "run" / "joint" / "train.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [row["step"] for row in rows] == ["2", "4", "6"]
    for row in rows:
        terms = [float(value) for name, value in row.items() if name in JointTerms._fields]
        assert len(terms) == 7 and float(row["loss"]) == pytest.approx(sum(terms), rel=1e-4)
    with (tmp_path / "run" / "joint" / "validation.csv").open() as file:
        assert [row["step"] for row in csv.DictReader(file)] == ["0", "6"]


def test_the_joint_stage_goes_on_from_the_run_and_then_is_what_the_run_holds(run_dir, tmp_path):
    for stage in ("overlap", "registration"):
        (tmp_path / stage).symlink_to(run_dir / stage)
    task = make_task(CONFIG, "joint", tmp_path)
    trained = load_best(run_dir)
    further = jax.tree.map(lambda leaf: leaf + 1, task.trainable)
    with Checkpoints(tmp_path / "joint") as checkpoints:
        checkpoints.save(6, {"params": further}, error=1.0)
    write_stage(tmp_path / "joint", stage_record(CONFIG, "joint"))
    again, held = make_task(CONFIG, "joint", tmp_path), load_best(tmp_path)
    for name in ("overlap", "registration"):
        for found in (task.trainable[name], again.trainable[name]):
            jax.tree.map(lambda a, b: assert_close(a, b, EXACT), found, getattr(trained, name))
        jax.tree.map(lambda a, b: assert_close(a, b, EXACT), getattr(held, name), further[name])


def test_networks_that_do_not_take_turns_can_be_trained_jointly_too(run_dir):
    task, key = make_task(CONFIG, "joint", run_dir), jax.random.key(0)
    pair = jax.tree.map(lambda leaf: leaf[0], source().validation)
    shape = jax.eval_shape(
        jax.grad(task.loss, has_aux=True), task.trainable, task.frozen, pair, key
    )[0]
    assert jax.tree.map(lambda leaf: leaf.shape, shape) == jax.tree.map(
        lambda leaf: leaf.shape, task.trainable
    )


def test_the_frozen_network_of_registration_is_never_the_joint_one(run_dir, tmp_path):
    (tmp_path / "overlap").symlink_to(run_dir / "overlap")
    params = load_best(run_dir)
    other = jax.tree.map(
        lambda leaf: leaf + 1, {"overlap": params.overlap, "registration": params.registration}
    )
    with Checkpoints(tmp_path / "joint") as checkpoints:
        checkpoints.save(6, {"params": other}, error=1.0)
    write_stage(tmp_path / "joint", stage_record(CONFIG, "joint"))
    frozen = make_task(CONFIG, "registration", tmp_path).frozen
    jax.tree.map(lambda a, b: assert_close(a, b, EXACT), frozen, params.overlap)


def test_the_joint_stage_needs_both_networks(run_dir, tmp_path):
    weights = tmp_path / "weights.npz"
    params = load_best(run_dir)
    save_params(weights, params.replace(networks={"overlap": params.overlap}))
    train = dataclasses.replace(CONFIG.train, start=str(weights))
    with pytest.raises(CheckpointError, match=r"weights\.npz does not hold both. Train them in"):
        fit(dataclasses.replace(CONFIG, train=train), "joint", tmp_path, source())
    with pytest.raises(CheckpointError, match="two trained networks; .*--stage=both"):
        fit(CONFIG, "joint", tmp_path, source())
    (tmp_path / "overlap").symlink_to(run_dir / "overlap")
    with pytest.raises(CheckpointError, match="two trained networks; .*config.train.start=FILE"):
        fit(CONFIG, "joint", tmp_path, source())


def test_a_stage_of_another_model_is_refused_before_it_trains(run_dir, tmp_path):
    (tmp_path / "overlap").symlink_to(run_dir / "overlap")
    config = CONFIG.with_stage("registration", masks="perturbed")
    config = dataclasses.replace(config, model=dataclasses.replace(config.model, min_points=13))
    with pytest.raises(CheckpointError, match=r"overlap has model\.min_points = 12, .* 13\. Give"):
        fit(config, "registration", tmp_path, source())
    assert not (tmp_path / "registration").exists()


def test_a_batch_that_cannot_be_shared_leaves_nothing_that_refuses_the_advice(
    tmp_path, monkeypatch
):
    quick = STAGES["dbdnet"]["overlap"]._replace(make_task=stand_in_train.task)
    monkeypatch.setitem(STAGES["dbdnet"], "overlap", quick)
    train = dataclasses.replace(CONFIG.train, devices=2)
    config = dataclasses.replace(CONFIG, train=train).with_stage("overlap", epochs=1.0)
    with pytest.raises(ValueError, match="divisible by the 2 devices.*Use a batch_size of 2"):
        fit(config.with_stage("overlap", batch_size=3), "overlap", tmp_path, source())
    fit(config.with_stage("overlap", batch_size=2), "overlap", tmp_path, source())
    assert (tmp_path / "overlap" / "stage.json").is_file()


def test_registration_needs_the_overlap_network(tmp_path):
    with pytest.raises(CheckpointError, match="--stage=overlap or both"):
        fit(CONFIG, "registration", tmp_path, source())
