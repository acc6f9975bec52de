"""Whether a mirrored source is told from one that is not."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from dbdnet_jax.alignment import mirrored
from dbdnet_jax.alignment.candidates import Candidate
from dbdnet_jax.alignment.consensus import match_surfaces
from dbdnet_jax.alignment.mirrored import (
    PERHAPS,
    RARE,
    mirrored_evidence,
    trust_beside_mirror,
    weigh,
)
from dbdnet_jax.alignment.normalised import NormalisedPair, as_normalised, normalise_pair
from dbdnet_jax.alignment.search import Clues, Found, find_pose
from dbdnet_jax.alignment.success import load_coefficients
from dbdnet_jax.alignment.surfaces import PoseFit, surface
from dbdnet_jax.ops.transforms import transform_of
from dbdnet_jax.types import Transform
from tests.aligning import POINTS, pair, solid, tiny_align, tiny_params

COEFFICIENTS = load_coefficients()
NO_FIT = PoseFit(0.0, 0.0, 0.0, 0.0, 0.5, 1.0)
ABOVE, BELOW = [0.9, 0.3, 0.2], [-0.7, 0.5, -0.3]  # each drawing lacks what lies farthest there
# Of a chair: middle and size of its boxes; a block on the seat is all that a mirror shows.
BOXES = [
    ((0, 0, 0.45), (0.5, 0.5, 0.05)),
    ((-0.24, 0, 0.75), (0.04, 0.5, 0.6)),
    ((0, 0.26, 0.65), (0.4, 0.05, 0.05)),
    ((0.2, 0.2, 0.2), (0.05, 0.05, 0.4)),
    ((-0.2, -0.2, 0.2), (0.05, 0.05, 0.4)),
    ((0.1, -0.1, 0.58), (0.15, 0.1, 0.22)),
]


def chair(count: int, seed: int) -> np.ndarray:
    """(count, 3) points on the boxes, by area."""
    rng = np.random.default_rng(seed)
    middles, sizes = np.array(BOXES).transpose(1, 0, 2)
    area = np.stack([sizes.prod(axis=1) / size for size in sizes.T], axis=1).ravel()
    box, axis = np.divmod(rng.choice(len(area), count, p=area / area.sum()), 3)
    points = rng.uniform(-0.5, 0.5, (count, 3))
    points[np.arange(count), axis] = rng.choice([-0.5, 0.5], count)
    return middles[box] + points * sizes[box]


def drawn(thing, flip: list[int], seed: int = 0, count: int = 1500) -> NormalisedPair:
    """Two partial drawings, the first one flipped, as `align` sees them."""
    clouds = [thing(count, 2 * seed + i) for i in (1, 2)]
    first, second = (
        cloud[np.argsort(cloud @ side)[: count * 11 // 15]]
        for cloud, side in zip(clouds, (ABOVE, BELOW), strict=True)
    )
    return normalise_pair(first * flip, second, "auto", POINTS)


def evidence_at(scene: NormalisedPair, pose: Transform) -> float:
    """The evidence that the best mirrored pose is better than this one."""
    matched = match_surfaces(scene.source.surface, scene.target.surface)
    nothing = dict.fromkeys(Found._fields)  # else is looked at
    found = Found(**nothing | {"pose": pose, "clues": Clues(None, matched)})
    return mirrored_evidence(scene, found, COEFFICIENTS)


def test_a_right_pose_beats_the_mirrored_one():
    scene = drawn(solid, [1, 1, 1])
    assert evidence_at(scene, as_normalised(np.eye(4), scene)) < 0


def test_the_mirrored_source_has_the_normals_of_its_points(monkeypatch):
    seen = []

    def keep_source(starts, source, target, *_, **__):
        seen.append(source)
        return [Candidate(starts[0], NO_FIT, 0.0)]

    monkeypatch.setattr(mirrored, "examine", keep_source)
    turn = Rotation.random(random_state=3).as_matrix()
    evidence_at(drawn(solid, [1, 1, 1]), transform_of(turn, np.zeros(3)))
    cosines = (seen[0].normals * surface(seen[0].points).normals).sum(axis=1)
    np.testing.assert_allclose(np.abs(cosines), 1.0, atol=1e-6)


@pytest.mark.parametrize("seed", [0, 3, 7, 11])
def test_the_mirrored_pose_is_found_from_every_answer(seed):
    turn = Rotation.random(random_state=seed).as_matrix()
    assert evidence_at(drawn(solid, [1, 1, -1]), transform_of(turn, np.zeros(3))) > 3


@pytest.mark.parametrize(("flip", "told"), [([1, 1, 1], False), ([-1, 1, 1], True)])
@pytest.mark.parametrize("seed", [6, 10])
def test_a_small_part_tells_a_mirrored_chair(seed, flip, told):
    scene = drawn(chair, flip, seed, count=2600)
    options = {"refine": True, "guess": None, "proposals": []}
    found = find_pose(tiny_params(), scene, COEFFICIENTS, "any", **options)
    trust = trust_beside_mirror(scene, found, COEFFICIENTS)
    assert bool(trust.reason or trust.warnings) == told


def test_the_odds_of_a_mirrored_source_are_taken_from_those_of_the_pose():
    left, reason, warnings = weigh(0.8, RARE + np.log(8))
    assert left == pytest.approx(1 / 3) and "mirrored" in reason and not warnings
    left, reason, (warning,) = weigh(0.96, RARE + np.log(4))
    assert left == pytest.approx(6 / 7) and "mirrored" in warning and not reason


def test_little_for_a_mirror_leaves_the_probability():
    left, reason, (warning,) = weigh(0.6, RARE)
    assert left == pytest.approx(0.6) and "mirrored" in warning and not reason
    assert weigh(0.9, PERHAPS / 2).warnings == ()
    assert weigh(0.7, -np.inf) == (pytest.approx(0.7), "", ())
    assert weigh(1.0, 0.0) == (1.0, "", ())


@pytest.mark.parametrize("evidence", [RARE + 1.0, 100.0])
def test_the_answer_has_what_is_left(evidence, monkeypatch):
    source, target, true = pair()
    plain = tiny_align(source, target, initial=true)
    monkeypatch.setattr(mirrored, "mirrored_evidence", lambda *_: evidence)
    found = tiny_align(source, target, initial=true)
    expected = weigh(plain.success_probability, evidence)
    assert plain.valid and found.success_probability == pytest.approx(expected.probability)
    assert found.reason == expected.reason and found.valid == (evidence < 100)
    assert set(expected.warnings) <= set(found.warnings)
