"""Local refinement of a pose, from it and from turns of it; kept unless it fits clearly worse.

Expectation maximisation in place of nearest neighbours (Granger & Pennec 2002): every point is
matched softly to all points within a radius that shrinks, which is smooth, tells well matched
points from those without a counterpart, and is faster than a search. The step minimises the
distances along the normals of both clouds and, weakly, those in all directions. Lengths are in
units of the shape's radius, and of clouds of more than 1024 points an even choice is taken.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from dbdnet_jax.ops import rigid
from dbdnet_jax.ops.grouping import squared_distances
from dbdnet_jax.ops.normals import estimate_normals
from dbdnet_jax.ops.rigid import HIGHEST
from dbdnet_jax.ops.sampling import divisor, prefix_mask
from dbdnet_jax.types import Cloud, Rigid

# Chosen on validation pairs of the embedded shapes, with noise and with disjoint draws.
FIRST_RADIUS = 0.18
LAST_RADIUS = 0.054
ITERATIONS = 30
ISOTROPY = 0.1  # weight of the distance in all directions, beside 1 along each normal
OUTLIER_MASS = 1.0  # a point is half matched when the kernel's sum over the other cloud is this
NEIGHBOURS = 12  # of a point, for its normal
# Of the truncated RMSE: farther points count as if they were this far; more for sparse clouds.
CAP = 0.05
SLACK = 0.02  # a refined pose may fit worse by this part: the right one of disjoint draws does
MARGIN = 0.03  # a turned pose must fit better by this part
RESTART_DEG = (-30.0, 30.0)  # turns that may lead out of a local minimum
MOST_POINTS = 1024  # of a cloud: the lengths above suit this density


class Refined(NamedTuple):
    """The refined pose, its truncated RMSE (a length), and whether it replaced its start.

    That may be a turn of the given pose, see `refine_multistart`.
    """

    target_from_source: Rigid
    truncated_rmse: Float[Array, ""]
    accepted: Bool[Array, ""]


class _PreparedPair(NamedTuple):
    """Both clouds thinned, the target about its own centroid ``centre``, and their normals.

    So rotation and translation hardly depend on each other.
    """

    views: tuple[Cloud, Cloud]
    normals: tuple[Float[Array, "n 3"], Float[Array, "m 3"]]
    centre: Float[Array, "3"]


@partial(jax.jit, static_argnames="iterations")
def refine(
    source: Cloud,
    target: Cloud,
    initial: Rigid,
    cap: float | Float[Array, ""] = CAP,
    *,
    iterations: int = ITERATIONS,
) -> Refined:
    """Refine ``initial`` (target_from_source), or keep it if the truncated RMSE rises by over 2 %.

    Pure, of fixed cost, and without a gradient of use.
    """
    return _refine(_prepare(source, target), initial, cap, iterations)


@partial(jax.jit, static_argnames="angles_deg")
def refine_from_rotations(
    source: Cloud,
    target: Cloud,
    initial: Rigid,
    angles_deg: tuple[float, ...],
    cap: float | Float[Array, ""] = CAP,
) -> Refined:
    """Refine a pose and its turns about the principal axes through the moved source's middle.

    Every leaf has a leading axis of 1 + 3 * len(angles_deg): first the pose itself.
    """
    scene = _prepare(source, target)
    starts = _turned(scene.views[0], initial, angles_deg)
    return jax.lax.map(lambda start: _refine(scene, start, cap, ITERATIONS), starts)


@jax.jit
def refine_multistart(
    source: Cloud, target: Cloud, initial: Rigid, cap: float | Float[Array, ""] = CAP
) -> Refined:
    """The refined pose, or a refined turn of it by 30 degrees that fits clearly better.

    Slightly better is no reason: a wrong pose that lays more of the clouds over each other may
    fit as well as the right one.
    """
    found = refine_from_rotations(source, target, initial, RESTART_DEG, cap)
    best = jnp.argmin(found.truncated_rmse.at[0].multiply(1.0 - MARGIN))
    return jax.tree.map(lambda leaf: leaf[best], found)


class Schedule(NamedTuple):
    """The radii of a refinement, from ``first`` to ``last`` in so many steps, and its cap."""

    first: float
    last: float
    iterations: int
    cap: float


@partial(jax.jit, static_argnames="schedule")
def refine_each(
    source: Cloud,
    target: Cloud,
    normals: tuple[Float[Array, "n 3"], Float[Array, "m 3"]],
    starts: Rigid,
    schedule: Schedule,
) -> tuple[Rigid, Float[Array, " k"]]:
    """Several poses refined from given normals, each for itself, and their truncated RMSE.

    ``starts`` has a leading axis of k. No pose is kept where refining makes it worse: this is for
    poses that are rough.
    """
    source, target = _zero_padding(source), _zero_padding(target)
    centre = _middle(target.points, target)
    target = target._replace(points=target.points - centre[None, :])
    scene = _PreparedPair((source, target), normals, centre)
    radii = jnp.geomspace(
        schedule.first, schedule.last, schedule.iterations, dtype=source.points.dtype
    )

    def one(start: Rigid) -> tuple[Rigid, Float[Array, ""]]:
        pose = Rigid(start.rotation, start.translation - centre)
        pose = jax.lax.scan(lambda at, radius: (_step(scene, at, radius), None), pose, radii)[0]
        rmse = _truncated_rmse(scene.views, pose, schedule.cap)
        return Rigid(pose.rotation, pose.translation + centre), rmse

    return jax.lax.map(one, starts)


@jax.jit
def truncated_rmse(
    source: Cloud, target: Cloud, target_from_source: Rigid, cap: float | Float[Array, ""] = CAP
) -> Float[Array, ""]:
    """How badly a pose fits: root mean square distance of each cloud's points to the other cloud.

    Distances above ``cap`` count as it, so points without a counterpart say little: 0 is a perfect
    fit of everything, ``cap`` none. It should exceed the distance between neighbours.
    """
    return _truncated_rmse((_downsample(source), _downsample(target)), target_from_source, cap)


def _prepare(source: Cloud, target: Cloud) -> _PreparedPair:
    source, target = _downsample(source), _downsample(target)
    centre = _middle(target.points, target)
    target = target._replace(points=target.points - centre[None, :])
    normals = estimate_normals(*source, NEIGHBOURS), estimate_normals(*target, NEIGHBOURS)
    return _PreparedPair((source, target), normals, centre)


def _downsample(cloud: Cloud) -> Cloud:
    """At most MOST_POINTS rows, evenly over the valid ones; padding becomes zeros."""
    size = min(cloud.points.shape[0], MOST_POINTS)
    whole, part = jnp.divmod(jnp.maximum(cloud.count, size), size)
    places = jnp.arange(size, dtype=whole.dtype)
    rows = places * whole + places * part // size  # no overflow at 10 million
    count = jnp.minimum(cloud.count, size)
    return Cloud(jnp.where(prefix_mask(size, count)[:, None], cloud.points[rows], 0.0), count)


def _zero_padding(cloud: Cloud) -> Cloud:
    return cloud._replace(points=jnp.where(cloud.valid[:, None], cloud.points, 0.0))


def _middle(points: Float[Array, "n 3"], cloud: Cloud) -> Float[Array, "3"]:
    """The mean of the valid rows of ``points``."""
    total = jnp.sum(jnp.where(cloud.valid[:, None], points, 0.0), axis=0)
    return total / divisor(cloud.count, total.dtype)


def _turned(source: Cloud, pose: Rigid, angles_deg: tuple[float, ...]) -> Rigid:
    """The pose and its turns, stacked; see `refine_from_rotations`."""
    moved = rigid.apply(pose, source.points)
    middle = _middle(moved, source)
    arms = jnp.where(source.valid[:, None], moved - middle[None, :], 0.0)
    axes = jnp.linalg.eigh(jnp.matmul(arms.T, arms, precision=HIGHEST))[1].T
    angles = jnp.deg2rad(jnp.array(angles_deg, moved.dtype))
    turns = jax.vmap(jax.vmap(rigid.rotation_about, (None, 0)), (0, None))(axes, angles)
    identity = jnp.eye(3, dtype=moved.dtype)
    turns = jnp.concatenate([identity[None], turns.reshape(-1, 3, 3)])
    there, back = Rigid(identity, -middle), Rigid(identity, middle)
    level = rigid.compose(there, pose)

    def about_middle(turn: Array) -> Rigid:
        return rigid.compose(back, rigid.compose(Rigid(turn, jnp.zeros_like(middle)), level))

    return jax.vmap(about_middle)(turns)


def _refine(
    scene: _PreparedPair, initial: Rigid, cap: float | Float[Array, ""], iterations: int
) -> Refined:
    start = Rigid(initial.rotation, initial.translation - scene.centre)
    radii = jnp.geomspace(FIRST_RADIUS, LAST_RADIUS, iterations, dtype=scene.centre.dtype)
    end = jax.lax.scan(lambda at, radius: (_step(scene, at, radius), None), start, radii)[0]
    before, after = (_truncated_rmse(scene.views, pose, cap) for pose in (start, end))
    accepted = after <= (1.0 + SLACK) * before
    best = jax.tree.map(lambda new, old: jnp.where(accepted, new, old), end, start)
    motion = Rigid(best.rotation, best.translation + scene.centre)
    return Refined(motion, jnp.where(accepted, after, before), accepted)


def _truncated_rmse(
    views: tuple[Cloud, Cloud], motion: Rigid, cap: float | Float[Array, ""]
) -> Float[Array, ""]:
    source, target = views
    squares = squared_distances(rigid.apply(motion, source.points), target.points)
    rows, columns = source.valid, target.valid
    squares = jnp.where(rows[:, None] & columns[None, :], squares, jnp.inf)
    squares = jnp.minimum(squares, jnp.square(cap))
    ways = jnp.where(rows, squares.min(axis=1), 0.0), jnp.where(columns, squares.min(axis=0), 0.0)
    total = jnp.sum(ways[0]) + jnp.sum(ways[1])
    return jnp.sqrt(total / divisor(source.count + target.count, total.dtype))


def _step(scene: _PreparedPair, motion: Rigid, radius: Float[Array, ""]) -> Rigid:
    """One Gauss-Newton step on ``sum_ij P_ij e^T M_ij e`` with ``e = R s_i + t - q_j``.

    P is the soft matching and ``M_ij = 0.1 I + 0.9 (a_i a_i^T + b_j b_j^T)``, a and b the normals.
    All that depends on j enters through one product of P with features of the target's points.
    """
    source, target = scene.views
    normals = scene.normals
    moved = rigid.apply(motion, source.points)
    one = jnp.eye(3, dtype=moved.dtype)
    across = _outer(jnp.matmul(normals[0], motion.rotation.T, precision=HIGHEST))
    target_across = _outer(normals[1])
    features = jnp.concatenate(
        [
            jnp.ones((len(target.points), 1), moved.dtype),
            target.points,
            target_across.reshape(-1, 9),
            jnp.einsum("nij,nj->ni", target_across, target.points),
        ],
        axis=1,
    )
    matching = _match(source._replace(points=moved), target, radius)
    sums = jnp.matmul(matching, features, precision=HIGHEST)
    mass, mean, metric, metric_mean = jnp.split(sums, [1, 4, 13], axis=1)
    own = ISOTROPY * one[None] + (1 - ISOTROPY) * across
    metric = mass[:, :, None] * own + (1 - ISOTROPY) * metric.reshape(-1, 3, 3)
    # sum_j P_ij M_ij (s_i - q_j) of every source point
    pull = jnp.einsum("nij,nj->ni", metric, moved, precision=HIGHEST)
    pull -= jnp.einsum("nij,nj->ni", own, mean, precision=HIGHEST) + (1 - ISOTROPY) * metric_mean
    identity = jnp.broadcast_to(one, metric.shape)
    jacobian = jnp.concatenate([-rigid.cross_matrix(moved), identity], axis=2)
    hessian = jnp.einsum("nai,nab,nbj->ij", jacobian, metric, jacobian, precision=HIGHEST)
    gradient = jnp.einsum("nai,na->i", jacobian, pull, precision=HIGHEST)
    # The ridge holds motions that nothing resists; its constant, all of them where none matched.
    ridge = 1e-6 * jnp.trace(hessian) + 1e-12
    hessian += ridge * jnp.eye(6, dtype=moved.dtype)
    turn, shift = jnp.split(-jnp.linalg.solve(hessian, gradient), 2)
    angle = jnp.sqrt(jnp.sum(turn * turn) + 1e-20)  # no division by zero at rest
    return rigid.compose(Rigid(rigid.rotation_about(turn / angle, angle), shift), motion)


def _match(moved: Cloud, target: Cloud, radius: Float[Array, ""]) -> Float[Array, "n m"]:
    """Soft matching, the sum of both ways; what has little within the radius is hardly matched."""
    squares = squared_distances(moved.points, target.points)
    kernel = jnp.maximum(1.0 - squares / radius**2, 0.0) ** 2
    kernel = jnp.where(moved.valid[:, None] & target.valid[None, :], kernel, 0.0)
    forth = 1.0 / (OUTLIER_MASS + kernel.sum(axis=1))
    back = 1.0 / (OUTLIER_MASS + kernel.sum(axis=0))
    return kernel * (forth[:, None] + back[None, :])


def _outer(vectors: Float[Array, "n 3"]) -> Float[Array, "n 3 3"]:
    """Each vector times its own transpose."""
    return vectors[:, :, None] * vectors[:, None, :]
