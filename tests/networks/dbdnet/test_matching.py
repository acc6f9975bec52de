"""Soft matches of the overlap network: affinities, the motion, and how well points fit."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

from dbdnet_jax.networks.dbdnet.matching import WIDTHS, MatchingLayer, SoftMatches, match_features
from dbdnet_jax.networks.dbdnet.register import predict_overlap_and_matches
from dbdnet_jax.types import Cloud, Rigid
from tests import oracle
from tests.conftest import FLOAT64, assert_close, random_cloud
from tests.networks.dbdnet.small import NETWORK, SMALL, overlap_alone, padded, small_params

N, COUNTS, WIDTH = 9, (8, 6), 5
VALID = [np.arange(N) < count for count in COUNTS]


def stacked_clouds() -> Cloud:
    return Cloud(jnp.asarray(random_cloud(0, 2 * N).reshape(2, N, 3)), jnp.asarray(COUNTS))


def test_matches_are_sinkhorns_and_the_motion_that_of_procrustes(x64):
    clouds = stacked_clouds()
    features = random_cloud(1, 2 * N, WIDTH).reshape(2, N, WIDTH)
    parameters = {"alpha": jnp.asarray(2.0), "beta": jnp.asarray(-0.3)}
    matching = MatchingLayer(4).apply({"params": parameters}, clouds, jnp.asarray(features))
    affinity = [
        [-np.log1p(np.exp(-0.3)) * (oracle.squared_distance(a, b) - 2.0) for b in features[1]]
        for a in features[0]
    ]
    matrix = oracle.sinkhorn(np.array(affinity), *VALID, 4)
    assert_close(jnp.exp(matching.log_matrix), matrix, FLOAT64)
    mass = matrix.sum(1)
    soft = matrix @ np.asarray(clouds.points[1]) / np.where(mass > 0, mass, 1.0)[:, None]
    rotation, translation = oracle.procrustes(np.asarray(clouds.points[0]), soft, mass)
    assert_close(matching.motion.rotation, rotation, NETWORK)
    assert_close(matching.motion.translation, translation, NETWORK)


def test_how_well_a_point_fits_is_its_mass_and_two_distances_after_the_motion(x64):
    clouds = stacked_clouds()
    matrix = np.where(VALID[0][:, None] & VALID[1], np.random.default_rng(2).random((N, N)), 0.0)
    rotation = oracle.rotation_from_euler(np.array([0.3, -0.2, 0.5]))
    motion = Rigid(jnp.asarray(rotation), jnp.asarray([0.1, 0.2, -0.1]))
    log_matrix = jnp.log(jnp.asarray(np.where(matrix > 0, matrix, 1e-300)))
    found = match_features(SoftMatches(clouds, log_matrix, motion))
    source = np.asarray(clouds.points[0]) @ rotation.T + np.asarray(motion.translation)
    target = np.asarray(clouds.points[1])
    for cloud, (own, other, mass) in enumerate(
        [(source, target, matrix), (target, source, matrix.T)]
    ):
        for i in range(COUNTS[cloud]):
            nearest = min(oracle.squared_distance(own[i], x) for x in other[: COUNTS[1 - cloud]])
            match = oracle.squared_distance(own[i], mass[i] @ other / mass[i].sum())
            bells = [np.exp(-d / width**2) for d in (nearest, match) for width in WIDTHS]
            assert_close(found[cloud, i], np.array([mass[i].sum(), *bells]), FLOAT64)


def test_matches_are_told_in_the_callers_frames_whatever_the_padding(x64):
    config = dataclasses.replace(SMALL, overlap_matching=True)
    params = overlap_alone(small_params(3, config))
    source, target = random_cloud(4, 30), random_cloud(5, 27)
    predict = jax.jit(predict_overlap_and_matches)
    *probabilities, matched = predict(params, padded(source, 40, 0.0), padded(target, 40, 0.0))
    shift = np.array([[3.0, -2.0, 1.0], [0.5, 4.0, -1.0]])
    moved = predict(
        params, padded(source + shift[0], 40, np.nan), padded(target + shift[1], 40, 1e3)
    )
    assert_close(moved[0], probabilities[0], NETWORK)
    assert_close(moved[1], probabilities[1], NETWORK)
    assert_close(moved[2].motion.rotation, matched.motion.rotation, NETWORK)
    expected = matched.motion.translation + shift[1] - matched.motion.rotation @ shift[0]
    assert_close(moved[2].motion.translation, expected, NETWORK)
    for cloud, (size, points) in enumerate(zip((30, 27), matched.clouds.points, strict=True)):
        expected = np.asarray(points[:size]) + shift[cloud]
        assert_close(moved[2].clouds.points[cloud, :size], expected, NETWORK)


def test_a_second_pass_goes_on_from_the_motion_of_the_first(x64):
    one = dataclasses.replace(SMALL, overlap_matching=True)
    two = dataclasses.replace(one, overlap_passes=2)
    clouds = padded(random_cloud(4, 30) + 1.0, 40, 0.0), padded(random_cloud(5, 27) - 2.0, 40, 0.0)
    predict = jax.jit(predict_overlap_and_matches)
    params = overlap_alone(small_params(3, one))
    first = predict(params, *clouds)[2].motion
    *probabilities, matched = predict(params, *clouds, start=first)
    *both, after = predict(params.replace(config=two), *clouds)
    for found, expected in zip(both, probabilities, strict=True):
        assert_close(found, expected, NETWORK)
    assert_close(after.motion.rotation, matched.motion.rotation, NETWORK)
    assert_close(after.motion.translation, matched.motion.translation, NETWORK)
    assert np.linalg.norm(after.motion.rotation - first.rotation) > 0.01
