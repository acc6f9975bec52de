"""The classical methods on motions they can find, and what is said when Open3D is absent."""

import sys

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from dbdnet_jax.classical import open3d as classical
from dbdnet_jax.data.cad import cad_split
from dbdnet_jax.types import Rigid

SMALL = Rotation.from_euler("xyz", [8, -6, 10], degrees=True), np.array([0.05, -0.1, 0.08])
LARGE = Rotation.from_euler("xyz", [40, -30, 45], degrees=True), np.array([0.9, -0.7, 0.5])


@pytest.fixture(scope="module")
def shape():
    """Points and normals of a model that looks the same from no two sides."""
    shapes = cad_split("val")
    return shapes.points[5, :700], shapes.normals[5, :700]


@pytest.fixture
def needs_open3d():
    pytest.importorskip("open3d", reason="the baselines extra (Open3D) is not installed")


def moved(points, motion):
    """float64 (n, 3) points after ``motion``, in another row order."""
    rotation, translation = motion
    rows = np.random.default_rng(0).permutation(len(points))
    return rotation.apply(points)[rows] + translation, rows


def assert_finds(answer: Rigid, motion, degrees: float, distance: float):
    rotation, translation = motion
    angle = (rotation.inv() * Rotation.from_matrix(answer.rotation)).magnitude()
    assert np.rad2deg(angle) < degrees
    assert np.linalg.norm(answer.translation - translation) < distance


def test_identity_moves_nothing():
    answer = classical.identity(np.ones((4, 3)), np.zeros((5, 3)))
    assert np.array_equal(answer.rotation, np.eye(3)) and not answer.translation.any()


@pytest.mark.parametrize("method", [classical.icp, classical.icp_centred])
def test_icp_finds_a_small_motion_of_a_full_copy(method, shape, needs_open3d):
    target, _ = moved(shape[0], SMALL)
    assert_finds(method(shape[0], target), SMALL, degrees=0.01, distance=1e-4)


def test_centred_icp_finds_a_small_rotation_far_away(shape, needs_open3d):
    motion = SMALL[0], np.array([5.0, -4.0, 3.0])  # beyond the distance of plain ICP
    target, _ = moved(shape[0], motion)
    assert_finds(classical.icp_centred(shape[0], target), motion, degrees=0.01, distance=1e-3)
    assert not np.allclose(classical.icp(shape[0], target).translation, motion[1], atol=1)


def test_fgr_finds_a_large_motion_and_the_same_one_again(shape, needs_open3d):
    points, normals = shape
    target, rows = moved(points, LARGE)
    target_normals = LARGE[0].apply(normals)[rows]

    def answer() -> Rigid:
        return classical.fgr(points, target, source_normals=normals, target_normals=target_normals)

    first = answer()
    assert_finds(first, LARGE, degrees=0.5, distance=0.01)
    assert np.array_equal(first.rotation, answer().rotation)


def test_fgr_uses_the_normals_it_is_given(shape, needs_open3d):
    points, normals = shape
    target, rows = moved(points, LARGE)
    noise = np.random.default_rng(1).normal(size=normals.shape)
    wrong = noise / np.linalg.norm(noise, axis=1, keepdims=True)
    answer = classical.fgr(points, target, source_normals=normals, target_normals=wrong)
    with pytest.raises(AssertionError):
        assert_finds(answer, LARGE, degrees=0.5, distance=0.01)


def test_fgr_with_estimated_normals_finds_a_large_motion(shape, needs_open3d):
    target, _ = moved(shape[0], LARGE)
    assert_finds(classical.fgr_estimated(shape[0], target), LARGE, degrees=1, distance=0.02)


@pytest.mark.parametrize("method", [classical.icp, classical.icp_centred, classical.fgr_estimated])
def test_without_open3d_the_error_says_what_to_install(method, monkeypatch):
    monkeypatch.setitem(sys.modules, "open3d", None)  # import raises ImportError
    cloud = np.zeros((8, 3))
    with pytest.raises(ImportError, match=r"pip install \"dbdnet_jax\[baselines\]\".*libusb-1.0-0"):
        method(cloud, cloud)
