"""What is searched and found of a pair."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from dbdnet_jax.alignment import pose_programs, search
from dbdnet_jax.alignment.candidates import rank
from dbdnet_jax.alignment.consensus import MatchedPoints, agreement
from dbdnet_jax.alignment.normalised import as_normalised, normalise_pair
from dbdnet_jax.alignment.pose_programs import NetworkPose
from dbdnet_jax.alignment.search import (
    Clues,
    Found,
    find_pose,
    last_refined,
)
from dbdnet_jax.alignment.success import load_coefficients
from dbdnet_jax.alignment.surfaces import surface
from dbdnet_jax.ops.transforms import angle_between, transform_of
from tests.aligning import POINTS, solid, tiny_params

COEFFICIENTS = load_coefficients()


def turned_scene():
    """Two dense partial drawings, the source turned by 150 degrees, and the pose between them."""
    turn = Rotation.from_rotvec([150, 0, 0], degrees=True).as_matrix()
    source, target = solid(3000, 3), solid(3000, 4)
    scene = normalise_pair(source[source[:, 0] < 0.4] @ turn, target, "auto", POINTS)
    return scene, as_normalised(transform_of(turn, np.zeros(3)), scene)


def search_of(scene, how: str) -> Found:
    options = {"refine": True, "guess": None, "proposals": []}
    return find_pose(tiny_params(), scene, COEFFICIENTS, how, **options)


def test_matches_propose_poses_of_any_rotation(monkeypatch):
    scene, true = turned_scene()
    monkeypatch.setattr(search, "far_starts", lambda *_: [np.eye(4)])  # nothing else leads there
    found = search_of(scene, "auto")
    assert angle_between(found.pose, true)[0] < 2
    agreeing = agreement(found.pose, found.clues.matched)
    assert agreeing > 20 and found.evidence.agreeing_matches == pytest.approx(np.log1p(agreeing))


def test_near_keeps_to_what_is_near():
    scene, true = turned_scene()
    found = search_of(scene, "near")
    poses = [found.pose, *(other.pose for other in found.others)]
    assert min(angle_between(pose, true)[0] for pose in poses) > 15


@pytest.mark.parametrize(("worse", "taken"), [(0.4, True), (0.6, False)])
def test_the_last_step_is_taken_unless_it_fits_worse(monkeypatch, worse, taken):
    source = target = surface(solid(3000, 3))
    start, refined = np.eye(4), transform_of(np.eye(3), np.array([0.01, 0.0, 0.0]))
    monkeypatch.setattr(search, "refine_point_to_plane", lambda *_: refined)
    own = rank([refined], source, target, COEFFICIENTS)[0].score
    candidate = rank([start], source, target, COEFFICIENTS)[0]._replace(score=own + worse)
    pose = last_refined(candidate, source, target, COEFFICIENTS).pose
    assert (pose == (refined if taken else start)).all()


def test_the_last_step_ends_on_all_points(monkeypatch):
    source = target = surface(solid(3000, 3), np.arange(300))
    used = []

    def keep(pose, source, target, radii, rows):
        used.append(len(source.points if rows is None else rows))
        return pose

    monkeypatch.setattr(search, "refine_point_to_plane", keep)
    last_refined(rank([np.eye(4)], source, target, COEFFICIENTS)[0], source, target, COEFFICIENTS)
    assert used == [300, 3000]


@pytest.mark.parametrize(
    ("rmse", "agreeing", "turned_deg", "row"),
    [
        (1.0, 0, 0, 0),
        (0.8, 0, 0, 0),  # better, but not clearly
        (0.7, 0, 0, 1),
        (0.8, 0, 20, 1),  # refinement had turned the network's pose far
        (1.0, 19, 0, 1),  # matches speak for it
        (1.2, 19, 0, 0),
    ],
)
def test_of_sparse_clouds_the_network_s_pose_is_left_for_what_fits_clearly_better(
    monkeypatch, rmse, agreeing, turned_deg, row
):
    side = surface(solid(300, 3))
    turns = [Rotation.from_euler("x", angle, degrees=True).as_matrix() for angle in (0, 90)]
    first, other = (transform_of(turn, np.zeros(3)) for turn in turns)
    away = Rotation.from_euler("z", turned_deg, degrees=True).as_matrix()
    said = NetworkPose(transform_of(away, np.zeros(3)), np.ones(9), np.ones(9), np.ones((9, 9)))
    clues = Clues(said, MatchedPoints(np.zeros((1, 3)), np.zeros((1, 3))))

    def of_other(value, usual):
        return lambda pose, *_: value if (pose == other).all() else usual

    monkeypatch.setattr(pose_programs, "truncated_rmse", of_other(rmse, 1.0))
    monkeypatch.setattr(search, "agreement", of_other(agreeing, 0))
    candidates = [rank([pose], side, side, COEFFICIENTS)[0] for pose in (first, other)]
    assert search.stay_or_leave(candidates, clues, side, side) == row


def test_the_others_are_best_first_whichever_is_chosen(monkeypatch):
    points = solid(300, 3)
    scene = normalise_pair(points, solid(300, 4), "auto", POINTS)
    monkeypatch.setattr(search, "stay_or_leave", lambda *_: 1)
    turns = [Rotation.from_euler("x", 40 * i, degrees=True).as_matrix() for i in range(4)]
    poses = [transform_of(turn, np.zeros(3)) for turn in turns]
    sides = scene.source.surface, scene.target.surface
    rows = [rank([pose], *sides, COEFFICIENTS)[0] for pose in poses]
    scores = (-2.0, 1.0, 0.5, -1.0)
    rows = [row._replace(score=score) for row, score in zip(rows, scores, strict=True)]
    clues = search.find_clues(tiny_params(), scene)
    found = search.settle(scene, rows, clues, COEFFICIENTS, None, everywhere=True)
    assert [other.score for other in found.others] == [0.5, -1.0, -2.0]
    assert found.margin == 0.5
