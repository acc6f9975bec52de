"""Losses against plain NumPy written from their definitions, and what padding must not do."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dbdnet_jax.training.losses import (
    MATCH_WIDTH,
    LossWeights,
    focal_loss,
    matching_loss,
    overlap_loss,
    registration_loss,
    rotation_loss,
    translation_loss,
)
from dbdnet_jax.types import Branch, Cloud, Pair, Registration, Rigid
from tests.conftest import EXACT, assert_close, assert_finite, check_gradients, random_cloud

N, M, COUNT = 12, 9, 8


def rotation_about(axis: int, angle: float) -> np.ndarray:
    rotation = np.eye(3)
    first, second = [i for i in range(3) if i != axis]
    rotation[[first, first, second, second], [first, second, first, second]] = (
        *(np.cos(angle), -np.sin(angle)),
        *(np.sin(angle), np.cos(angle)),
    )
    return rotation


def example(padding: float = 0.0) -> tuple[Registration, Pair]:
    """An answer and its pair, float64; ``padding`` fills what must not matter."""
    rng = np.random.default_rng(3)
    source, target = random_cloud(1, N), random_cloud(2, M)
    source[COUNT:] = padding
    kept = np.arange(N) % 2 == 0
    kept[COUNT:] = False
    soft = [rng.normal(size=(N, 3)) for _ in range(2)]
    branches = [
        Branch(jnp.zeros((N, M)), jnp.where(kept[:, None], s, padding), jnp.ones(N)) for s in soft
    ]
    probability = rng.uniform(0.05, 0.95, N), rng.uniform(0.05, 0.95, M)
    probability[0][COUNT:] = padding
    answer = Registration(
        jnp.asarray(rotation_about(0, 0.4) @ rotation_about(2, -0.3)),
        jnp.asarray([0.1, -0.2, 0.3]),
        *map(jnp.asarray, probability),
        jnp.asarray(kept),
        jnp.ones(M, bool),
        branches[0],
        branches[1],
        jnp.ones(N),
        jnp.asarray(True),
    )
    pair = Pair(
        Cloud(jnp.asarray(source), jnp.asarray(COUNT)),
        Cloud(jnp.asarray(target), jnp.asarray(M)),
        Rigid(jnp.asarray(rotation_about(1, 0.5)), jnp.asarray([0.3, 0.1, -0.4])),
        jnp.asarray(rng.random(N) < 0.7),
        jnp.asarray(rng.random(M) < 0.7),
        jnp.zeros((N, 3)),
        jnp.zeros((M, 3)),
    )
    return answer, pair


def focal_oracle(probability, label, count: int, gamma: float) -> float:
    losses = []
    for p, positive in zip(np.asarray(probability)[:count], np.asarray(label)[:count], strict=True):
        p_true = p if positive else 1 - p
        losses.append((1 - p_true) ** gamma * -np.log(p_true))
    return sum(losses) / len(losses)


@pytest.mark.parametrize("gamma", [4.0, 2.0, 0.0])
def test_focal_loss_is_the_mean_over_valid_points(precision, gamma):
    answer, pair = example()
    probability = answer.src_overlap.astype(precision.dtype)
    loss = focal_loss(probability, pair.source_overlap, jnp.arange(N) < COUNT, gamma)
    expected = focal_oracle(probability, pair.source_overlap, COUNT, gamma)
    assert_close(loss, expected, precision.tolerance)


@pytest.mark.parametrize("gamma", [4.0, 1.0, 0.5, 0.0])  # 0 is the CAD configuration's
def test_focal_loss_is_finite_at_certainty_and_zero_without_points(gamma):
    probability = jnp.asarray([0.0, 1.0, 0.0, 1.0])
    label = jnp.asarray([True, True, False, False])
    value, gradient = jax.value_and_grad(focal_loss)(probability, label, jnp.ones(4, bool), gamma)
    assert_finite((value, gradient))
    assert not gradient[1:3].any()
    assert value > 1
    assert focal_loss(probability, label, jnp.zeros(4, bool)) == 0


def matching_oracle(matrix, source, target, width: float) -> float:
    """Cross-entropy with a bell of labels, or with keeping the mass where no point is near."""
    losses = []
    for mass, own, other in ((matrix, source, target), (matrix.T, target, source)):
        total = 0.0
        for row, point in zip(mass, own, strict=True):
            squares = np.sum((other - point) ** 2, axis=1)
            label = np.where(squares < (2.5 * width) ** 2, np.exp(-squares / (2 * width**2)), 0.0)
            if label.any():
                total -= np.sum(label * np.log(row)) / label.sum()
            else:
                total -= np.log(1 - row.sum())
        losses.append(total / len(own))
    return sum(losses) / 2


def test_matching_loss_is_a_cross_entropy_over_the_points_of_both_clouds(x64):
    rng = np.random.default_rng(5)
    truth = Rigid(jnp.asarray(rotation_about(0, 0.6)), jnp.asarray([0.2, 0.0, -0.1]))
    source = 0.2 * random_cloud(6, N)
    placed = source @ np.asarray(truth.rotation).T + np.asarray(truth.translation)
    target = np.vstack([placed[:6] + 0.02 * random_cloud(7, 6), 3.0 + random_cloud(8, M - 6)])
    matrix = rng.random((N, M)) / (2 * N)
    matrix[COUNT:] = np.nan
    source[COUNT:] = np.nan
    clouds = [Cloud(*map(jnp.asarray, x)) for x in ((source, COUNT), (target, M))]
    value, slope = jax.value_and_grad(matching_loss)(jnp.log(matrix), *clouds, truth)
    expected = matching_oracle(matrix[:COUNT], placed[:COUNT], target, MATCH_WIDTH)
    assert_close(value, expected, EXACT)
    assert_finite(slope)
    assert not slope[COUNT:].any() and slope[:COUNT].any(axis=1).all()


def test_overlap_loss_counts_each_cloud_half(x64):
    answer, pair = example()
    total, terms = overlap_loss(answer.src_overlap, answer.tgt_overlap, pair)
    expected = (
        focal_oracle(answer.src_overlap, pair.source_overlap, COUNT, 4.0) / 2,
        focal_oracle(answer.tgt_overlap, pair.target_overlap, M, 4.0) / 2,
        0.0,  # this network does not match
    )
    np.testing.assert_allclose(terms, expected, rtol=1e-12)
    np.testing.assert_allclose(total, sum(expected), rtol=1e-12)


def registration_oracle(answer: Registration, pair: Pair, weights: LossWeights) -> list[float]:
    """Correspondence, rotation, translation, distance: loops over rows and coordinates."""
    true_rotation = np.asarray(pair.target_from_source.rotation)
    true_translation = np.asarray(pair.target_from_source.translation)
    rotation, translation = np.asarray(answer.rotation), np.asarray(answer.translation)
    misses, distances = [], []
    for row in range(COUNT):
        x = np.asarray(pair.source.points)[row]
        true = true_rotation @ x + true_translation
        distances += list(np.abs(rotation @ x + translation - true))
        if answer.src_kept[row]:
            for branch in (answer.rotation_branch, answer.translation_branch):
                misses += list(np.abs(np.asarray(branch.target)[row] - true))
    return [
        weights.correspondence * np.mean(misses),
        weights.rotation * np.abs(true_rotation.T @ rotation - np.eye(3)).sum() / 9,
        weights.translation * ((translation - true_translation) ** 2).sum() / 3,
        weights.distance * np.mean(distances),
    ]


@pytest.mark.parametrize("weights", [LossWeights(), LossWeights(2.0, 5.0, 3.0, 0.5)])
def test_registration_loss_is_the_sum_of_its_weighted_terms(x64, weights):
    answer, pair = example()
    total, terms = registration_loss(answer, pair, weights)
    assert terms._fields == ("correspondence", "rotation", "translation", "distance")
    np.testing.assert_allclose(terms, registration_oracle(answer, pair, weights), rtol=1e-12)
    np.testing.assert_allclose(total, sum(terms), rtol=1e-12)


def test_the_truth_costs_nothing(x64):
    answer, pair = example()
    true = pair.target_from_source
    assert_close(rotation_loss(true.rotation, true.rotation), 0.0, EXACT._replace(atol=1e-15))
    assert translation_loss(true.translation, true.translation) == 0


@pytest.mark.parametrize("padding", [7.0, np.nan])
def test_padding_changes_neither_losses_nor_gradients(x64, padding):
    def losses(answer, pair):
        overlap, _ = overlap_loss(answer.src_overlap, answer.tgt_overlap, pair)
        return overlap + registration_loss(answer, pair, LossWeights())[0]

    def motion_and_gradient(answer, pair):
        return jax.value_and_grad(
            lambda rotation: losses(answer._replace(rotation=rotation), pair)
        )(answer.rotation)

    expected = motion_and_gradient(*example())
    found = motion_and_gradient(*example(padding))
    jax.tree.map(lambda a, b: assert_close(a, b, EXACT), found, expected)


def test_no_kept_point_gives_zero_correspondence_loss_and_finite_gradients(x64):
    answer, pair = example()
    answer = answer._replace(src_kept=jnp.zeros(N, bool))

    def loss(targets):
        branch = answer.rotation_branch._replace(target=targets)
        total, terms = registration_loss(
            answer._replace(rotation_branch=branch), pair, LossWeights()
        )
        return total, terms

    (_, terms), gradient = jax.value_and_grad(loss, has_aux=True)(answer.rotation_branch.target)
    assert terms.correspondence == 0
    assert_close(gradient, np.zeros((N, 3)), EXACT)


def test_nan_in_a_valid_row_reaches_the_loss():
    answer, pair = example()
    points = pair.source.points.at[0].set(jnp.nan)
    pair = pair._replace(source=pair.source._replace(points=points))
    _, terms = registration_loss(answer, pair, LossWeights())
    assert np.isnan(terms.correspondence) and np.isnan(terms.distance)


def test_gradients(x64):
    answer, pair = example()
    check_gradients(
        lambda p: focal_loss(p, pair.source_overlap, jnp.arange(N) < COUNT), answer.src_overlap
    )

    def loss(rotation, translation, targets):
        branch = answer.rotation_branch._replace(target=targets)
        moved = answer._replace(rotation=rotation, translation=translation, rotation_branch=branch)
        return registration_loss(moved, pair, LossWeights())[0]

    check_gradients(loss, answer.rotation, answer.translation, answer.rotation_branch.target)
