"""The whole network: padding, masks, row order and position must not matter to it."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dbdnet_jax.networks.dbdnet.config import ModelConfig
from dbdnet_jax.networks.dbdnet.register import (
    predict_overlap_and_matches,
    register,
    register_given_overlap,
    select,
)
from dbdnet_jax.networks.table import parameter_shapes
from dbdnet_jax.ops import rigid
from dbdnet_jax.types import Branch, Cloud, Registration, Rigid
from tests import oracle
from tests.conftest import EXACT, assert_close, random_cloud
from tests.networks.dbdnet.small import NETWORK, SMALL, cast, overlap_alone, small_params

N, COUNT, M = 64, 52, 49
SOURCE, TARGET = random_cloud(0, COUNT), random_cloud(1, M)
traces = []


@jax.jit
def register_counted(*arguments):
    """`register`, leaving a mark whenever it is traced."""
    traces.append(1)
    return register(*arguments)


def spread(points, rows, size: int, garbage: float = np.nan):
    """``points`` at these rows of a cloud of ``size`` rows, and the mask that says so."""
    cloud, mask = np.full((size, 3), garbage), np.zeros(size, bool)
    cloud[rows], mask[rows] = points, True
    return jnp.asarray(cloud), jnp.asarray(mask)


def register_spread(params, source, target, size: int = N, garbage: float = np.nan, rows=None):
    """Register two clouds padded to one size; ``rows`` are the places of their points."""
    rows = rows or (np.arange(len(source)), np.arange(len(target)))
    src, src_mask = spread(source, rows[0], size, garbage)
    tgt, tgt_mask = spread(target, rows[1], size, garbage)
    return register_counted(params, src, tgt, src_mask, tgt_mask)


def taken(answer: Registration, rows, columns) -> Registration:
    """The answer for these rows of the source and of the target."""
    branches = (
        Branch(b.correspondence[rows][:, columns], b.target[rows], b.confidence[rows])
        for b in (answer.rotation_branch, answer.translation_branch)
    )
    rotation_branch, translation_branch = branches
    return answer._replace(
        src_overlap=answer.src_overlap[rows],
        tgt_overlap=answer.tgt_overlap[columns],
        src_kept=answer.src_kept[rows],
        tgt_kept=answer.tgt_kept[columns],
        rotation_branch=rotation_branch,
        translation_branch=translation_branch,
        confidence=answer.confidence[rows],
    )


def assert_same_answer(found: Registration, expected: Registration):
    """Every field; soft targets of the kept rows only."""
    for (path, a), b in zip(
        jax.tree.leaves_with_path(found), jax.tree.leaves(expected), strict=True
    ):
        if jax.tree_util.keystr(path).endswith("branch.target"):
            a, b = a[found.src_kept], b[expected.src_kept]
        assert a.dtype == b.dtype, path
        assert_close(a, b, NETWORK if a.dtype == np.float64 else EXACT)


LIMITED = dataclasses.replace(
    SMALL,
    overlap_matching=True,
    overlap_passes=2,
    overlap_points=40,
    registration_points=24,
)


# In the first nearly all points pass the threshold, in the second too few, so the best are kept;
# in the third the networks see fewer points than there are, match them, and both go twice.
@pytest.fixture(params=[(5, SMALL), (0, SMALL), (5, LIMITED)], ids=["threshold", "fewest", "limit"])
def params(request, x64):
    """Parameters of a small network."""
    return small_params(*request.param)


@pytest.fixture
def answer(params):
    """What they say of both clouds, without padding or masks."""
    answer = jax.jit(register)(params, jnp.asarray(SOURCE), jnp.asarray(TARGET))
    assert answer.valid
    assert np.linalg.norm(answer.rotation - np.eye(3)) > 0.1
    return answer


@pytest.mark.parametrize("garbage", [0.0, np.nan, 1e3])
def test_padding_does_not_matter(params, answer, garbage):
    found = register_spread(params, SOURCE, TARGET, 2 * N, garbage)
    assert_same_answer(taken(found, slice(COUNT), slice(M)), answer)


def test_several_passes_are_both_networks_in_turn(x64):
    params = small_params(5, LIMITED)
    source, target = (Cloud(jnp.asarray(x), jnp.asarray(len(x))) for x in (SOURCE, TARGET))
    motion = Rigid(jnp.eye(3), jnp.asarray(TARGET.mean(0) - SOURCE.mean(0)))
    predict, solve = jax.jit(predict_overlap_and_matches), jax.jit(register_given_overlap)
    for _ in range(LIMITED.overlap_passes):
        *overlap, _ = predict(params, source, target, start=motion)
        moved = source._replace(points=rigid.apply(motion, source.points))
        step = solve(params, moved, target, *overlap)
        motion = rigid.compose(Rigid(step.rotation, step.translation), motion)
    found = jax.jit(register)(params, source.points, target.points)
    assert_close(found.rotation, motion.rotation, NETWORK)
    assert_close(found.translation, motion.translation, NETWORK)
    assert_close(found.src_overlap, overlap[0], NETWORK)


def test_any_mask_will_do(params, answer):
    rng = np.random.default_rng(2)
    rows = [np.sort(rng.choice(2 * N, size, replace=False)) for size in (COUNT, M)]
    found = register_spread(params, SOURCE, TARGET, 2 * N, rows=rows)
    assert_same_answer(taken(found, *rows), answer)
    others = [np.setdiff1d(np.arange(2 * N), x) for x in rows]
    rest = taken(found, *others)
    assert not np.any(rest.src_kept) and not np.any(rest.tgt_kept)
    for field in (rest.src_overlap, rest.tgt_overlap, rest.confidence):
        assert not np.any(field)
    for branch in (found.rotation_branch, found.translation_branch):
        assert not np.any(branch.correspondence[others[0]])
        assert not np.any(branch.correspondence[:, others[1]])


def test_a_limit_keeps_the_points_farthest_from_each_other(x64):
    config = dataclasses.replace(LIMITED, registration_points=8)
    answer = register_spread(small_params(5, config), SOURCE, TARGET)
    above = np.flatnonzero(answer.src_overlap > 0.5)
    assert len(above) > 8
    expected = above[oracle.farthest_samples(SOURCE[above] - SOURCE[above].mean(0), 8)]
    assert_close(np.flatnonzero(answer.src_kept), np.sort(expected), EXACT)


def test_permuting_the_points_permutes_the_answer(x64):
    # Row 0 stays: farthest-point sampling starts there. So does the threshold: below it, the most
    # probable point comes first.
    params = small_params(5)
    rng = np.random.default_rng(3)
    rows, columns = (np.r_[0, 1 + rng.permutation(size - 1)] for size in (COUNT, M))
    answer = register_spread(params, SOURCE, TARGET)
    assert answer.src_kept[0] and answer.tgt_kept[0]
    found = register_spread(params, SOURCE[rows], TARGET[columns])
    expected = taken(answer, rows, columns)
    assert_same_answer(taken(found, slice(COUNT), slice(M)), expected)


def test_moving_a_cloud_moves_the_translation_only(params):
    # Multiples of 1/1024 and 64 points: the centroid is subtracted without rounding.
    source, target = (np.round(random_cloud(seed, N) * 1024) / 1024 for seed in (4, 5))
    shifts = np.array([[3.0, -5.5, 0.25], [-17.0, 2.0, 8.0]])
    answer = register_spread(params, source, target)
    moved = register_spread(params, source + shifts[0], target + shifts[1])
    assert_close(moved.src_overlap, answer.src_overlap, EXACT)
    assert_close(moved.tgt_overlap, answer.tgt_overlap, EXACT)
    assert_close(moved.rotation, answer.rotation, NETWORK)
    assert_close(moved.confidence, answer.confidence, NETWORK)
    expected = answer.translation + shifts[1] - answer.rotation @ shifts[0]
    assert_close(moved.translation, expected, NETWORK)
    kept = np.asarray(answer.src_kept)
    for found, still in zip(moved[6:8], answer[6:8], strict=True):
        assert_close(found.target[kept], np.asarray(still.target)[kept] + shifts[1], NETWORK)


def test_the_same_shapes_are_traced_once(x64):
    params = small_params(6)
    register_spread(params, SOURCE, TARGET)
    before = len(traces)
    assert before
    register_spread(small_params(7), TARGET, SOURCE)
    assert len(traces) == before


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_the_answer_has_the_type_of_the_clouds(dtype, x64):
    src, tgt = (jnp.asarray(x, dtype) for x in (SOURCE, TARGET))
    for params in (cast(small_params(), x) for x in (np.float32, dtype)):
        answer = jax.eval_shape(register, params, src, tgt)
        assert {leaf.dtype for leaf in jax.tree.leaves(answer)} == {np.dtype(dtype), np.dtype(bool)}


def test_overlap_parameters_alone_do_not_register(x64):
    alone = overlap_alone(small_params())
    with pytest.raises(ValueError, match="these params hold overlap. Load a full set"):
        register(alone, jnp.asarray(SOURCE), jnp.asarray(TARGET))


def test_the_rows_above_the_threshold_are_kept_or_else_the_most_probable():
    probability = jnp.asarray([0.2, 0.9, 0.5, 0.6, 0.1, 0.7, 0.99])
    order, count = select(probability, jnp.asarray(6), 0.5, 3)
    assert order[:count].tolist() == [1, 3, 5]  # 0.5 itself is not above, row 6 is padding
    order, count = select(probability, jnp.asarray(6), 0.5, 4)
    assert order[:count].tolist() == [1, 5, 3, 2]
    order, count = select(probability, jnp.asarray(2), 0.5, 4)
    assert order[:count].tolist() == [1, 0]


@pytest.mark.parametrize(
    ("network", "declared"),
    # The released code declares an attention pair more and never uses it: 527,360 parameters.
    [("overlap", 6_306_817 - 527_360), ("registration", 2_851_268)],
)
def test_the_released_configuration_has_as_many_parameters(network, declared):
    shapes = parameter_shapes(ModelConfig(), (network,))
    assert sum(int(np.prod(shape)) for shape in shapes.values()) == declared


def test_the_unused_pair_has_the_size_of_two_attentions_and_their_norms():
    shapes = parameter_shapes(ModelConfig(), ("overlap",))
    block = [shape for name, shape in shapes.items() if name.startswith("overlap/attention_0/")]
    assert sum(int(np.prod(shape)) for shape in block) == 527_360
