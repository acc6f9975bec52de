"""Training pairs as the world is: a mixture of named parts, each a way to draw a pair."""

from __future__ import annotations

import dataclasses
import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from dbdnet_jax.data.pairs import UNIT_SIZE, Protocol
from dbdnet_jax.data.scans import Seen, centred_cloud, cut, noisy, sample, shared, view
from dbdnet_jax.data.worlds import OTHERS, Surface, World, draw_world
from dbdnet_jax.ops import rigid
from dbdnet_jax.ops.grouping import squared_distances
from dbdnet_jax.ops.quaternion import any_rotation
from dbdnet_jax.types import Cloud, Pair, Rigid

LEAST_SHARED = 0.15  # of the smaller view, by area: 0.2 and more of the points, mostly
TRIES = 4  # second views, of which the one is taken that shares what was drawn most nearly
NEAREST = 5  # points, of which one is the near one of a stock
MOST_NOISE = 2.0  # times the protocol's


@dataclasses.dataclass(frozen=True)
class Mixture:
    """Shares of the training pairs; the protocol's own pairs have the rest."""

    low_overlap: float = 0.0  # one shape, two independent cuts that share 20 to 100 %
    views: float = 0.0  # one shape seen by two cameras or lidars
    standing: float = 0.0  # on a floor, perhaps before a wall
    cluttered: float = 0.0  # beside other shapes
    rooms: float = 0.0  # floor, walls and several shapes, seen from within
    turned: float = 0.0  # one shape, cut, turned by any rotation

    def __post_init__(self) -> None:
        """Refuse shares that are none."""
        shares = dataclasses.astuple(self)
        if min(shares) < 0 or sum(shares) > 1:
            raise ValueError(
                "config.data.mixture must hold shares that are not negative and at most 1 in sum; "
                f"got {shares}. Lower them."
            )

    @property
    def total(self) -> float:
        """The share of all parts together."""
        return sum(dataclasses.astuple(self))


class Part(NamedTuple):
    """How a part draws: a world, whether cameras see it, from where, and any rotation."""

    world: World
    seen: float  # chance of cameras; of cuts otherwise
    inside: float  # 1: cameras stand within
    apart: float  # largest difference of the cameras' azimuths, in degrees
    turned: float  # chance of any rotation


PARTS = {  # by the names of `Mixture`
    "low_overlap": Part(World(), seen=0.0, inside=0.0, apart=0.0, turned=0.0),
    "views": Part(World(), seen=1.0, inside=0.0, apart=100.0, turned=0.0),
    "standing": Part(World(floor=1.0, walls=0.4), seen=0.7, inside=0.0, apart=80.0, turned=0.0),
    "cluttered": Part(World(others=2.0, floor=0.3), seen=0.5, inside=0.0, apart=80.0, turned=0.0),
    "rooms": Part(World(3.0, 1.0, 0.8, 1.0, 0.6), seen=1.0, inside=1.0, apart=60.0, turned=0.0),
    "turned": Part(World(), seen=0.0, inside=0.0, apart=0.0, turned=1.0),
}


class Stock(NamedTuple):
    """Shapes to build worlds of, and for each point a near one, to draw points between the two."""

    points: Float[Array | np.ndarray, "s n 3"]
    near: Int[Array | np.ndarray, "s n"]


def stock_of(points: Float[np.ndarray, "s n 3"]) -> Stock:
    """The stock of a set of shapes; some milliseconds for each."""
    from scipy.spatial import cKDTree

    rng = np.random.default_rng(0)
    pick = rng.integers(1, 1 + NEAREST, points.shape[:2])
    near = np.empty(points.shape[:2], np.int32)
    for i, shape in enumerate(points):
        rows = cKDTree(shape).query(shape, k=NEAREST + 1)[1]
        near[i] = np.take_along_axis(rows, pick[i][:, None], axis=1)[:, 0]
    return Stock(jnp.asarray(points), jnp.asarray(near))


def make_mixture_pair(
    key: PRNGKeyArray, number: Int[Array, ""], stock: Stock, mixture: Mixture, protocol: Protocol
) -> Pair:
    """A pair about shape ``number`` of one of the parts, each as often as its share says."""
    part_key, other_key, draw_key = jax.random.split(key, 3)
    shares = jnp.asarray(dataclasses.astuple(mixture))
    index = jax.random.categorical(part_key, jnp.log(jnp.maximum(shares, 1e-9)))
    names = [field.name for field in dataclasses.fields(mixture)]
    table = jax.tree.map(lambda *values: jnp.asarray(values), *(PARTS[name] for name in names))
    part = jax.tree.map(lambda values: values[index], table)
    others = jax.random.randint(other_key, (OTHERS,), 0, len(stock.points))
    return make_part_pair(draw_key, number, others, stock, part, protocol)


def make_part_pair(
    key: PRNGKeyArray,
    number: Int[Array, ""],
    others: Int[Array, " o"],
    stock: Stock,
    part: Part,
    protocol: Protocol,
) -> Pair:
    """A pair of one part about shape ``number`` of the stock, with ``others`` beside it.

    No point of one cloud stands in the other. Half of the pairs are of evenly spaced points, and
    half of all worlds stand in a frame turned by any rotation, both clouds alike. Both clouds have
    the scale that `align` gives its clouds, and at most the protocol's points; the translation
    and, but for turned pairs, the rotation are the protocol's.
    """
    keys = jax.random.split(key, 8)
    dense = _between(keys[0], stock.points[number], stock.near[number])
    chance = jax.random.uniform(keys[1], (5,))
    surface = draw_world(keys[2], dense, stock.points[others], part.world)
    seen = _two_views(keys[3], surface, part, chance[0] < part.seen)
    side = jax.random.bernoulli(keys[4], 0.5, surface.area.shape)
    sigma = protocol.noise_sigma * MOST_NOISE * jnp.maximum(2.0 * chance[1] - 0.5, 0.0) / 1.5
    # Scans come in any frame: half of the worlds do not stand upright.
    frame = jnp.where(chance[4] < 0.5, any_rotation(keys[7]), jnp.eye(3))
    clouds, centres, sizes = [], [], []
    for i, (one, own) in enumerate(zip(seen, (side, ~side), strict=True)):
        draw_key, noise_key = jax.random.split(jax.random.fold_in(keys[5], i))
        weight = jnp.where(own, one.weight, 0.0)
        rows, count = sample(draw_key, surface, weight, protocol.size, chance[2] < 0.5)
        points = noisy(noise_key, surface.points[rows], one.eye, sigma, protocol.noise_clip)
        points = jnp.matmul(points, frame.T, precision=rigid.HIGHEST)
        cloud, centre, size = centred_cloud(points, count)
        clouds.append(cloud)
        centres.append(centre)
        sizes.append(size)
    factor = UNIT_SIZE / jnp.maximum(jnp.maximum(*sizes), 1e-3)
    motion = _motion(keys[6], protocol, chance[3] < part.turned)
    return _pair(clouds, centres, factor, motion, protocol)


def _between(
    key: PRNGKeyArray, points: Float[Array, "n 3"], near: Int[Array, " n"]
) -> Float[Array, "m 3"]:
    """The points, and as many again between each one and a near one."""
    share = jax.random.uniform(key, (len(points), 1), minval=0.3, maxval=0.7)
    return jnp.concatenate([points, points + share * (points[near] - points)])


def _two_views(
    key: PRNGKeyArray, surface: Surface, part: Part, by_camera: Bool[Array, ""]
) -> tuple[Seen, Seen]:
    """Two ways to see the surface that share a part of it between `LEAST_SHARED` and all."""
    first_key, *try_keys = jax.random.split(key, 1 + TRIES)
    middle_key, wanted_key, first_key = jax.random.split(first_key, 3)
    # Worlds without walls are seen from all sides.
    apart = jnp.deg2rad(part.apart)
    widest = jnp.where(part.world.walls > 0, math.pi / 5, math.pi)
    middle = jax.random.uniform(middle_key, (), minval=-1.0) * widest

    def see(k: PRNGKeyArray, about: Array) -> Seen:
        pictured, part_of = view(k, surface, about, part.inside), cut(k, surface)
        return jax.tree.map(lambda a, b: jnp.where(by_camera, a, b), pictured, part_of)

    first = see(first_key, middle)

    def attempt(k: PRNGKeyArray) -> tuple[Seen, Array]:
        about_key, k = jax.random.split(k)
        second = see(k, middle + apart * jax.random.uniform(about_key, (), minval=-1.0))
        return second, shared(first, second, surface)

    tries, parts = jax.lax.map(attempt, jnp.stack(try_keys))
    wanted = jax.random.uniform(wanted_key, (), minval=LEAST_SHARED)
    miss = jnp.abs(parts - wanted) + jnp.where(parts < LEAST_SHARED, 1.0, 0.0)
    chosen = jnp.argmin(miss)
    return first, jax.tree.map(lambda leaf: leaf[chosen], tries)


def _motion(key: PRNGKeyArray, protocol: Protocol, turned: Bool[Array, ""]) -> Rigid:
    """The protocol's motion, or one with any rotation."""
    motion_key, turn_key = jax.random.split(key)
    motion = rigid.random_rigid(
        motion_key, math.radians(protocol.max_angle_deg), protocol.max_translation
    )
    rotation = jnp.where(turned, any_rotation(turn_key), motion.rotation)
    return Rigid(rotation, motion.translation)


def _pair(
    clouds: list[Cloud],
    centres: list[Array],
    factor: Float[Array, ""],
    motion: Rigid,
    protocol: Protocol,
) -> Pair:
    """Both clouds at one scale, the source moved from the target's frame, and what overlaps."""
    source, target = (Cloud(cloud.points * factor, cloud.count) for cloud in clouds)
    # Both were centred on their own: this is where the source stands in the target's frame.
    offset = (centres[0] - centres[1]) * factor
    valid = source.valid, target.valid
    near = squared_distances(source.points + offset[None, :], target.points)
    near = (near < protocol.overlap_radius**2) & valid[0][:, None] & valid[1][None, :]
    moved = rigid.apply(motion, source.points + offset[None, :])
    nothing = jnp.zeros_like(moved)  # no normals: nothing trains on them
    return Pair(
        source=Cloud(jnp.where(valid[0][:, None], moved, 0.0), source.count),
        target=target,
        target_from_source=rigid.invert(motion),
        source_overlap=jnp.any(near, axis=1),
        target_overlap=jnp.any(near, axis=0),
        source_normals=nothing,
        target_normals=nothing,
    )
