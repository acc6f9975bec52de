"""Which shapes a turn brings onto themselves."""

import numpy as np
import pytest
import trimesh

from dbdnet_jax.data.surface import even_points
from dbdnet_jax.data.symmetry import smallest_turn, symmetric_shapes


def sampled(mesh: trimesh.Trimesh) -> np.ndarray:
    return even_points(mesh.vertices, mesh.faces, np.random.default_rng(0))[0]


def with_knob(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    """The same with a large box where no other side has one."""
    knob = trimesh.creation.box((0.8, 0.7, 0.6))
    knob.apply_translation((0.7, 0.9, 0.5))
    return trimesh.util.concatenate([mesh, knob])


SMALLEST_DEG = {"box": 180.0, "cylinder": 30.0, "square prism": 90.0}
SOLIDS = {
    "box": trimesh.creation.box((1.0, 1.4, 1.9)),
    "cylinder": trimesh.creation.cylinder(0.5, 1.7),
    "square prism": trimesh.creation.box((1.2, 1.2, 2.0)),
}


@pytest.mark.parametrize("name", SOLIDS)
def test_solids_are_symmetric_until_something_is_added_to_one_side(name):
    turn = smallest_turn(sampled(SOLIDS[name]))
    assert turn.degrees == SMALLEST_DEG[name]
    assert smallest_turn(sampled(with_knob(SOLIDS[name]))) is None


def test_place_and_size_do_not_matter_and_every_shape_is_judged_alone():
    points = np.stack([sampled(SOLIDS["box"]), sampled(with_knob(SOLIDS["box"]))])
    assert symmetric_shapes(points * 7.0 + 100.0).tolist() == [True, False]
