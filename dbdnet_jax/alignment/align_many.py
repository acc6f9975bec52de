"""Several clouds of one's own: pairs aligned, then poses that agree with all of them."""

import dataclasses
import itertools
from collections.abc import Sequence
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from dbdnet_jax.alignment.align import Alignment, align
from dbdnet_jax.alignment.arguments import MAX_POINTS, check_transform
from dbdnet_jax.alignment.downsampling import downsample
from dbdnet_jax.alignment.pose_graph import (
    Constraint,
    Poses,
    best_start,
    disagreement,
    in_source_frame,
    optimise,
)
from dbdnet_jax.errors import load_open3d
from dbdnet_jax.io.point_files import read_point_file
from dbdnet_jax.networks.params import Params
from dbdnet_jax.ops.transforms import as_transform, move

ALL_PAIRS = 12  # clouds of which all pairs are aligned unless others are asked for


class Edge(NamedTuple):
    """The alignment of one pair, and what became of it; ``source`` and ``target`` number clouds.

    ``kept``: the alignment is valid, and the other ones agree with it; else ``reason`` says why
    not. ``residual`` is how far the consistent poses move the surfaces that met in the alignment
    (root mean square along their normals, in the clouds' unit; of large motions rather more) and
    ``residual_deg`` how far they turn them; NaN where a cloud has no pose. Nothing can contradict
    an edge that closes no loop: its residual is 0, and all that speaks for it is
    ``alignment.success_probability``.
    """

    source: int
    target: int
    alignment: Alignment
    kept: bool
    reason: str
    residual: float
    residual_deg: float


@dataclasses.dataclass(frozen=True, eq=False)
class MultiAlignment:
    """Poses of ``k`` clouds in the frame of the first one, in the clouds' own unit.

    ``reference_from_cloud[i]`` moves cloud i there. It is NaN, and ``reasons[i]`` says why, where
    no kept edges lead from cloud i to cloud 0.
    """

    reference_from_cloud: Float[np.ndarray, "k 4 4"]
    reasons: tuple[str, ...]
    edges: tuple[Edge, ...] = dataclasses.field(repr=False)

    @property
    def connected(self) -> Bool[np.ndarray, " k"]:
        """Which clouds have a pose."""
        return np.array([not reason for reason in self.reasons])


def align_many(
    clouds: Sequence[Any],
    params: Params | str | Path | None = None,
    *,
    pairs: Sequence[tuple[int, int]] | None = None,
    neighbours: int | None = None,
    initial: Any = None,
    seed: int = 0,
    **options: Any,
) -> MultiAlignment:
    """Bring several clouds into the frame of the first one.

    Every pair is aligned on its own. Alignments that are not valid are left out; no other is
    taken for certain, so one that contradicts the rest is dropped. What remains becomes a pose
    graph, each alignment as stiff in each direction as its surfaces are, and Open3D optimises it::

        many = dbdnet_jax.align_many(["a.ply", "b.ply", "c.ply"])
        pose = many.reference_from_cloud[2]
        c_in_the_frame_of_a = c @ pose[:3, :3].T + pose[:3, 3]

    Args:
      clouds: two or more, each an (n, 3) array or a file as for `align`, in one unit.
      params: the network, or the name or ``.npz`` file of one; that of the package, if None.
      pairs: (source, target) numbers of the clouds to align; all pairs, if None and the clouds
        are at most 12. Pairs that close loops let wrong alignments be found out.
      neighbours: of clouds in the order in which they were scanned, align each with so many that
        follow it, and with ``pairs`` besides: 4 of them take 390 alignments for 100 clouds, not
        4,950. From 2 on there are loops.
      initial: rough ``reference_from_cloud`` (k, 4, 4); each pair's own guess follows from it.
      seed: of the points drawn on meshes; nothing else is random.
      **options: of every `align`: ``refine``, ``search``, ``scale``, ``overlap_threshold`` and
        ``max_points``.

    Raises:
      ValueError: clouds, pairs or arguments of no use.
      OSError: a file that cannot be read.
      ImportError: Open3D is absent; says what to install.
    """
    open3d = load_open3d("align_many")
    chosen = _check_pairs(len(clouds), pairs, neighbours)
    guesses = None if initial is None else _check_initial(initial, len(clouds))
    read = [read_point_file(x, f"clouds[{i}]", seed=seed + i) for i, x in enumerate(clouds)]
    alignments = {}
    for i, j in chosen:
        guess = None if guesses is None else np.linalg.inv(guesses[j]) @ guesses[i]
        alignments[i, j] = align(read[i], read[j], params, initial=guess, **options)
    return _agree(open3d, [cloud.points for cloud in read], alignments)


def _agree(
    open3d: ModuleType,
    points: list[Float[np.ndarray, "_ 3"]],
    alignments: dict[tuple[int, int], Alignment],
) -> MultiAlignment:
    """Consistent poses out of the alignments of pairs."""
    # Distant or large coordinates would cost the optimiser its digits.
    chosen = [downsample(cloud, MAX_POINTS) for cloud in points]
    centres = [rows.centre for rows in chosen]
    unit = max(rows.size for rows in chosen)
    constraints = {
        (i, j): _constraint(i, j, alignment, centres[i], centres[j], unit)
        for (i, j), alignment in alignments.items()
        if alignment.valid
    }
    valid = list(constraints.values())
    poses, kept = optimise(open3d, best_start(valid), valid)
    edges = tuple(
        _edge(pair, alignment, constraints.get(pair), pair in kept, poses)
        for pair, alignment in alignments.items()
    )
    placed = np.full((len(points), 4, 4), np.nan)
    for i, pose in poses.items():
        placed[i] = pose
        placed[i, :3, 3] = unit * pose[:3, 3] + centres[0] - pose[:3, :3] @ centres[i]
    reasons = tuple("" if i in poses else _why_alone(i, edges) for i in range(len(points)))
    return MultiAlignment(placed, reasons, edges)


def _constraint(
    source: int,
    target: int,
    alignment: Alignment,
    source_centre: Float[np.ndarray, "3"],
    target_centre: Float[np.ndarray, "3"],
    unit: float,
) -> Constraint:
    """What the pose graph gets to know of an alignment."""
    moved = move(alignment.transform, source_centre)
    information = in_source_frame(
        alignment.transform, alignment.information, alignment.pivot, source_centre, unit
    )
    # Weighed by neither the number of points nor their noise, as `Alignment.information` is: what
    # is wrong with a pose is nothing that more points would average out.
    # What may just be tolerated is to move its surfaces by the inlier distance.
    weight = np.trace(alignment.information[3:, 3:]) * alignment.inlier_distance**2
    return Constraint(
        source,
        target,
        as_transform(alignment.rotation, (moved - target_centre) / unit),
        information / weight,
        alignment.success_probability,
    )


def _edge(
    pair: tuple[int, int],
    alignment: Alignment,
    constraint: Constraint | None,
    kept: bool,
    poses: Poses,
) -> Edge:
    """What became of an alignment."""
    if constraint is None:
        return Edge(*pair, alignment, False, alignment.reason, np.nan, np.nan)
    placed = sum(cloud in poses for cloud in pair)
    if placed < 2:
        alone = "the others contradict it, and no other alignment joins its clouds"
        reason = alone if placed else "leads to no cloud with a pose"
        return Edge(*pair, alignment, False, reason, np.nan, np.nan)
    share, degrees = disagreement(constraint, poses)
    residual = share * alignment.inlier_distance
    reason = f"the others contradict it: off by {degrees:.1f} degrees and {residual:.3g}"
    return Edge(*pair, alignment, kept, "" if kept else reason, residual, degrees)


def _why_alone(cloud: int, edges: tuple[Edge, ...]) -> str:
    """Why a cloud has no pose."""
    own = [edge for edge in edges if cloud in (edge.source, edge.target)]
    if not own:
        return f"no pair with cloud {cloud} was given"
    best = max(own, key=lambda edge: (edge.alignment.valid, edge.alignment.success_probability))
    other = best.source + best.target - cloud
    return f"its best alignment, with cloud {other}: {best.reason}"


def _check_pairs(
    count: int, pairs: Sequence[tuple[int, int]] | None, neighbours: int | None
) -> Sequence[tuple[int, int]]:
    """The pairs asked for, or all."""
    if count < 2:
        raise ValueError(f"clouds must be at least two; got {count}.")
    if neighbours is not None and neighbours < 1:
        raise ValueError(f"neighbours must be at least 1; got {neighbours}. Use 4.")
    if pairs is None and neighbours is None:
        every = list(itertools.combinations(range(count), 2))
        if count > ALL_PAIRS:
            raise ValueError(
                f"pairs must be given for more than {ALL_PAIRS} clouds; got {count}, which have "
                f"{len(every)} pairs. Name those that overlap, pairs=[(0, 1), (1, 2), ...], or, of "
                "clouds in the order of scanning, neighbours=4."
            )
        return every
    chosen = [(int(i), int(j)) for i, j in pairs or ()]
    for i, j in chosen:
        if i == j or not (0 <= i < count and 0 <= j < count) or chosen.count((i, j)) > 1:
            raise ValueError(
                f"pairs must be different and of two clouds in 0..{count - 1}; got ({i}, {j}). "
                "Name each pair once, clouds counted from 0."
            )
    named = {frozenset(pair) for pair in chosen}
    following = [(i, j) for i in range(count) for j in range(i + 1, i + 1 + (neighbours or 0))]
    return [x for x in following if x[1] < count and frozenset(x) not in named] + chosen


def _check_initial(initial: Any, count: int) -> Float[np.ndarray, "k 4 4"]:
    if np.shape(initial) != (count, 4, 4):
        raise ValueError(
            f"initial must hold a 4x4 pose for each of the {count} clouds; got shape "
            f"{np.shape(initial)}. Stack one for each cloud, the identity where nothing is known."
        )
    return np.stack([check_transform(x, f"initial[{i}]") for i, x in enumerate(initial)])
