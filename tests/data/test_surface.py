"""Evenly spaced points on meshes, and the solids that meshes are put together from."""

import numpy as np
import pytest

from dbdnet_jax.data import surface
from dbdnet_jax.data.procedural import solids
from tests.conftest import FLOAT64, assert_close

VERTICES = np.array([[0, 0, 0], [4, 0, 0], [0, 1, 0], [0, 0, 3.0]])
TRIANGLES = np.array([[0, 1, 2], [0, 0, 1], [0, 2, 3]])


def volume(soup: np.ndarray) -> float:
    """By the divergence theorem: positive if the normals of a closed surface point outwards."""
    return float(np.einsum("ti,ti->", soup[:, 0], np.cross(soup[:, 1], soup[:, 2])) / 6)


def test_sampling_is_by_area_and_skips_degenerate_faces() -> None:
    rng = np.random.default_rng(0)
    points, normals = surface.sample_surface(VERTICES, TRIANGLES, 7000, rng)
    on_floor = points[:, 2] == 0
    assert abs(on_floor.mean() - 2 / (2 + 1.5)) < 0.03
    np.testing.assert_array_equal(normals[on_floor] == [0, 0, 1], True)
    np.testing.assert_array_equal(normals[~on_floor] == [1, 0, 0], True)
    np.testing.assert_allclose(points[on_floor].mean(0), [4 / 3, 1 / 3, 0], atol=0.05)
    with pytest.raises(ValueError, match="all degenerate"):
        surface.sample_surface(VERTICES, TRIANGLES[1:2], 10, rng)


@pytest.mark.parametrize(
    ("soup", "expected"),
    [
        (solids.box((0, 1, 2), (1, 3, 5)), 6.0),
        (solids.block(2, 3, 4), 24.0),
        (solids.cylinder(1.0, 2.0, 400), 2 * np.pi),
        (solids.extrude(solids.regular(4, np.sqrt(2)), 1.0, solids.regular(4, 1.0)), 2.0),
        (solids.sweep([(0, 0, 0), (1, 2, 2)], solids.regular(4, np.sqrt(2))), 12.0),
        (solids.sweep([(0, 0, 0), (0, 0, 1)], solids.regular(4, np.sqrt(2)), 0.5), 1.0),
    ],
)
def test_solids_are_closed_and_their_normals_point_outwards(soup, expected) -> None:
    assert abs(volume(soup) - expected) < 1e-3
    moved = solids.mirror(solids.turn(solids.move(soup, 1, 2, 3), "y", 0.7), 2)
    assert_close(volume(moved), volume(soup), FLOAT64)


def test_a_curve_begins_and_ends_at_its_corners() -> None:
    path = solids.curve((0, 0, 0), (1, 0, 0), (1, 2, 0), steps=5)
    assert_close(path[[0, 2, 4]], [[0, 0, 0], [0.75, 0.5, 0], [1, 2, 0]], FLOAT64)
