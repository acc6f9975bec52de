"""`align`: scaling, units, order, initial guesses, what it warns of, and when it refuses."""

import dataclasses
import re

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import cKDTree

from dbdnet_jax import save_params
from dbdnet_jax.alignment.align import Alignment, align
from dbdnet_jax.alignment.downsampling import DENSE, downsample
from dbdnet_jax.alignment.normalised import is_full_resolution, normalise_pair
from dbdnet_jax.alignment.search import LIKELY
from dbdnet_jax.alignment.success import (
    Coefficients,
    FitFeatures,
    Logistic,
    PoseFeatures,
    load_coefficients,
    success_probability,
)
from dbdnet_jax.data.pairs import UNIT_SIZE
from tests.aligning import POINTS, motion, pair, rotation_error_deg, solid, tiny_align, tiny_params
from tests.alignment.test_quality import cylinder
from tests.networks.dbdnet.small import SMALL

SOURCE, TARGET, TRUE = pair()
SAME_DEG = 0.05  # of two runs on the same clouds, otherwise written: float32 inside


@pytest.fixture(scope="module")
def plain() -> Alignment:
    """The pair as it is, started at the truth: the network is untrained."""
    return tiny_align(SOURCE, TARGET, initial=TRUE)


def assert_same_motion(found, expected, unit: float = 1.0):
    """Rotations to `SAME_DEG`, and where the source's middle goes to a thousandth of the unit."""
    assert rotation_error_deg(found, expected) < SAME_DEG
    middle = np.append(SOURCE.mean(0) * unit, 1)
    np.testing.assert_allclose((found @ middle)[:3], (expected @ middle)[:3], atol=1e-3 * unit)


def test_the_pose_is_found_from_a_near_guess(plain):
    assert rotation_error_deg(plain.transform, TRUE) < 2.0
    assert np.linalg.norm(plain.translation - TRUE[:3, 3]) < 0.05
    assert plain.transform.dtype == np.float64
    np.testing.assert_allclose(plain.rotation @ plain.rotation.T, np.eye(3), atol=1e-12)
    assert plain.inlier_ratio > 0.7


def test_every_given_point_has_an_overlap_probability(plain):
    assert plain.source_overlap.shape == (len(SOURCE),)
    assert plain.target_overlap.shape == (len(TARGET),)
    assert np.all((plain.source_overlap > 0) & (plain.source_overlap < 1))


def test_matches_are_rows_of_the_given_clouds_heaviest_first(plain):
    assert len(plain.matches.source_rows) > 3
    assert len(set(plain.matches.source_rows)) == len(plain.matches.source_rows)
    assert len(set(plain.matches.target_rows)) == len(plain.matches.target_rows)
    assert plain.matches.source_rows.max() < len(SOURCE)
    assert np.all(np.diff(plain.matches.confidence) <= 0)


def test_inliers_and_rmse_are_what_the_pose_says(plain):
    moved = SOURCE @ plain.rotation.T + plain.translation
    distance = cKDTree(TARGET).query(moved)[0]
    near = distance <= plain.inlier_distance
    assert plain.inlier_ratio == pytest.approx(near.mean(), abs=0.01)
    assert plain.rmse == pytest.approx(np.sqrt(np.mean(distance[near] ** 2)), rel=0.02)


def test_the_timings_add_up_and_nothing_else_is_random(plain):
    again = tiny_align(SOURCE, TARGET, initial=TRUE)
    np.testing.assert_array_equal(again.transform, plain.transform)
    assert set(plain.timings) == {
        "programs",
        "read",
        "weights",
        "downsample",
        "search",
        "quality",
        "overlap",
    }


@pytest.mark.parametrize(
    ("unit", "place"),
    [(1e-6, 0.0), (0.001, 0.0), (1000.0, 0.0), (1e9, 0.0), (1.0, 1e6), (1e3, -1e6)],
)
def test_units_and_places_change_nothing_but_the_translation(plain, unit, place):
    shifts = np.array([1.0, -2.0, 0.5]) * place, np.array([3.0, 1.0, -1.0]) * place
    guess = TRUE.copy()
    guess[:3, 3] = unit * TRUE[:3, 3] + shifts[1] - TRUE[:3, :3] @ shifts[0]
    found = tiny_align(SOURCE * unit + shifts[0], TARGET * unit + shifts[1], initial=guess)
    expected = plain.transform.copy()
    expected[:3, 3] = unit * expected[:3, 3]
    back = found.transform.copy()
    back[:3, 3] += found.rotation @ shifts[0] - shifts[1]
    assert_same_motion(back, expected, unit)
    assert found.rmse == pytest.approx(unit * plain.rmse, rel=0.01)
    np.testing.assert_allclose(
        found.pivot - shifts[1], unit * plain.pivot, atol=1e-2 * unit, rtol=0
    )
    assert found.success_probability == pytest.approx(plain.success_probability, abs=0.02)


@settings(max_examples=5, deadline=None)
@given(st.integers(0, 2**16))
def test_the_order_of_the_points_does_not_matter(plain, seed):
    rng = np.random.default_rng(seed)
    rows, columns = rng.permutation(len(SOURCE)), rng.permutation(len(TARGET))
    found = tiny_align(SOURCE[rows], TARGET[columns], initial=TRUE)
    assert_same_motion(found.transform, plain.transform)
    np.testing.assert_allclose(found.source_overlap, plain.source_overlap[rows], atol=1e-3)


@settings(max_examples=5, deadline=None)
@given(st.integers(0, 2**16), st.floats(0, 180))
def test_the_answer_follows_a_moved_source(plain, seed, degrees):
    extra = motion(seed, degrees)  # old source = extra @ new source
    rotation, translation = extra[:3, :3], extra[:3, 3]
    moved = (SOURCE - translation) @ rotation
    found = tiny_align(moved, TARGET, initial=TRUE @ extra)
    assert_same_motion(found.transform @ np.linalg.inv(extra), plain.transform)


def test_swapping_the_clouds_inverts_the_transform(plain):
    found = tiny_align(TARGET, SOURCE, initial=np.linalg.inv(TRUE))
    assert rotation_error_deg(found.transform @ plain.transform, np.eye(4)) < 1.5


def test_refinement_is_a_choice():
    rough = TRUE @ motion(3, 4.0, 0.02)
    refined = tiny_align(SOURCE, TARGET, initial=rough)
    raw = tiny_align(SOURCE, TARGET, initial=rough, refine=False)
    error = [rotation_error_deg(x.transform, TRUE) for x in (refined, raw)]
    assert error[0] < 2.0 < error[1]


def test_the_threshold_becomes_the_networks(monkeypatch):
    seen = []

    def ask(params, *_):
        seen.append(params.config.overlap_threshold)
        raise KeyboardInterrupt

    monkeypatch.setattr("dbdnet_jax.alignment.pose_programs.predict_pose", ask)
    config = dataclasses.replace(SMALL, overlap_threshold=0.4)
    for options in ({"overlap_threshold": 0.25}, {}):
        with pytest.raises(KeyboardInterrupt):
            align(SOURCE, TARGET, tiny_params().replace(config=config), **options)
    assert seen == [0.25, 0.4]


def test_a_network_may_be_a_file(tmp_path):
    save_params(tmp_path / "tiny.npz", tiny_params())
    options = {"initial": TRUE, "max_points": POINTS, "refine": False}
    named = align(SOURCE, TARGET, tmp_path / "tiny.npz", **options)
    given = align(SOURCE, TARGET, tiny_params(), **options)
    np.testing.assert_array_equal(named.transform, given.transform)


def test_a_doubtful_pose_that_was_not_refined_is_told_to_be(monkeypatch):
    monkeypatch.setattr("dbdnet_jax.alignment.search.success_probability", lambda *_: 0.1)
    reason = tiny_align(SOURCE, TARGET, initial=TRUE, refine=False).reason
    assert "refine=True may help" in reason and "search=" not in reason


@pytest.mark.parametrize(("probability", "valid"), [(0.8, False), (0.95, True)])
def test_clouds_of_unequal_sizes_need_a_confident_pose(monkeypatch, probability, valid):
    monkeypatch.setattr("dbdnet_jax.alignment.search.success_probability", lambda *_: probability)
    monkeypatch.setattr("dbdnet_jax.alignment.validity.size_ratio", lambda _: 2.5)
    answer = tiny_align(SOURCE, TARGET, initial=TRUE, refine=False)
    assert any("are both in the same unit?" in text for text in answer.warnings)
    assert answer.valid == valid and ("same unit" in answer.reason) != valid


def test_thinning_keeps_shape_and_forgets_density_and_strays():
    points = solid(200_000, 5)
    points[0] = 1e6
    chosen = downsample(points, 300)
    assert 300 < len(chosen.dense) <= DENSE
    assert chosen.outliers == 1 and len(chosen.sparse) == 300
    assert 0 not in chosen.dense and set(chosen.sparse) <= set(chosen.dense)
    assert cKDTree(points[chosen.dense]).query(points[1:])[0].max() < 0.05
    order = np.random.default_rng(0).permutation(len(points))
    again = downsample(points[order], 300)
    np.testing.assert_array_equal(points[order][again.sparse], points[chosen.sparse])


def test_auto_scale_brings_the_larger_cloud_to_the_weights_size():
    scene = normalise_pair(40 * SOURCE, 40 * TARGET, "auto", 150)
    norms = [np.linalg.norm(side.sparse, axis=1) for side in (scene.source, scene.target)]
    assert max(np.quantile(x, 0.98) for x in norms) == pytest.approx(UNIT_SIZE)
    assert normalise_pair(SOURCE, TARGET, 2.5, 150).factor == 2.5


def test_clouds_that_a_grid_has_thinned_are_not_asked_whether_points_coincide():
    few, many = (normalise_pair(c, c, "auto", 100) for c in (solid(500, 1), solid(11_000, 1)))
    assert is_full_resolution(few) and not is_full_resolution(many)
    stray = np.vstack([solid(500, 1), [[50.0, 0, 0]]])
    assert is_full_resolution(normalise_pair(stray, stray, "auto", 100))


def test_a_symmetric_shape_is_refused_and_its_motion_named():
    found = tiny_align(cylinder(400, 1), cylinder(400, 2), initial=np.eye(4))
    assert not found.valid
    assert "rotation about" in found.reason
    assert found.reason in found.warnings


def test_clouds_of_different_units_are_refused():
    found = tiny_align(SOURCE, 10 * TARGET)
    assert not found.valid
    assert re.match(r"the clouds' sizes differ (9|10)\.\d : 1; .* same unit", found.reason)
    assert found.reason in found.warnings


def test_a_probability_is_a_logistic_of_standardised_evidence():
    fields = len(PoseFeatures._fields)
    fitted = Logistic((1.0,) * fields, (2.0,) * fields, (0.5,) * fields, -1.0)
    unused = Logistic(*((1.0,) * len(FitFeatures._fields) for _ in range(3)), 0.0)

    def probability(value: float) -> float:
        return success_probability(PoseFeatures(*[value] * fields), Coefficients(unused, fitted))

    terms = fields * 0.5 * (3 - 1) / 2
    assert probability(3.0) == pytest.approx(1 / (1 + np.exp(1 - terms)))
    assert 0 < probability(-1e9) < LIKELY
    assert load_coefficients() == load_coefficients()  # the shipped file is whole


def test_damaged_coefficients_are_named(tmp_path):
    path = tmp_path / "a.json"
    path.write_text('{"mean": {}}')
    with pytest.raises(ValueError, match=r"a\.json must hold.*fit_success"):
        load_coefficients(path)


def test_an_alignment_is_frozen_and_prints_briefly(plain):
    with pytest.raises(dataclasses.FrozenInstanceError):
        plain.valid = True
    assert len(repr(plain)) < 2000
