"""Local refinement of a pose, kept only where it fits better, and a choice among several poses.

Expectation maximisation in place of nearest neighbours (Granger & Pennec 2002): every point is
matched softly to all points within a radius that shrinks, which is smooth, tells well matched
points from those without a counterpart, and is faster than a search. The step minimises the
distances along the normals of both clouds and, weakly, those in all directions. Lengths are in
units of the shape's radius.
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
from dbdnet_jax.ops.sampling import prefix_mask
from dbdnet_jax.types import Cloud, Rigid

# Chosen on validation pairs of the embedded shapes, with noise and with disjoint draws.
FIRST_RADIUS = 0.18  # 0.3, with overlap probabilities at hand: they hold what it would pull away
LAST_RADIUS = 0.054
ITERATIONS = 30
ISOTROPY = 0.1  # weight of the distance in all directions, beside 1 along each normal
OUTLIER_MASS = 1.0  # a point is half matched when the kernel's sum over the other cloud is this
NEIGHBOURS = 12  # of a point, for its normal
CAP = 0.05  # of the residual: farther points count as if they were this far
MARGIN = 0.03
MOST_POINTS = 1024  # an even choice of larger clouds: the lengths above suit this density


class Polished(NamedTuple):
    """The refined motion, its residual (a length, see `residual`), and if it replaced the given."""

    target_from_source: Rigid
    residual: Float[Array, ""]
    accepted: Bool[Array, ""]


class _View(NamedTuple):
    """A cloud of at most MOST_POINTS rows and the rows' weights, 0 for padding."""

    cloud: Cloud
    weight: Float[Array, " n"]


@partial(jax.jit, static_argnames="iterations")
def polish(
    source: Cloud,
    target: Cloud,
    initial: Rigid,
    source_overlap: Float[Array, " n"] | None = None,
    target_overlap: Float[Array, " m"] | None = None,
    *,
    first_radius: float | Float[Array, ""] = FIRST_RADIUS,
    last_radius: float | Float[Array, ""] = LAST_RADIUS,
    iterations: int = ITERATIONS,
) -> Polished:
    """Refine ``initial`` (target_from_source), or keep it where the result fits worse.

    The overlaps are probabilities that a point has a counterpart; each point counts by its own.
    Without them every point counts the same. From clouds of more than 1024 points an even choice
    is taken. Pure, of fixed cost, and without a gradient of use.
    """
    views = _thin(source, source_overlap), _thin(target, target_overlap)
    # Around the target's centroid, so that rotation and translation hardly depend on each other.
    centre = views[1].weight @ views[1].cloud.points / jnp.maximum(views[1].weight.sum(), 1e-6)
    views = views[0], _shift(views[1], -centre)
    start = Rigid(initial.rotation, initial.translation - centre)
    normals = [estimate_normals(*view.cloud, NEIGHBOURS) for view in views]
    radii = jnp.geomspace(first_radius, last_radius, iterations)

    def step(motion, radius):
        return _step(motion, views, normals, radius), None

    end = jax.lax.scan(step, start, radii)[0]
    before, after = _residual(views, start), _residual(views, end)
    accepted = after <= before
    best = jax.tree.map(lambda new, old: jnp.where(accepted, new, old), end, start)
    motion = Rigid(best.rotation, best.translation + centre)
    return Polished(motion, jnp.where(accepted, after, before), accepted)


@jax.jit
def residual(
    source: Cloud,
    target: Cloud,
    target_from_source: Rigid,
    source_overlap: Float[Array, " n"] | None = None,
    target_overlap: Float[Array, " m"] | None = None,
) -> Float[Array, ""]:
    """How badly a pose fits: root mean square distance of each cloud's points to the other cloud.

    Distances above 0.05 count as 0.05, so points without a counterpart say little: 0 is a perfect
    fit of everything, 0.05 none. The overlaps weigh the points.
    """
    views = _thin(source, source_overlap), _thin(target, target_overlap)
    return _residual(views, target_from_source)


@jax.jit
def choose(
    source: Cloud,
    target: Cloud,
    candidates: Rigid,
    source_overlap: Float[Array, " n"] | None = None,
    target_overlap: Float[Array, " m"] | None = None,
    *,
    margin: float | Float[Array, ""] = MARGIN,
) -> Rigid:
    """The candidate of least `residual`, from motions stacked along the first axis.

    The first one stands unless another's residual is smaller by the part ``margin`` of it: wrong
    poses that lay more of the clouds over each other fit as well as the right one. So put the
    most trusted first, and polish all of them before.
    """
    views = _thin(source, source_overlap), _thin(target, target_overlap)
    residuals = jax.lax.map(lambda motion: _residual(views, motion), candidates)
    best = jnp.argmin(residuals.at[0].multiply(1.0 - margin))
    return jax.tree.map(lambda leaf: leaf[best], candidates)


def _thin(cloud: Cloud, overlap: Float[Array, " n"] | None) -> _View:
    """At most MOST_POINTS rows, evenly over the valid ones, and what they weigh."""
    size = min(cloud.points.shape[0], MOST_POINTS)
    rows = jnp.arange(size) * jnp.maximum(cloud.count, size) // size
    count = jnp.minimum(cloud.count, size)
    valid = prefix_mask(size, count)
    points = jnp.where(valid[:, None], cloud.points[rows], 0.0)
    weight = valid.astype(points.dtype) if overlap is None else jnp.where(valid, overlap[rows], 0.0)
    return _View(Cloud(points, count), weight)


def _shift(view: _View, offset: Float[Array, "3"]) -> _View:
    return view._replace(cloud=view.cloud._replace(points=view.cloud.points + offset[None, :]))


def _residual(views: tuple[_View, _View], motion: Rigid) -> Float[Array, ""]:
    source, target = views
    squares = squared_distances(rigid.apply(motion, source.cloud.points), target.cloud.points)
    valid = [prefix_mask(len(view.weight), view.cloud.count) for view in views]
    squares = jnp.where(valid[0][:, None] & valid[1][None, :], squares, jnp.inf)
    squares = jnp.minimum(squares, CAP**2)
    weighted = source.weight @ squares.min(axis=1) + target.weight @ squares.min(axis=0)
    total = source.weight.sum() + target.weight.sum()
    return jnp.sqrt(weighted / jnp.maximum(total, 1e-6))


def _step(
    motion: Rigid,
    views: tuple[_View, _View],
    normals: list[Float[Array, "n 3"]],
    radius: Float[Array, ""],
) -> Rigid:
    """One Gauss-Newton step on ``sum_ij P_ij e^T M_ij e`` with ``e = R s_i + t - q_j``.

    P is the soft matching and ``M_ij = 0.1 I + 0.9 (a_i a_i^T + b_j b_j^T)``, a and b the normals.
    All that depends on j enters through one product of P with features of the target's points.
    """
    moved = rigid.apply(motion, views[0].cloud.points)
    target = views[1].cloud.points
    across = _outer(jnp.matmul(normals[0], motion.rotation.T, precision=HIGHEST))
    target_across = _outer(normals[1])
    features = jnp.concatenate(
        [
            jnp.ones((len(target), 1)),
            target,
            target_across.reshape(-1, 9),
            jnp.einsum("nij,nj->ni", target_across, target),
        ],
        axis=1,
    )
    matching = _match(moved, target, views[0].weight, views[1].weight, radius)
    sums = jnp.matmul(matching, features, precision=HIGHEST)
    mass, mean, metric, metric_mean = jnp.split(sums, [1, 4, 13], axis=1)
    own = ISOTROPY * jnp.eye(3)[None] + (1 - ISOTROPY) * across
    metric = mass[:, :, None] * own + (1 - ISOTROPY) * metric.reshape(-1, 3, 3)
    # sum_j P_ij M_ij (s_i - q_j) of every source point
    pull = jnp.einsum("nij,nj->ni", metric, moved, precision=HIGHEST)
    pull -= jnp.einsum("nij,nj->ni", own, mean, precision=HIGHEST) + (1 - ISOTROPY) * metric_mean
    identity = jnp.broadcast_to(jnp.eye(3), metric.shape)
    jacobian = jnp.concatenate([-_cross(moved), identity], axis=2)
    hessian = jnp.einsum("nai,nab,nbj->ij", jacobian, metric, jacobian, precision=HIGHEST)
    gradient = jnp.einsum("nai,na->i", jacobian, pull, precision=HIGHEST)
    # The ridge holds motions that nothing resists; its constant, all of them where none matched.
    ridge = 1e-6 * jnp.trace(hessian) + 1e-12
    turn, shift = jnp.split(-jnp.linalg.solve(hessian + ridge * jnp.eye(6), gradient), 2)
    angle = jnp.sqrt(jnp.sum(turn * turn) + 1e-20)  # no division by zero at rest
    return rigid.compose(Rigid(rigid.rotation_about(turn / angle, angle), shift), motion)


def _match(
    moved: Float[Array, "n 3"],
    target: Float[Array, "m 3"],
    moved_weight: Float[Array, " n"],
    target_weight: Float[Array, " m"],
    radius: Float[Array, ""],
) -> Float[Array, "n m"]:
    """Soft matching, the sum of both ways; what has little within the radius is hardly matched."""
    kernel = jnp.maximum(1.0 - squared_distances(moved, target) / radius**2, 0.0) ** 2
    kernel = kernel * moved_weight[:, None] * target_weight[None, :]
    forth = 1.0 / (OUTLIER_MASS + kernel.sum(axis=1))
    back = 1.0 / (OUTLIER_MASS + kernel.sum(axis=0))
    return kernel * (forth[:, None] + back[None, :])


def _outer(vectors: Float[Array, "n 3"]) -> Float[Array, "n 3 3"]:
    """Each vector times its own transpose."""
    return vectors[:, :, None] * vectors[:, None, :]


def _cross(vectors: Float[Array, "n 3"]) -> Float[Array, "n 3 3"]:
    """The matrix of each vector: ``cross(v) @ x`` is ``v x x``."""
    x, y, z = vectors.T
    zero = jnp.zeros_like(x)
    rows = [jnp.stack(row, axis=1) for row in ((zero, -z, y), (z, zero, -x), (-y, x, zero))]
    return jnp.stack(rows, axis=1)
