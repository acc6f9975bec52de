"""Poses of many clouds that agree with the alignments of their pairs (Choi, Zhou & Koltun 2015).

Open3D optimises them and drops what contradicts the rest; its optimiser is local, so the start is
chosen here.
"""

from types import ModuleType
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from dbdnet_jax.ops.transforms import angle_between, as_transform, move
from dbdnet_jax.types import Transform

PRUNED = 0.25  # Open3D's confidence (1 + d^2)^-2 at a disagreement d of 1
# Open3D measures a rotation by its sine, which a half turn brings back to 0.
LARGEST_TURN_DEG = 60.0

Poses = dict[int, Transform]  # by cloud; only of those that are joined to cloud 0


class Constraint(NamedTuple):
    """An alignment of two clouds, in frames about the clouds' centres and in a common unit.

    ``information`` (6, 6) is that of a small rotation about the source's centre and a small
    translation, in the source's frame: what Open3D's optimiser takes. It is scaled so that a
    motion of 1 by it is what may just be tolerated.
    """

    source: int
    target: int
    motion: Transform
    information: Float[np.ndarray, "6 6"]
    probability: float


def in_source_frame(
    transform: Transform,
    information: Float[np.ndarray, "6 6"],
    pivot: Float[np.ndarray, "3"],
    centre: Float[np.ndarray, "3"],
    unit: float,
) -> Float[np.ndarray, "6 6"]:
    """Information of (w, u), which moves target points q by w x (q - pivot) + u, for (a, b).

    (a, b) moves source points p by a x (p - centre) + unit b, before ``transform`` does. It is the
    same motion when w = R a and u = unit R b + w x (pivot - transform(centre)).
    """
    rotation = transform[:3, :3]
    jacobian = np.zeros((6, 6))
    jacobian[:3, :3] = rotation
    jacobian[3:, :3] = np.cross(rotation.T, pivot - move(transform, centre)).T
    jacobian[3:, 3:] = unit * rotation
    return jacobian.T @ information @ jacobian


def best_start(constraints: list[Constraint]) -> Poses:
    """Poses along a tree of alignments that most of the others agree with.

    First the tree of the most probable ones; then, as long as it helps, without one of those.
    """
    poses, tree = _grow(constraints)
    support, allowed = _support(poses, constraints), constraints
    while True:
        trials = []
        for doubted in tree:
            others = [x for x in allowed if x is not doubted]
            grown = _grow(others)
            trials.append((_support(grown[0], constraints), others, grown))
        best = max(trials, key=lambda trial: trial[0], default=None)
        if best is None or best[0] <= support + 1e-9:
            return poses
        support, allowed, (poses, tree) = best


def _grow(constraints: list[Constraint]) -> tuple[Poses, list[Constraint]]:
    """Poses along the tree of the most probable alignments from cloud 0 (Prim), and the tree."""
    poses: Poses = {0: np.eye(4)}
    tree: list[Constraint] = []
    while border := [x for x in constraints if (x.source in poses) != (x.target in poses)]:
        best = max(border, key=lambda x: x.probability)
        if best.source in poses:
            poses[best.target] = poses[best.source] @ np.linalg.inv(best.motion)
        else:
            poses[best.source] = poses[best.target] @ best.motion
        tree.append(best)
    return poses, tree


def _support(poses: Poses, constraints: list[Constraint]) -> float:
    """The probabilities of the alignments, as far as the poses agree with them."""
    inside = [x for x in constraints if x.source in poses and x.target in poses]
    agreement = [x.probability / (1 + disagreement(x, poses)[0] ** 2) ** 2 for x in inside]
    return sum(agreement, 0.0)


def disagreement(constraint: Constraint, poses: Poses) -> tuple[float, float]:
    """How far the poses are from an alignment: per what is tolerated, and in degrees."""
    relative = np.linalg.inv(poses[constraint.target]) @ poses[constraint.source]
    error = np.linalg.inv(constraint.motion) @ relative
    angle, axis = angle_between(error, np.eye(4))
    step = np.concatenate([np.radians(angle) * axis, error[:3, 3]])
    return float(np.sqrt(max(step @ constraint.information @ step, 0.0))), angle


def optimise(
    open3d: ModuleType, start: Poses, constraints: list[Constraint]
) -> tuple[Poses, set[tuple[int, int]]]:
    """The consistent poses, and the pairs whose alignments agree with them.

    Every alignment may be dropped; clouds that are then no longer joined to cloud 0 have no pose.
    """
    used = [
        x for x in constraints if x.source in start and disagreement(x, start)[1] < LARGEST_TURN_DEG
    ]
    if not used:
        return start, set()
    pipeline = open3d.pipelines.registration
    graph, clouds = pipeline.PoseGraph(), sorted(start)
    for cloud in clouds:
        graph.nodes.append(pipeline.PoseGraphNode(start[cloud]))
    for x in used:
        ends = clouds.index(x.source), clouds.index(x.target)
        graph.edges.append(
            pipeline.PoseGraphEdge(*ends, x.motion, x.information, uncertain=True, confidence=1.0)
        )
    option = pipeline.GlobalOptimizationOption(
        # Open3D takes the last entry for a number of points; this way the limit is 1 again.
        max_correspondence_distance=np.mean([x.information[5, 5] for x in used]) ** -0.5,
        edge_prune_threshold=PRUNED,
        preference_loop_closure=1.0,
        reference_node=0,
    )
    with open3d.utility.VerbosityContextManager(open3d.utility.VerbosityLevel.Error):
        pipeline.global_optimization(
            graph,
            pipeline.GlobalOptimizationLevenbergMarquardt(),
            pipeline.GlobalOptimizationConvergenceCriteria(),
            option,
        )
    kept = {(clouds[edge.source_node_id], clouds[edge.target_node_id]) for edge in graph.edges}
    joined, _ = _grow([x for x in used if (x.source, x.target) in kept])
    found = zip(clouds, graph.nodes, strict=True)
    poses = {cloud: np.array(node.pose) for cloud, node in found if cloud in joined}
    return {cloud: as_transform(pose[:3, :3], pose[:3, 3]) for cloud, pose in poses.items()}, kept
