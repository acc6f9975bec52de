"""Padding never leaks: one property over every function that takes a `Cloud` or a `Pair`.

The same points with some garbage after them, and with more and other garbage, must give the same
answers for the valid rows.
"""

import ast
import dataclasses
import functools
from collections.abc import Callable
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dbdnet_jax.classical import refine as em_icp
from dbdnet_jax.data import pairs
from dbdnet_jax.data.pairs import Protocol, make_pair
from dbdnet_jax.metrics import pose
from dbdnet_jax.networks.dbdnet import register as dbdnet
from dbdnet_jax.ops import pyramid, rigid
from dbdnet_jax.training import losses
from dbdnet_jax.types import Cloud, Pair, Rigid
from tests.conftest import Tolerance, assert_close, random_cloud
from tests.networks.dbdnet.small import SMALL, small_params

PACKAGE = Path(pairs.__file__).parents[1]
SIZE, TOTAL = 48, 400
# The same sums over more rows, some of them zero: another order of float32's rounding.
REORDERED = Tolerance(rtol=1e-4, atol=1e-5)
# A whole network, or thirty steps of refinement, stretch that rounding; garbage is a thousand.
STRETCHED = Tolerance(rtol=1e-3, atol=5e-3)
KEY = jax.random.key(3)
KEYS = jax.random.split(KEY, 6)
MODEL = dataclasses.replace(SMALL, overlap_matching=True, overlap_passes=2)
ROUGH = Rigid(jnp.eye(3), jnp.array([0.1, -0.05, 0.02]))

# Functions that take a cloud or a pair and have no row here, each with the reason.
EXEMPT = {
    "stack_clouds": "it makes padding",
    "centre_and_order": "part of register_clouds, whose rows are compared here",
    "truncate_rows": "part of register_clouds",
    "move_source": "part of register_clouds",
    "prepare_pair": "part of predict_overlap",
    "build_pyramids": "build_pyramid of two clouds",
    "predict_given_overlap": "register_given_overlap",
    "geometry_of": "part of register_clouds",
    "iterate": "part of register_clouds",
    "refine_each": "compared in tests/alignment/test_pose_programs.py, start by start",
    "overlap_loss_of": "overlap_loss of predict_overlap_and_matches",
    "registration_loss_of": "registration_loss of register_given_overlap",
    "joint_turn": "predict_overlap_and_matches and register_given_overlap",
    "joint_start": "joint_turn and initial_pose",
    "joint_loss_of": "the sum of both losses",
    "validate_overlap": "predict_overlap_and_matches and its errors",
    "validate_registration": "register_clouds and its errors",
    "validate_joint": "register_clouds and its errors",
    "predict_pose": "the pose of predict",
    "predict": "of every method: tests/networks/test_peers.py; DBDNet's is register_clouds",
    "overlap_scores": "pair_confusion of an answer, which is compared here",
    "validate": "of every method: predict and the errors of it",
    "neighbours": "part of predict",
    "without_padding": "it is what keeps the padding out",
    "match": "part of DCP's predict",
    "as_channels": "part of INENet's predict",
    "alignment_loss": "batch norms see padding: there must be none in training",
    "turn_losses": "as alignment_loss",
    "labels": "as alignment_loss",
    "loss_of_batch": "as alignment_loss",
    "evaluate_method": "takes stacked pairs",
    "evaluate_methods": "takes stacked pairs",
    "constant_overlap": "takes stacked pairs; pair_confusion of each",
}


def shape_pair() -> Pair:
    """A pair of unequal counts, without padding; the target has fewer points."""
    points = random_cloud(0, TOTAL).astype(np.float32)
    protocol = Protocol(points=SIZE, keep=1.0, noise_sigma=0.0, overlap_radius=0.3)
    pair = make_pair(jax.random.key(1), jnp.asarray(points), jnp.asarray(points), protocol)
    fewer = Cloud(pair.target.points[: SIZE - 7], jnp.asarray(SIZE - 7))
    return pair._replace(
        target=fewer,
        target_overlap=pair.target_overlap[: SIZE - 7],
        target_normals=pair.target_normals[: SIZE - 7],
    )


PAIR = shape_pair()
COUNTS = int(PAIR.source.count), int(PAIR.target.count)


def padded(pair: Pair, rows: int, garbage: float) -> Pair:
    """The pair with ``rows`` more rows in every array of points, all of them garbage."""

    def longer(leaf):
        if not leaf.ndim or leaf.shape == (3, 3) or leaf.shape == (3,):
            return leaf
        filler = jnp.full((rows, *leaf.shape[1:]), garbage if leaf.ndim > 1 else True, leaf.dtype)
        return jnp.concatenate([leaf, filler])

    return jax.tree.map(longer, pair)


def rows_of(array, *axes: int):
    """The valid rows of an array whose ``axes`` are rows of cloud 0 or 1."""
    for axis, cloud in enumerate(axes):
        array = jnp.take(array, jnp.arange(COUNTS[cloud]), axis=axis)
    return array


def of_registration(answer):
    """What a registration says of valid rows."""
    return (
        answer.rotation,
        answer.translation,
        rows_of(answer.src_overlap, 0),
        rows_of(answer.tgt_overlap, 1),
        rows_of(answer.src_kept, 0),
        rows_of(answer.rotation_branch.correspondence, 0, 1),
        rows_of(answer.translation_branch.target, 0),
        rows_of(answer.confidence, 0),
    )


@functools.cache
def params():
    """Small weights in float32, drawn outside any trace."""
    with jax.ensure_compile_time_eval():
        return small_params(1, MODEL, np.float32)


def labels(pair: Pair):
    """True labels as probabilities; what stands in the padding is garbage too."""
    return pair.source_overlap.astype(float), pair.target_overlap.astype(float)


def perturbed_labels(pair: Pair):
    """Labels of several draws, and how many there are, padding included."""
    source, target = jax.vmap(lambda key: pairs.perturbed_overlap(key, pair, 0.3))(KEYS)
    return source[:, : COUNTS[0]], target[:, : COUNTS[1]], jnp.sum(source), jnp.sum(target)


def whole_pyramid(pair: Pair):
    """Neighbours and weights of the valid points at the finest level."""
    found = pyramid.build_pyramid(pair.source, 5)
    return rows_of(found.levels[0].neighbours, 0), rows_of(found.up[0][0][1], 0)


def transformed(pair: Pair):
    """The moved pair's own points and pose."""
    moved = pairs.transform_source(pair, ROUGH)
    return rows_of(moved.source.points, 0), moved.target_from_source


def matched_loss(pair: Pair):
    """The loss of a matching that is even over the valid rows and garbage elsewhere."""
    even = jnp.full((len(pair.source.points), len(pair.target.points)), -4.0)
    return losses.matching_loss(even, pair.source, pair.target, pair.target_from_source)


def predicted(pair: Pair):
    """Overlap, the motion that the matches ask for, and the loss of both."""
    source, target, matched = dbdnet.predict_overlap_and_matches(params(), pair.source, pair.target)
    alone = dbdnet.predict_overlap(params(), pair.source, pair.target)
    loss = losses.overlap_loss(source, target, pair, matched=matched)[0]
    return [rows_of(x, c % 2) for c, x in enumerate((source, target, *alone))], matched.motion, loss


def registered(pair: Pair):
    """What the networks answer, its loss and its errors."""
    answer = dbdnet.register_clouds(params(), pair.source, pair.target)
    loss = losses.registration_loss(answer, pair, losses.LossWeights())[0]
    return of_registration(answer), loss, pose.motion_errors(answer.motion, pair.target_from_source)


FUNCTIONS: dict[str, Callable[[Pair], object]] = {
    "build_pyramid": whole_pyramid,
    "perturbed_pose": lambda p: pairs.perturbed_pose(KEY, p, 40.0, 0.2),
    "initial_pose": lambda p: jax.vmap(lambda key: pairs.initial_pose(key, p))(KEYS),
    "perturbed_overlap": perturbed_labels,
    "transform_source": transformed,
    "point_distance": lambda p: pose.point_distance(ROUGH, p),
    "pair_confusion": lambda p: pose.pair_confusion(*labels(p), p),
    "matching_loss": matched_loss,
    "refine": lambda p: em_icp.refine(p.source, p.target, ROUGH),
    "refine_multistart": lambda p: em_icp.refine_multistart(p.source, p.target, ROUGH),
    "refine_from_rotations": lambda p: (
        em_icp.refine_from_rotations(p.source, p.target, rigid.identity(), (90.0,)).truncated_rmse
    ),
    "truncated_rmse": lambda p: em_icp.truncated_rmse(p.source, p.target, ROUGH),
    "register_clouds registration_loss": registered,
    "register_given_overlap": lambda p: of_registration(
        dbdnet.register_given_overlap(params(), p.source, p.target, *labels(p))
    ),
    "predict_overlap predict_overlap_and_matches overlap_loss": predicted,
}


@pytest.mark.parametrize("name", FUNCTIONS)
def test_padding_changes_nothing(name):
    function = jax.jit(FUNCTIONS[name])
    stretches = any(word in name for word in ("refine", "register", "predict"))
    some, more = (
        jax.tree.leaves(function(padded(PAIR, rows, garbage)))
        for rows, garbage in ((SIZE // 2, 1e3), (SIZE, np.nan))
    )
    for one, other in zip(more, some, strict=True):
        assert_close(one, other, STRETCHED if stretches else REORDERED)


def functions_of_clouds() -> set[str]:
    """Public functions of the package with an argument that is a `Cloud` or a `Pair`."""
    found = set()
    for path in PACKAGE.rglob("*.py"):
        for node in ast.parse(path.read_text()).body:
            if isinstance(node, ast.FunctionDef) and not node.name.startswith("_"):
                hints = [a.annotation for a in (*node.args.args, *node.args.kwonlyargs)]
                names = {h.id for h in hints if isinstance(h, ast.Name)}
                if names & {"Cloud", "Pair"}:
                    found.add(node.name)
    return found


def test_every_function_of_clouds_and_pairs_is_held_to_it():
    assert functions_of_clouds() - set(" ".join(FUNCTIONS).split()) - set(EXEMPT) == set()
    assert set(EXEMPT) <= functions_of_clouds()


def test_scans_shorter_than_their_rows_start_and_are_labelled_as_they_are():
    """300 points of a scan in 1,200 rows: the padding once moved the start by 3.75 units."""
    points = jnp.asarray(random_cloud(7, 300) + 5.0, jnp.float32)
    cloud = Cloud(points, jnp.asarray(300))
    still = Pair(cloud, cloud, rigid.identity(), *[jnp.ones(300, bool)] * 2, points, points)
    long = padded(still, 900, 0.0)
    starts = jax.jit(jax.vmap(lambda key: pairs.initial_pose(key, long)))(KEYS)
    moved = jax.vmap(lambda start: jnp.mean(rigid.apply(start, points), axis=0))(starts)
    off = jnp.linalg.norm(moved - jnp.mean(points, axis=0)[None], axis=1)
    assert off.max() < 1.5 and off.min() < 1e-5  # some start from the centroids
    labels = jax.jit(jax.vmap(lambda key: pairs.perturbed_overlap(key, long, 0.5)))(KEYS)
    assert not any(np.asarray(label[:, 300:]).any() for label in labels)
