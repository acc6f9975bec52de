"""`align_many`: consistent poses, wrong edges dropped, clouds without a pose named."""

import importlib
import sys

import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from dbdnet_jax.alignment import pose_graph, pose_programs
from dbdnet_jax.alignment import validity as verdict
from dbdnet_jax.alignment.align import Alignment, Matches
from dbdnet_jax.alignment.align_many import align_many
from dbdnet_jax.alignment.success import PoseFeatures
from dbdnet_jax.ops.transforms import move
from tests.aligning import POINTS, motion, rotation_error_deg, solid, tiny_params
from tests.conftest import random_cloud

module = importlib.import_module("dbdnet_jax.alignment.align_many")  # not the function
INLIER = 0.05


@pytest.fixture(autouse=True)
def needs_open3d():
    pytest.importorskip("open3d", reason="the baselines extra (Open3D) is not installed")


def surface(seed: int, count: int = 60) -> tuple[np.ndarray, np.ndarray]:
    """Points and unit normals that hold some directions much better than others."""
    normals = random_cloud(seed, count) * [1.0, 0.4, 0.1]
    return random_cloud(seed + 1, count), normals / np.linalg.norm(normals, axis=1, keepdims=True)


def aligned(transform, probability=0.9, reason="", seed=0) -> Alignment:
    """What `align` would say, with the information of `surface` in the target's frame."""
    points, normals = surface(seed)
    pivot = points.mean(axis=0)
    jacobian = np.hstack([np.cross(points - pivot, normals), normals])
    rows = np.zeros(0, int)
    return Alignment(
        transform=transform,
        valid=not reason,
        reason=reason,
        success_probability=probability,
        warnings=(),
        inlier_ratio=0.7,
        inlier_distance=INLIER,
        rmse=0.01,
        source_overlap=np.ones(1),
        target_overlap=np.ones(1),
        matches=Matches(rows, rows, np.zeros(0)),
        information=jacobian.T @ jacobian / 0.01**2,
        pivot=pivot,
        evidence=PoseFeatures(*[0.0] * len(PoseFeatures._fields)),
        timings={},
    )


def cloud(number: int) -> np.ndarray:
    """Thirty points, and a stray far away."""
    return np.vstack([random_cloud(number, 30), np.full((1, 3), 1e6)])


def poses(count: int, degrees: float = 70.0) -> np.ndarray:
    """(k, 4, 4) reference_from_cloud; the first is the reference."""
    return np.array([np.eye(4)] + [motion(i, degrees) for i in range(1, count)])


def between(true: np.ndarray, i: int, j: int) -> np.ndarray:
    return np.linalg.inv(true[j]) @ true[i]


@pytest.fixture
def stand_in(monkeypatch):
    """Clouds whose pairs align as told: ``stand_in(answers)`` gives `align_many` of them."""

    def run(answers: dict[tuple[int, int], Alignment], count: int, unit=1.0, place=0.0, **options):
        clouds = [cloud(i) * unit + place * (i + 1) for i in range(count)]
        order = iter(answers)
        monkeypatch.setattr(module, "align", lambda *_, **__: answers[next(order)])
        return align_many(clouds, tiny_params(), pairs=list(answers), **options)

    return run


def every_pair(true: np.ndarray) -> dict[tuple[int, int], Alignment]:
    count = len(true)
    pairs = [(i, j) for j in range(count) for i in range(j)]
    return {(i, j): aligned(between(true, i, j), seed=7 * i + j) for i, j in pairs}


def test_the_information_is_brought_to_the_sources_frame():
    points, normals = surface(3)  # in the target's frame
    alignment, centre, unit = aligned(motion(1, 100.0), seed=3), np.array([2.0, -1.0, 0.5]), 4.0
    found = pose_graph.in_source_frame(
        alignment.transform, alignment.information, alignment.pivot, centre, unit
    )
    step = 1e-6 * random_cloud(5, 6, 1)[:, 0]
    before = move(np.linalg.inv(alignment.transform), points)
    turn = Rotation.from_rotvec(step[:3]).as_matrix()
    after = (before - centre) @ turn.T + centre + unit * step[3:]
    residual = ((move(alignment.transform, after) - points) * normals).sum(axis=1) / 0.01
    assert step @ found @ step == pytest.approx(residual @ residual, rel=1e-4)


def test_the_poses_are_those_that_move_the_surfaces_least(stand_in):
    true = poses(3)
    answers = every_pair(true)
    for number, (pair, alignment) in enumerate(answers.items()):
        off = motion(20 + number, 0.2, 0.002)
        answers[pair] = aligned(off @ alignment.transform, seed=7 * pair[0] + pair[1])
    found = stand_in(answers, 3)

    def moved(numbers: np.ndarray) -> np.ndarray:
        """Along their normals, of every edge's surface, from where its alignment has it."""
        guess = np.array([np.eye(4)] * 3)
        guess[1:, :3, :3] = Rotation.from_rotvec(numbers[:6].reshape(2, 3)).as_matrix()
        guess[1:, :3, 3] = numbers[6:].reshape(2, 3)
        residuals = []
        for (i, j), alignment in answers.items():
            points, normals = surface(7 * i + j)
            there = move(between(guess, i, j) @ np.linalg.inv(alignment.transform), points)
            residuals.append(((there - points) * normals).sum(axis=1))
        return np.concatenate(residuals)

    start = [Rotation.from_matrix(true[1:, :3, :3]).as_rotvec().ravel(), true[1:, :3, 3].ravel()]
    best = least_squares(moved, np.concatenate(start), xtol=1e-12, ftol=1e-12).x
    turns = Rotation.from_rotvec(best[:6].reshape(2, 3)).as_matrix()
    # Open3D stops early, and weighs edges by how well they agree: 1 % of what they are off by.
    np.testing.assert_allclose(found.reference_from_cloud[1:, :3, :3], turns, atol=4e-5)
    np.testing.assert_allclose(found.reference_from_cloud[1:, :3, 3].ravel(), best[6:], atol=4e-5)
    residuals = np.sqrt((moved(best).reshape(3, -1) ** 2).mean(axis=1))
    np.testing.assert_allclose([edge.residual for edge in found.edges], residuals, rtol=0.1)


@pytest.mark.parametrize(("unit", "place"), [(1.0, 0.0), (1000.0, 0.0), (1.0, 1e6)])
def test_exact_alignments_give_exact_poses_in_any_unit_and_place(stand_in, unit, place):
    true = poses(4)
    true[1:, :3, 3] = unit * true[1:, :3, 3] + place
    found = stand_in(every_pair(true), 4, unit, place)
    np.testing.assert_allclose(
        found.reference_from_cloud, true, rtol=1e-9, atol=1e-7 * max(unit, 1e-2 * place)
    )
    assert found.connected.all() and all(edge.kept for edge in found.edges)
    assert max(edge.residual_deg for edge in found.edges) < 1e-3


@pytest.mark.parametrize("degrees", [12.0, 40.0, 90.0, 180.0])
@pytest.mark.parametrize("wrong", [(0, 1), (2, 3)])
def test_a_wrong_edge_is_dropped_however_sure_it_is(stand_in, wrong, degrees):
    true = poses(4)
    answers = every_pair(true)
    transform, middle = between(true, *wrong), np.median(cloud(wrong[0]), axis=0)
    turn = transform @ motion(9, degrees, 0.0)
    turn[:3, 3] += move(transform, middle) - move(turn, middle)  # in its place
    answers[wrong] = aligned(turn, probability=0.99)
    found = stand_in(answers, 4)
    assert [(edge.source, edge.target) for edge in found.edges if not edge.kept] == [wrong]
    np.testing.assert_allclose(found.reference_from_cloud, true, atol=1e-4)
    dropped = next(edge for edge in found.edges if not edge.kept)
    assert dropped.residual_deg == pytest.approx(degrees, abs=0.01)
    assert f"contradict it: off by {degrees:.1f} degrees" in dropped.reason


def test_in_a_triangle_the_least_probable_edge_yields(stand_in):
    true = poses(3)
    answers = every_pair(true)
    answers[0, 1] = aligned(motion(9, 30.0) @ between(true, 0, 1), probability=0.6)
    found = stand_in(answers, 3)
    assert [edge.kept for edge in found.edges] == [False, True, True]
    np.testing.assert_allclose(found.reference_from_cloud, true, atol=1e-4)


def test_clouds_that_are_not_joined_have_no_pose_but_a_reason(stand_in):
    true = poses(6)
    answers = {(0, 1): aligned(between(true, 0, 1)), (3, 4): aligned(between(true, 3, 4))}
    answers[1, 2] = aligned(between(true, 1, 2), 0.2, "the pose is doubtful")
    found = stand_in(answers, 6)
    assert found.connected.tolist() == [True, True, False, False, False, False]
    assert np.isnan(found.reference_from_cloud[2:]).all()
    np.testing.assert_allclose(found.reference_from_cloud[:2], true[:2], atol=1e-9)
    assert found.reasons == (
        "",
        "",
        "its best alignment, with cloud 1: the pose is doubtful",
        "its best alignment, with cloud 4: leads to no cloud with a pose",
        "its best alignment, with cloud 3: leads to no cloud with a pose",
        "no pair with cloud 5 was given",
    )
    assert [edge.kept for edge in found.edges] == [True, False, False]
    assert np.isnan(found.edges[1].residual) and found.edges[2].reason == "the pose is doubtful"


def test_nothing_joined_leaves_the_reference_alone(stand_in):
    found = stand_in({(0, 1): aligned(np.eye(4), 0.1, "no")}, 2)
    np.testing.assert_array_equal(found.reference_from_cloud[0], np.eye(4))
    assert found.connected.tolist() == [True, False]


def clueless(params, source, target) -> pose_programs.NetworkPose:
    """A network that knows nothing, and costs no compilation."""
    ones = np.ones(len(source)), np.ones(len(target))
    return pose_programs.NetworkPose(np.eye(4), *ones, np.outer(*ones) / len(target))


def test_three_scans_of_a_shape_find_together(monkeypatch):
    monkeypatch.setattr(pose_programs, "predict_pose", clueless)
    monkeypatch.setattr(verdict, "LIKELY", 0.0)
    true = poses(3, 30.0)
    clouds = [move(np.linalg.inv(pose), solid(190, i)) for i, pose in enumerate(true)]
    rough = np.array([pose @ motion(i + 5, 3.0, 0.02) for i, pose in enumerate(true)])
    found = align_many(clouds, tiny_params(), initial=rough, max_points=POINTS)
    assert found.connected.all(), found.reasons
    for number in (1, 2):
        assert rotation_error_deg(found.reference_from_cloud[number], true[number]) < 2.0
    assert all(edge.kept for edge in found.edges)


CLOUDS = [random_cloud(i, 30) for i in range(3)]


def test_neighbours_in_the_order_of_scans_are_few_pairs_with_loops(monkeypatch):
    asked = []

    def align(source, target, *_, **__):
        asked.append((len(source.points), len(target.points)))
        return aligned(np.eye(4))

    monkeypatch.setattr(module, "align", align)
    clouds = [random_cloud(i, 30 + i) for i in range(40)]
    found = align_many(clouds, tiny_params(), neighbours=4, pairs=[(39, 0), (1, 0)])
    assert found.connected.all()
    gaps = [target - source for source, target in asked]
    assert sorted(gaps) == sorted([-39, -1] + [1] * 38 + [2] * 38 + [3] * 37 + [4] * 36)
    assert len(set(map(frozenset, asked))) == len(asked) == 151


@pytest.mark.parametrize(
    ("clouds", "options", "words"),
    [
        (CLOUDS[:1], {}, "at least two; got 1"),
        (CLOUDS * 5, {}, "pairs must be given for more than 12 clouds; got 15, which have 105"),
        (CLOUDS, {"neighbours": 0}, "neighbours must be at least 1; got 0"),
        (CLOUDS, {"pairs": [(0, 3)]}, r"of two clouds in 0\.\.2; got \(0, 3\)"),
        (CLOUDS, {"pairs": [(1, 1)]}, r"got \(1, 1\)"),
        (CLOUDS, {"pairs": [(0, 1), (0, 1)]}, "pairs must be different"),
        (CLOUDS, {"initial": np.eye(4)}, r"for each of the 3 clouds; got shape \(4, 4\)"),
        ([*CLOUDS, np.zeros((3, 30))], {}, r"clouds\[3\] must be \(n, 3\).*give points\.T"),
    ],
)
def test_unusable_arguments_are_named(clouds, options, words):
    with pytest.raises(ValueError, match=words):
        align_many(clouds, tiny_params(), **options)


def test_without_open3d_the_error_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "open3d", None)  # import raises ImportError
    with pytest.raises(ImportError, match=r"pip install \"dbdnet_jax\[baselines\]\".*libusb-1.0-0"):
        align_many(CLOUDS)


def test_zeros_for_missing_points_are_no_unit(monkeypatch):
    """An organised scan may hold more zeros than points of the thing."""
    true = poses(2)
    monkeypatch.setattr(module, "align", lambda *_, **__: aligned(between(true, 0, 1)))
    clouds = [np.vstack([random_cloud(i, 200), np.zeros((260, 3))]) for i in range(2)]
    found = align_many(clouds, tiny_params())
    np.testing.assert_allclose(found.reference_from_cloud, true, atol=1e-5)


def test_what_was_noted_in_reading_is_told_of_every_edge(tmp_path):
    points = solid(200, 0)
    rows = [" ".join(map(str, row)) for row in [*points, [np.nan] * 3]]
    (tmp_path / "a.xyz").write_text("\n".join(rows))
    options = {"max_points": POINTS, "refine": False}
    found = align_many([tmp_path / "a.xyz", points], tiny_params(), **options)
    assert "NaN" in found.edges[0].alignment.warnings[0]


def test_a_guess_that_is_no_motion_is_refused():
    with pytest.raises(ValueError, match=r"initial\[1\] must be a rotation and a translation"):
        align_many([solid(99, 0)] * 2, tiny_params(), initial=[np.eye(4), 2 * np.eye(4)])
