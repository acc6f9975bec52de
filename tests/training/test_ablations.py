"""The paper's ablations are trained by the same loop; each kind's loss falls."""

import csv
import dataclasses
import itertools

import jax
import numpy as np
import optax
import pytest

from dbdnet_jax.data.training_pairs import PairStream, pairs_of_shapes
from dbdnet_jax.training.config import read_config
from dbdnet_jax.training.loop import fit
from dbdnet_jax.training.losses import JointTerms
from dbdnet_jax.training.run_folder import load_best
from dbdnet_jax.training.table import STAGES
from dbdnet_jax.training.task import RunConfig
from tests import stand_in
from tests.conftest import EXACT, assert_close, assert_finite
from tests.ladder import LADDER, small_step
from train import stages_of

QUICK = {"encoder": "dgcnn", "shared_blocks": 0}  # to compile


def config(name: str, model: dict = QUICK, **changes: object) -> RunConfig:
    """Six steps of two pairs."""
    config = LADDER[name].get_config()
    model = small_step(name, neighbours=4, dropout=0.1, **model)
    config.model.update(dataclasses.asdict(model))
    stand_in.six_steps(config)
    config.registration.epochs = 3.0
    for field, value in changes.items():
        config.registration[field] = value
    return read_config(config)


def source() -> PairStream:
    """The same two pairs in every step, so that six steps show."""
    shapes = stand_in.shapes(count=4, points=64)
    protocol = config("dgcnn").protocol
    pairs = pairs_of_shapes(shapes, shapes, protocol, seed=0, validation_pairs=2)
    return pairs._replace(
        draw=lambda key, number, arrays: pairs.draw(
            jax.random.fold_in(jax.random.key(1), number % 2), number % 2, arrays
        )
    )


@pytest.mark.slow
def test_a_single_network_is_trained_alone_and_a_stopped_run_ends_as_an_unbroken_one(tmp_path):
    settings, pairs = config("dgcnn"), source()
    fit(settings, "registration", tmp_path / "whole", pairs)
    stopping = pairs._replace(arrays=lambda start: itertools.islice(pairs.arrays(start), 3))
    with pytest.raises(StopIteration):
        fit(settings, "registration", tmp_path / "stopped", stopping)
    fit(settings, "registration", tmp_path / "stopped", pairs)
    found, expected = (load_best(tmp_path / name).networks for name in ("stopped", "whole"))
    assert list(found) == ["registration"]
    jax.tree.map(lambda a, b: assert_close(a, b, EXACT), found, expected)
    with (tmp_path / "whole" / "registration" / "train.csv").open() as file:
        losses = [float(row["loss"]) for row in csv.DictReader(file)]
    assert len(losses) == 3 and losses[-1] < losses[0]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "masks"), [("joint_overlap", "predicted"), ("prior_overlap", "truth")]
)
def test_a_few_steps_lower_the_loss(tmp_path, name, masks):
    task = STAGES["dbdnet"]["registration"].make_task(config(name, masks=masks), tmp_path)
    assert task.frozen is None
    pair = jax.tree.map(lambda leaf: leaf[0], source().validation)
    optimizer = optax.adam(3e-3)

    @jax.jit
    def step(trainable, state):
        (loss, terms), gradient = jax.value_and_grad(task.loss, has_aux=True)(
            trainable, task.frozen, pair, jax.random.key(2)
        )
        updates, state = optimizer.update(gradient, state)
        return optax.apply_updates(trainable, updates), state, loss, terms, gradient

    trainable, state, losses = task.trainable, optimizer.init(task.trainable), []
    for _ in range(6):
        trainable, state, loss, terms, gradient = step(trainable, state)
        assert np.isclose(sum(terms), loss, rtol=1e-5)
        assert_finite(gradient)
        losses.append(float(loss))
    assert losses[-1] < losses[0]
    if name == "joint_overlap":
        assert isinstance(terms, JointTerms) and terms.source_focal > 0
        head = jax.tree.leaves(gradient["overlap_head"])
        assert all(np.any(leaf) for leaf in head)
        figures = jax.eval_shape(task.validate, trainable, task.frozen, pair)
        assert "overlap_error" in figures


@pytest.mark.parametrize("name", LADDER)
def test_all_stages_are_those_of_the_networks_there_are(name):
    settings = config(name)
    prior = settings.model.overlap == "prior"
    assert stages_of(settings, "all") == (("overlap",) if prior else ()) + ("registration",)


@pytest.mark.parametrize("stage", ["overlap", "joint"])
def test_a_stage_with_nothing_to_train_says_so(tmp_path, stage):
    with pytest.raises(ValueError, match=f"the {stage} stage trains an overlap network.*'none'"):
        fit(config("dgcnn"), stage, tmp_path, source())
    assert not any(tmp_path.iterdir())


def test_masks_of_the_truth_are_for_a_prior_overlap_alone(tmp_path):
    with pytest.raises(ValueError, match="masks must be 'predicted' unless .* got 'truth' for 'jo"):
        fit(config("joint_overlap", masks="truth"), "registration", tmp_path, source())
