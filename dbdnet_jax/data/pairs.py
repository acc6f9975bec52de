"""The paper's protocol: how one shape becomes a pair of partial, moved and noisy clouds.

A pair is drawn in two steps: a `PairDraw` holds every random choice, and `assemble` follows it. A
frozen test set is a file of draws, so it is small, and the same on every machine.
"""

import dataclasses
import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from dbdnet_jax.ops import rigid
from dbdnet_jax.ops.grouping import squared_distances
from dbdnet_jax.ops.sampling import divisor, half_space_crop, random_direction, resample
from dbdnet_jax.types import Cloud, Pair, Rigid

# The size of a partial scan of a shape in the unit sphere, to which `align` brings clouds of one's
# own: the median of the larger one of a pair under the protocol, on the training shapes. Its
# logarithm varies by 0.12.
UNIT_SIZE = 0.95


@dataclasses.dataclass(frozen=True)
class Protocol:
    """How pairs are made; lengths are in units of the shape's radius (metres for scans)."""

    points: int = 1024  # drawn from the shape for each cloud, before the crop
    keep: float = 0.7  # the part of them that a random half-space cut leaves
    max_angle_deg: float = 45.0  # of each Euler angle
    max_translation: float = 1.0  # of each component
    noise_sigma: float = 0.01  # of the Gaussian added to every coordinate after the crop
    noise_clip: float = 0.05
    disjoint: bool = False  # no point of the shape in both clouds: no exact counterparts
    overlap_radius: float = 0.1  # a point overlaps when the other cloud comes closer than this

    def __post_init__(self) -> None:
        """Refuse what cannot be drawn."""
        if self.size < 4:
            raise ValueError(
                "a protocol must leave at least 4 points: round(points * keep); got "
                f"points={self.points}, keep={self.keep}. Raise one of the two."
            )
        if not 0.0 < self.keep <= 1.0:
            raise ValueError(f"keep must be in (0, 1]; got {self.keep}. Use 0.7 as the paper.")
        for name in ("max_angle_deg", "max_translation", "noise_sigma", "noise_clip"):
            if not 0.0 <= getattr(self, name) < math.inf:
                raise ValueError(
                    f"{name} must be finite and not negative; got {getattr(self, name)}."
                )
        if not self.overlap_radius > 0.0:
            raise ValueError(f"overlap_radius must be positive; got {self.overlap_radius}.")

    @property
    def size(self) -> int:
        """Points of each cloud after the crop."""
        return round(self.points * self.keep)


class PairDraw(NamedTuple):
    """Every random choice of one pair: rows of the shape, the source's motion, the noise."""

    source_rows: Int[Array, " n"]
    target_rows: Int[Array, " n"]
    source_from_target: Rigid
    source_noise: Float[Array, "n 3"]
    target_noise: Float[Array, "n 3"]


def make_pair(
    key: PRNGKeyArray,
    points: Float[Array, "s 3"],
    normals: Float[Array, "s 3"],
    protocol: Protocol,
) -> Pair:
    """One pair of a shape under the protocol: a pure function of the key."""
    return assemble(draw_pair(key, points, protocol), points, normals, protocol.overlap_radius)


def draw_pair(key: PRNGKeyArray, points: Float[Array, "s 3"], protocol: Protocol) -> PairDraw:
    """Choose the points, the crops, the motion and the noise of one pair.

    Both clouds are drawn from the shape independently (`disjoint`: from two halves of it), and
    each is cut by a plane of its own. Fewer points than asked for are repeated.

    Raises:
        ValueError: a disjoint draw of more points than the shape has.
    """
    rows_key, crop_key, motion_key, noise_key = jax.random.split(key, 4)
    total = points.shape[0]
    if protocol.disjoint:
        if 2 * protocol.points > total:
            raise ValueError(
                f"disjoint clouds of {protocol.points} points need shapes of at least "
                f"{2 * protocol.points}; got {total}. Lower points, or set disjoint=False."
            )
        order = jax.random.permutation(rows_key, total)
        rows = [order[: protocol.points], order[protocol.points : 2 * protocol.points]]
    else:
        rows = [resample(k, total, protocol.points) for k in jax.random.split(rows_key)]
    cropped = [
        drawn[half_space_crop(points[drawn], random_direction(k), protocol.size)]
        for drawn, k in zip(rows, jax.random.split(crop_key), strict=True)
    ]
    motion = rigid.random_rigid(
        motion_key, math.radians(protocol.max_angle_deg), protocol.max_translation
    )
    noise = protocol.noise_sigma * jax.random.normal(noise_key, (2, protocol.size, 3))
    noise = jnp.clip(noise, -protocol.noise_clip, protocol.noise_clip)
    return PairDraw(cropped[0], cropped[1], motion, noise[0], noise[1])


def assemble(
    draw: PairDraw,
    points: Float[Array, "s 3"],
    normals: Float[Array, "s 3"],
    overlap_radius: float,
) -> Pair:
    """Follow a pair draw on a shape's points (s, 3) and unit normals (s, 3).

    The source is the moved cloud, so the true pose is the inverse of the drawn motion.
    """
    moved = rigid.apply(draw.source_from_target, points[draw.source_rows])
    turned = rigid.apply(
        Rigid(draw.source_from_target.rotation, jnp.zeros(3)), normals[draw.source_rows]
    )
    source = moved + draw.source_noise
    target = points[draw.target_rows] + draw.target_noise
    target_from_source = rigid.invert(draw.source_from_target)
    size = jnp.asarray(source.shape[0])
    aligned = Cloud(rigid.apply(target_from_source, source), size)
    overlap = _overlap_labels(aligned, Cloud(target, size), overlap_radius)
    return Pair(
        source=Cloud(source, size),
        target=Cloud(target, size),
        target_from_source=target_from_source,
        source_overlap=overlap[0],
        target_overlap=overlap[1],
        source_normals=turned,
        target_normals=normals[draw.target_rows],
    )


def perturbed_pose(
    key: PRNGKeyArray, pair: Pair, max_angle_deg: float, shift_sigma: float
) -> Rigid:
    """The true motion, then a turn about the source's centroid and a shift.

    Both grow with one uniform number, up to the angle and the shift's deviation per component.
    """
    amount_key, direction_key = jax.random.split(key)
    amount = jax.random.uniform(amount_key)
    axis, shift = jax.random.normal(direction_key, (2, 3))
    turn = rigid.rotation_about(axis / jnp.linalg.norm(axis), amount * math.radians(max_angle_deg))
    centre = rigid.apply(pair.target_from_source, _centroid(pair.source)[None])[0]
    shift = centre - turn @ centre + amount * shift_sigma * shift
    return rigid.compose(Rigid(turn, shift), pair.target_from_source)


def initial_pose(key: PRNGKeyArray, pair: Pair) -> Rigid:
    """What a pass of a network may start from: nothing but aligned centroids, or the pose roughly.

    Two in five pairs start from the centroids, the others up to 40 degrees and 0.2 off.
    """
    choice_key, motion_key = jax.random.split(key)
    roughly = perturbed_pose(motion_key, pair, max_angle_deg=40.0, shift_sigma=0.2)
    shift = _centroid(pair.target) - _centroid(pair.source)
    blind = jax.random.uniform(choice_key) < 0.4
    return jax.tree.map(
        lambda a, b: jnp.where(blind, a, b), Rigid(jnp.eye(3, dtype=shift.dtype), shift), roughly
    )


def perturbed_overlap(
    key: PRNGKeyArray, pair: Pair, overlap_radius: float
) -> tuple[Bool[Array, " n"], Bool[Array, " m"]]:
    """Overlap labels as wrong as a network's may be, more in one pair than in another.

    A fifth are the true ones and a fifth say that every point overlaps. The others are the labels
    under a perturbed pose: in parts too many points, in parts too few.
    """
    choice_key, motion_key = jax.random.split(key)
    choice = jax.random.uniform(choice_key)
    motion = perturbed_pose(motion_key, pair, max_angle_deg=30.0, shift_sigma=0.1)
    aligned = pair.source._replace(points=rigid.apply(motion, pair.source.points))
    labels = _overlap_labels(aligned, pair.target, overlap_radius)
    truth = pair.source_overlap, pair.target_overlap
    valid = pair.source.valid, pair.target.valid
    source, target = (
        jnp.where(choice < 0.2, true, (choice < 0.4) | label) & rows
        for true, label, rows in zip(truth, labels, valid, strict=True)
    )
    return source, target


def transform_source(pair: Pair, motion: Rigid) -> Pair:
    """The same pair with the source moved already."""
    source = pair.source._replace(points=rigid.apply(motion, pair.source.points))
    rest = rigid.compose(pair.target_from_source, rigid.invert(motion))
    return pair._replace(source=source, target_from_source=rest)


def _overlap_labels(
    aligned: Cloud, target: Cloud, radius: float
) -> tuple[Bool[Array, " n"], Bool[Array, " m"]]:
    """Which points have a neighbour in the other cloud closer than ``radius``, once aligned."""
    near = squared_distances(aligned.points, target.points) < radius * radius
    near &= aligned.valid[:, None] & target.valid[None, :]
    return jnp.any(near, axis=1), jnp.any(near, axis=0)


def _centroid(cloud: Cloud) -> Float[Array, "3"]:
    """The mean of the valid points."""
    points = jnp.where(cloud.valid[:, None], cloud.points, 0.0)
    return jnp.sum(points, axis=0) / divisor(cloud.count, points.dtype)
