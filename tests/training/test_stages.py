"""What DBDNet's stages do, each alone, with the networks replaced by what a test needs."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dbdnet_jax.data.pairs import Protocol, initial_pose, make_pair
from dbdnet_jax.networks.dbdnet.config import ModelConfig
from dbdnet_jax.ops import rigid
from dbdnet_jax.training import dbdnet
from dbdnet_jax.training.dbdnet import RegistrationConfig
from dbdnet_jax.types import Branch, Registration, Rigid
from tests.conftest import EXACT, FLOAT32, assert_close, random_cloud

SIZE, KEYS = 16, 40
MODEL = ModelConfig(overlap_matching=True, overlap_passes=3, dropout=0.0)
ONE_PASS = dataclasses.replace(MODEL, overlap_passes=1)


@pytest.fixture(scope="module")
def pair():
    points = jnp.asarray(random_cloud(0, 64), jnp.float32)
    return make_pair(jax.random.key(0), points, points, Protocol(points=SIZE, keep=1.0))


def shift(*translation: float) -> Rigid:
    return Rigid(jnp.eye(3), jnp.asarray(translation, jnp.float32))


def registration(motion: Rigid) -> Registration:
    """An answer with this motion."""
    ones = jnp.ones(SIZE)
    branch = Branch(jnp.zeros((SIZE, SIZE)), jnp.zeros((SIZE, 3)), ones)
    return Registration(*motion, ones, ones, ones > 0, ones > 0, branch, branch, ones, ones[0] > 0)


@pytest.fixture
def calls(monkeypatch):
    """The starts and models that both networks are asked with; they say that all overlaps."""
    seen = {"start": [], "solves": [], "keys": []}

    def overlap(params, source, target, dropout_key=None, start=None):
        seen["start"].append(start)
        seen["keys"].append(dropout_key)
        return jnp.ones(SIZE), jnp.ones(SIZE), None

    def register(
        params, source, target, source_overlap, target_overlap, dropout_key=None, solves=None
    ):
        seen["solves"].append(solves)
        seen["keys"].append(dropout_key)
        return registration(shift(0.0, 1.0, 0.0))

    monkeypatch.setattr(dbdnet, "predict_overlap_and_matches", overlap)
    monkeypatch.setattr(dbdnet, "register_given_overlap", register)
    return seen


def keys():
    return list(jax.random.split(jax.random.key(3), KEYS))


def test_each_pass_of_the_overlap_network_starts_from_a_pose_of_every_quality(pair, calls):
    for key in keys():
        dbdnet.overlap_loss_of(MODEL, 0.0, {}, None, pair, key)
    for start, key in zip(calls["start"], keys(), strict=True):
        expected = initial_pose(jax.random.split(key)[0], pair)
        jax.tree.map(lambda a, b: assert_close(a, b, FLOAT32), start, expected)
    blind = [bool((start.rotation == jnp.eye(3)).all()) for start in calls["start"]]
    assert 5 < sum(blind) < KEYS - 5


def test_one_pass_starts_from_nothing(pair, calls):
    dbdnet.overlap_loss_of(ONE_PASS, 0.0, {}, None, pair, jax.random.key(0))
    assert calls["start"] == [None]


@pytest.mark.parametrize(("model", "starts"), [(MODEL, True), (ONE_PASS, False)])
def test_each_turn_of_registration_is_trained_for_itself(pair, calls, monkeypatch, model, starts):
    judged = []

    def fake_loss(answer, pair, weights):
        judged.append(pair)
        return jnp.zeros(()), None

    monkeypatch.setattr(dbdnet, "registration_loss", fake_loss)
    stage = RegistrationConfig(masks="predicted")
    key = jax.random.key(5)
    dbdnet.registration_loss_of(model, stage, 0.1, {}, {}, pair, key)
    assert calls["solves"] == [None]
    truth = pair.target_from_source
    if starts:
        start = initial_pose(jax.random.split(key, 3)[1], pair)
        jax.tree.map(lambda a, b: assert_close(a, b, FLOAT32), calls["start"][0], start)
        truth = rigid.compose(truth, rigid.invert(start))  # that is left
    found = judged[0].target_from_source
    jax.tree.map(lambda a, b: assert_close(a, b, FLOAT32), found, truth)


def test_validation_solves_as_often_as_an_answer_does(pair, calls):
    stage = RegistrationConfig(masks="perturbed")
    found = dbdnet.validate_registration(MODEL, stage, {}, None, pair)
    assert calls["solves"] == [MODEL.overlap_passes]
    assert set(found) == {"error", "translation_error", "loss"}


def test_half_of_the_joint_starts_are_the_networks_own(pair, calls, monkeypatch):
    monkeypatch.setattr(dbdnet, "initial_pose", lambda key, pair: shift(1.0, 0.0, 0.0))
    start = jax.jit(
        lambda start_key, choice_key: dbdnet.joint_start(MODEL, {}, pair, start_key, choice_key)
    )
    found = np.stack([start(key, key).translation for key in keys()])
    own = (found == np.array([1.0, 1.0, 0.0])).all(axis=1)
    assert_close(found[~own], np.tile([1.0, 0.0, 0.0], (sum(~own), 1)), EXACT)
    assert KEYS / 4 < sum(own) < 3 * KEYS / 4


@pytest.mark.parametrize(("model", "expected"), [(MODEL, True), (ONE_PASS, False)])
def test_joint_turns_begin_at_joint_starts(pair, calls, monkeypatch, model, expected):
    begun = shift(0.5, 0.0, 0.0)
    monkeypatch.setattr(dbdnet, "joint_start", lambda *_: begun)
    loss, terms = dbdnet.joint_loss_of(
        model, 0.0, dbdnet.LossWeights(), {}, None, pair, jax.random.key(0)
    )
    assert calls["start"] == [begun if expected else None] and calls["solves"] == [None]
    assert_close(loss, sum(terms), FLOAT32)


def test_the_networks_of_a_joint_turn_drop_weights_of_their_own(pair, calls):
    dbdnet.joint_turn(ONE_PASS, {}, pair, None, jax.random.key(0))
    overlap, registration = map(jax.random.key_data, calls["keys"])
    assert (overlap != registration).any()
