"""The parts of the mixture: every pair is what its labels and its pose say."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial import cKDTree

from dbdnet_jax.data import scans
from dbdnet_jax.data.cad import cad_split
from dbdnet_jax.data.mixture import (
    PARTS,
    Mixture,
    make_mixture_pair,
    make_part_pair,
    stock_of,
)
from dbdnet_jax.data.pairs import UNIT_SIZE, Protocol
from dbdnet_jax.data.worlds import Surface, World, draw_world

PROTOCOL = Protocol(points=512)
COUNT = 12


@pytest.fixture(scope="module")
def stock():
    return jax.tree.map(jnp.asarray, stock_of(cad_split("val").points[:6]))


@pytest.fixture(scope="module")
def drawn(stock):
    """A dozen pairs of each part, as NumPy arrays."""
    draw = jax.jit(
        lambda key, number, part: make_part_pair(
            key, number, (number + jnp.arange(1, 4)) % 6, stock, part, PROTOCOL
        )
    )
    return {
        name: [
            jax.device_get(draw(jax.random.key(i), jnp.asarray(i % 6), jax.tree.map(float, part)))
            for i in range(COUNT)
        ]
        for name, part in PARTS.items()
    }


def valid_points(pair):
    """Source points moved by the true pose, and target points."""
    motion = pair.target_from_source
    moved = pair.source.points @ motion.rotation.T + motion.translation
    return moved[: pair.source.count], pair.target.points[: pair.target.count]


def test_parts_are_the_mixtures():
    assert set(PARTS) == set(Mixture.__dataclass_fields__)


@pytest.mark.parametrize("name", PARTS)
def test_labels_say_which_points_have_a_neighbour(drawn, name):
    for pair in drawn[name]:
        source, target = valid_points(pair)
        away = cKDTree(target).query(source)[0]
        clear = np.abs(away - PROTOCOL.overlap_radius) > 1e-4
        label = pair.source_overlap[: pair.source.count]
        assert (label == (away < PROTOCOL.overlap_radius))[clear].all()
        assert not pair.source_overlap[pair.source.count :].any()
        assert not pair.source.points[pair.source.count :].any()


@pytest.mark.parametrize("name", PARTS)
def test_clouds_share_a_part_and_have_the_size_that_align_gives(drawn, name):
    overlap, sizes = [], []
    for pair in drawn[name]:
        source, target = valid_points(pair)
        assert 64 <= min(len(source), len(target)) <= PROTOCOL.size
        assert cKDTree(target).query(source)[0].min() > 0  # no point stands in both
        overlap.append(pair.source_overlap.sum() / len(source))
        radii = [np.linalg.norm(x - x.mean(axis=0), axis=1) for x in (source, target)]
        sizes.append(max(np.quantile(r, 0.98, method="lower") for r in radii))
    assert min(overlap) > 0.02 and np.median(overlap) > 0.3
    np.testing.assert_allclose(sizes, UNIT_SIZE, rtol=0.02)


def test_turned_pairs_alone_turn_farther_than_the_protocol(drawn):
    angles = {
        name: [np.trace(pair.target_from_source.rotation) for pair in pairs]
        for name, pairs in drawn.items()
    }
    for name, traces in angles.items():
        # Three Euler angles of 45 degrees make 86 degrees at most.
        assert (min(traces) < 1 + 2 * np.cos(np.deg2rad(90))) == (name == "turned")


def test_a_camera_does_not_see_what_is_hidden():
    side = np.linspace(-1, 1, 30)
    grid = np.stack(np.meshgrid(side, side), axis=-1).reshape(-1, 2)
    near = np.column_stack([grid[:, 0], grid[:, 1], np.zeros(900)])
    points = jnp.asarray(np.concatenate([near, 0.5 * near + [[0, 0, -1.0]]]), jnp.float32)
    depth, x, y = scans._image(points, jnp.asarray([0.0, 0, 3]), jnp.zeros(3))
    seen = np.asarray(scans._unhidden(depth, x, y, jnp.ones(1800, bool)))
    np.testing.assert_allclose(depth[:900], 3.0, atol=1e-5)
    assert seen[:900].all() and not seen[900:].any()
    # Nothing is hidden where the near wall is not there, and nothing there is seen.
    alone = np.asarray(scans._unhidden(depth, x, y, jnp.arange(1800) >= 900))
    assert alone[900:].all() and not alone[:900].any()


def test_points_are_drawn_by_weight_and_none_twice():
    surface = Surface(jax.random.normal(jax.random.key(0), (400, 3)), jnp.ones(400))
    weight = jnp.where(jnp.arange(400) < 150, 1.0, 0.0)
    for spaced in (False, True):
        rows, count = scans.sample(jax.random.key(1), surface, weight, 100, jnp.asarray(spaced))
        assert count == 100 and len(set(np.asarray(rows))) == 100 and rows.max() < 150
    rows, count = scans.sample(
        jax.random.key(1),
        surface,
        jnp.where(jnp.arange(400) < 40, weight, 0.0),
        100,
        jnp.asarray(True),
    )
    assert count == 40 and set(np.asarray(rows[:40])) == set(range(40))


def test_worlds_hold_what_they_say(stock):
    draw = jax.jit(lambda key, world: draw_world(key, stock.points[0], stock.points[1:4], world))
    bare = draw(jax.random.key(0), jax.tree.map(float, World()))
    n = len(stock.points[0])
    assert (bare.area[:n] > 0).all() and not bare.area[n:].any()
    full = draw(jax.random.key(0), jax.tree.map(float, World(3.0, 1.0, 1.0, 1.0, 0.6)))
    there = np.asarray(full.area > 0)
    assert there[4 * n :].all() and there[:n].all() and there.reshape(-1)[: 4 * n].mean() >= 0.75
    assert full.points[:, 1].min() > -1e-5  # all stand on the floor
    np.testing.assert_allclose(full.points[4 * n : 4 * n + 10, 1], 0.0, atol=1e-6)


def test_shares_say_how_often_a_part_is_drawn(stock):
    mixture = Mixture(turned=0.3)
    draw = jax.jit(lambda key: make_mixture_pair(key, jnp.asarray(0), stock, mixture, PROTOCOL))
    traces = [np.trace(draw(jax.random.key(i)).target_from_source.rotation) for i in range(8)]
    assert min(traces) < 1


@pytest.mark.parametrize("shares", [{"rooms": -0.1}, {"rooms": 0.6, "views": 0.6}])
def test_shares_that_are_none_are_refused(shares):
    with pytest.raises(ValueError, match="config.data.mixture must hold shares"):
        Mixture(**shares)
