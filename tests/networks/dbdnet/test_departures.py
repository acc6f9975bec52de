"""Where `released` chooses between the authors' code and the paper (docs/fidelity.md)."""

import dataclasses
import re
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from configs import modelnet
from dbdnet_jax.networks.dbdnet import iterations as solving
from dbdnet_jax.networks.dbdnet.register import predict_overlap, register_given_overlap
from dbdnet_jax.networks.dbdnet.registration import Matches
from dbdnet_jax.networks.params import Params
from dbdnet_jax.ops.sampling import farthest_order
from dbdnet_jax.training import dbdnet as stages
from dbdnet_jax.training import dbdnet_tasks
from dbdnet_jax.training.config import read_config
from dbdnet_jax.types import Pair
from tests import oracle
from tests.conftest import assert_close, random_cloud
from tests.networks.dbdnet.small import NETWORK, SMALL, small_params, whole

N = 32
SOURCE, TARGET = random_cloud(0, N) + 0.5, random_cloud(1, N) - 0.2
MASKS = (np.arange(N) % 4 != 1) * 1.0, (np.arange(N) % 5 != 2) * 1.0
ROWS, COLUMNS = (np.flatnonzero(mask) for mask in MASKS)
CLOUDS = [whole(np.float32(x)) for x in (SOURCE, TARGET)]
RATE = 0.3  # of dropout
TESTS = Path(__file__).parents[2]
PAGE = TESTS.parent / "docs" / "fidelity.md"


def matches(points, features, valid):
    """Two matrices that depend on places and on features; rows sum to less than one."""
    distance = sum(((x[0][:, None] - x[1][None]) ** 2).sum(-1) for x in (points, features))
    weights = [valid * 2.0 ** (-sharpness * distance) for sharpness in (1.0, 3.0)]
    return [w / (0.1 + w.sum(1, keepdims=True)) for w in weights]


class StandIn:
    """`matches` in the place of the registration network; a feature is where a point is."""

    encoded: list = []

    def __init__(self, config):
        """As the network."""

    def apply(self, variables, clouds, second, key=None, method=""):
        """Encode (the second argument is the rows of query-down) or match (the features)."""
        if method == "encode":
            self.encoded.append(second)
            return clouds.points
        row, column = (jnp.arange(clouds.points.shape[1]) < count for count in clouds.count)
        valid = (row[:, None] & column[None]).astype(clouds.points.dtype)
        return Matches(jnp.stack(matches(clouds.points, second, valid)), clouds.valid, None)


def registered(released: bool, iterations: int):
    """Last increment and composed motion (4, 4), and the last soft targets of both branches."""
    source, target, features = SOURCE[ROWS], TARGET[COLUMNS], None
    composed = np.eye(4)
    for _ in range(iterations):
        still = np.zeros(3)
        centres = (still, still) if released else (source.mean(0), target.mean(0))
        x, y = source - centres[0], target - centres[1]
        features = (x, y) if features is None or not released else features
        soft, solved = [], []
        for matrix in matches((x, y), features, 1.0):
            mass = matrix.sum(1)
            soft.append(matrix @ y if released else matrix @ y / mass[:, None])
            solved.append(oracle.procrustes(x, soft[-1], mass**0 if released else mass))
        rotation, translation = solved[0][0], solved[1][1]
        translation = translation + centres[1] - rotation @ centres[0]
        last = oracle.homogeneous(rotation, translation)
        composed = last @ composed
        source = source @ rotation.T + translation
    return last, composed, np.stack(soft) + centres[1]


@pytest.mark.parametrize("iterations", [1, 2])
@pytest.mark.parametrize("released", [False, True])
def test_solves_coordinates_and_iterations(released, iterations, monkeypatch, x64):
    monkeypatch.setattr(solving, "RegistrationNetwork", StandIn)
    monkeypatch.setattr(StandIn, "encoded", [])
    config = dataclasses.replace(SMALL, released=released)
    if released:  # its configuration says how often, and nothing else
        config = dataclasses.replace(config, iterations=iterations)
    params = Params({"registration": {}}, config)
    solve = jax.jit(register_given_overlap, static_argnames="solves")
    answer = solve(
        params, whole(SOURCE), whole(TARGET), *MASKS, solves=None if released else iterations
    )
    assert answer.valid
    last, composed, soft = registered(released, iterations)
    found = oracle.homogeneous(answer.rotation, answer.translation)
    assert_close(found, last if released else composed, NETWORK)
    assert np.allclose(last, composed) == (iterations == 1)
    branches = answer.rotation_branch, answer.translation_branch
    assert_close(np.stack([x.target for x in branches])[:, ROWS], soft, NETWORK)
    # Query-down reads other rows in the released code.
    assert [rows is None for rows in StandIn.encoded] == [not released]


def test_farthest_point_sampling_has_no_hole_around_the_origin(x64):
    points = 0.01 * random_cloud(4, N)  # all of them would be skipped
    order = farthest_order(jnp.asarray(points), jnp.asarray(N))
    np.testing.assert_array_equal(order, oracle.farthest_order(points, N))


class Asked(Exception):
    """The registration network was asked."""


def test_the_frozen_overlap_network_gets_no_key_for_dropout(tmp_path, monkeypatch):
    model = dataclasses.replace(SMALL, dropout=RATE)
    config = dataclasses.replace(read_config(modelnet.get_config()), model=model)
    (tmp_path / "overlap").mkdir()
    keys = {}

    def predicted(params, source, target, key=None, start=None):
        keys["overlap"] = key
        return jnp.ones(N), jnp.ones(N), None

    def registered(params, source, target, source_overlap, target_overlap, key=None, solves=None):
        keys["registration"] = key
        raise Asked  # what follows is of no interest here

    trained = Params({"overlap": {}}, model)
    monkeypatch.setattr(dbdnet_tasks, "load_best", lambda run_dir, joint: trained)
    monkeypatch.setattr(stages, "predict_overlap_and_matches", predicted)
    monkeypatch.setattr(stages, "register_given_overlap", registered)
    task = dbdnet_tasks.registration_task(config, tmp_path)
    with pytest.raises(Asked):
        task.loss(task.trainable, task.frozen, Pair(*CLOUDS, *[None] * 5), jax.random.key(0))
    assert keys["overlap"] is None and keys["registration"] is not None


def given_overlap(params, source, target, key=None):
    rows = jnp.ones(N)
    return register_given_overlap(params, source, target, rows, rows, key)


@pytest.mark.parametrize("network", [predict_overlap, given_overlap])
def test_without_a_key_nothing_is_dropped(network):
    params = small_params(3, dataclasses.replace(SMALL, dropout=RATE), dtype=np.float32)
    for key in (None, jax.random.key(0)):
        program = str(jax.make_jaxpr(network)(params, *CLOUDS, key))
        assert ("random_bits" in program) == (key is not None)


def test_every_departure_on_the_page_names_tests_that_exist():
    _, *rows = (line for line in PAGE.read_text().splitlines() if line.startswith("| "))
    assert len(rows) > 10
    for row in rows:
        files, names = (re.findall(p, row) for p in (r"`(test_\w+\.py)`", r"`(test_\w+)`"))
        written = "".join(path.read_text() for file in files for path in TESTS.rglob(file))
        assert names and all(f"def {name}(" in written for name in names), row
