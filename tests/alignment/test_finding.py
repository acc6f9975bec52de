"""What is found of a mirrored source, wherever the answer has turned it."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from dbdnet_jax.alignment.consensus import match_surfaces
from dbdnet_jax.alignment.finding import MIRRORED, Clues, Found, mirrored_margin
from dbdnet_jax.alignment.normalised import as_normalised, normalise_pair
from dbdnet_jax.alignment.success import fit_score, load_coefficients
from dbdnet_jax.alignment.surfaces import inlier_distance, measure_fit
from dbdnet_jax.ops.transforms import transform_of
from tests.aligning import solid

COEFFICIENTS = load_coefficients()


def drawn(flip: list[int]):
    """Two partial drawings of a solid, the first one flipped, as `align` sees them."""
    first, second = solid(1500, 1), solid(1500, 2)
    first = first[np.argsort(first @ [0.9, 0.3, 0.2])[:1100]] * flip
    second = second[np.argsort(second @ [-0.7, 0.5, -0.3])[:1100]]
    return normalise_pair(first, second, "auto", 256, np.eye(4))


def score_and_margin(scene, pose) -> tuple[float, float]:
    """A pose's own score, and by how much the best mirrored one beats it."""
    source, target = scene.source.surface, scene.target.surface
    fit = measure_fit(pose, source, target, inlier_distance(source, target))
    nothing = dict.fromkeys(Found._fields)  # else is looked at
    found = Found(**nothing | {"pose": pose, "clues": Clues(None, match_surfaces(source, target))})
    return fit_score(fit, COEFFICIENTS), mirrored_margin(scene, found, COEFFICIENTS)


STRAIGHT = drawn([1, 1, 1])
RIGHT = as_normalised(np.eye(4), STRAIGHT)


def test_a_right_pose_beats_the_mirrored_one():
    assert score_and_margin(STRAIGHT, RIGHT)[1] < 0


@pytest.mark.parametrize("seed", [0, 3, 7, 11])
def test_the_mirrored_pose_is_found_from_every_answer(seed):
    turn = Rotation.random(random_state=seed).as_matrix()
    own, margin = score_and_margin(drawn([1, 1, -1]), transform_of(turn, np.zeros(3)))
    assert margin > MIRRORED
    assert own + margin > score_and_margin(STRAIGHT, RIGHT)[0] - 0.5  # as well as unmirrored
