"""The generator of training shapes: seeded, distinct, normalised, evenly spaced."""

import numpy as np
import pytest
from scipy.spatial import cKDTree

from dbdnet_jax.data.procedural.shapes import FAMILIES, procedural_shapes
from dbdnet_jax.data.shapes import Shapes

COUNT = 40
VARIATION = 0.3  # of the distance to the nearest neighbour, in the mean; ModelNet40 has 0.28
MOST_VARIATION = 0.4  # where thin parts lie close to each other, as in the embedded set
FLOAT32_UNIT = 1e-6  # of a float32 norm near 1


@pytest.fixture(scope="module")
def shapes() -> Shapes:
    return procedural_shapes(COUNT, seed=0)


def test_a_shape_depends_on_the_seed_and_its_place_alone(shapes: Shapes) -> None:
    again = procedural_shapes(3, seed=0)
    for field, array in vars(again).items():
        np.testing.assert_array_equal(array, getattr(shapes, field)[:3])
    assert (procedural_shapes(1, seed=1).points[0] != shapes.points[0]).any()


def test_shapes_are_normalised(shapes: Shapes) -> None:
    assert shapes.points.shape == shapes.normals.shape == (COUNT, 2048, 3)
    assert shapes.points.dtype == shapes.normals.dtype == np.float32
    points = shapes.points.astype(np.float64)
    assert np.abs(points.mean(1)).max() < FLOAT32_UNIT
    assert np.abs(np.linalg.norm(points, axis=-1).max(1) - 1).max() < FLOAT32_UNIT
    assert np.abs(np.linalg.norm(shapes.normals, axis=-1) - 1).max() < FLOAT32_UNIT


def test_points_are_evenly_spaced(shapes: Shapes) -> None:
    distances = [cKDTree(points).query(points, k=2)[0][:, 1] for points in shapes.points]
    variation = np.std(distances, axis=1) / np.mean(distances, axis=1)
    assert variation.mean() < VARIATION
    assert variation.max() < MOST_VARIATION


def test_no_two_shapes_are_alike(shapes: Shapes) -> None:
    """The mean distance between two samples of one surface is about half their spacing, 0.02."""
    for i, points in enumerate(shapes.points):
        tree = cKDTree(points)
        others = [tree.query(other[::8])[0].mean() for other in shapes.points[i + 1 :]]
        assert min(others, default=1.0) > 0.03, shapes.names[i]


@pytest.mark.parametrize("family", FAMILIES, ids=lambda family: family.__name__)
def test_every_family_gives_finite_triangles_and_varies(family) -> None:
    soups = [family(np.random.default_rng(seed)) for seed in range(20)]
    assert all(soup.shape[1:] == (3, 3) and np.isfinite(soup).all() for soup in soups)
    assert len({round(float(np.ptp(soup)), 6) for soup in soups}) == 20


def test_nothing_and_less_than_nothing() -> None:
    assert len(procedural_shapes(0, seed=0)) == 0
    with pytest.raises(ValueError, match="must not be negative; got -1 and 0"):
        procedural_shapes(-1, seed=0)
