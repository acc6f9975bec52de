"""Poses on which matches of surface features agree: a proposer for any rotation and overlap."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from dbdnet_jax.alignment.features import angle_histograms
from dbdnet_jax.alignment.surfaces import Surface
from dbdnet_jax.ops.transforms import move, nearest_rotation, transform_of
from dbdnet_jax.types import Points, Transform

DRAWS = 20_000  # triples of matches ...
TRIED = 600  # ... of which the first so many whose sides are alike are made poses
ALIKE = 0.9  # the shorter of two sides per the longer one
SHORTEST = 0.15  # side of a triple, in units of the shape's radius: shorter ones tell no rotation
AGREEING = 0.06  # how far apart a match that agrees with a pose may be, in the same unit
PROPOSED = 4


class MatchedPoints(NamedTuple):
    """Points of both clouds around which the surfaces look alike; many pairs are wrong."""

    source: Float[np.ndarray, "k 3"]
    target: Float[np.ndarray, "k 3"]


def match_surfaces(source: Surface, target: Surface) -> MatchedPoints:
    """Even points whose features are each other's nearest."""
    rows, columns = mutual_matches(angle_histograms(source), angle_histograms(target))
    return MatchedPoints(source.points[source.even[rows]], target.points[target.even[columns]])


def mutual_matches(
    source: Float[np.ndarray, "n f"], target: Float[np.ndarray, "m f"]
) -> tuple[Int[np.ndarray, " k"], Int[np.ndarray, " k"]]:
    """Rows and columns of the features that are each other's nearest."""
    norms = (source**2).sum(axis=1)[:, None], (target**2).sum(axis=1)
    squares = norms[0] + norms[1] - 2 * source @ target.T
    columns = squares.argmin(axis=1)
    rows = np.flatnonzero(squares.argmin(axis=0)[columns] == np.arange(len(source)))
    return rows, columns[rows]


def agreement(pose: Transform, matched: MatchedPoints) -> int:
    """How many matches a pose agrees with."""
    apart = np.linalg.norm(move(pose, matched.source) - matched.target, axis=1)
    return int((apart < AGREEING).sum())


def agreed_poses(matched: MatchedPoints) -> list[Transform]:
    """The poses that most matches agree with, best first (RANSAC, Fischler & Bolles 1981).

    Of triples of matches, each solved again on those that agree with it, and passed over where
    most of these agree with a better one. Perhaps none; draws are the same always.
    """
    source, target = matched
    triples = _alike_triples(source, target)
    if not len(triples):
        return []
    rotation, translation = _procrustes(source[triples], target[triples])
    moved = source @ rotation.transpose(0, 2, 1) + translation[:, None]
    agrees = ((moved - target) ** 2).sum(axis=2) < AGREEING**2
    found, taken = [], np.zeros(len(source), bool)
    for row in np.argsort(-agrees.sum(axis=1), kind="stable"):
        own = agrees[row]
        if own.sum() < 3 or 2 * (own & taken).sum() > own.sum():
            continue
        taken |= own
        found.append(transform_of(*_procrustes(source[own], target[own])))
        if len(found) == PROPOSED:
            break
    return found


def _alike_triples(source: Points, target: Points) -> Int[np.ndarray, "t 3"]:
    """Triples of matches whose triangles are wide enough and have the same sides."""
    if len(source) < 3:
        return np.zeros((0, 3), int)
    triples = np.random.default_rng(0).integers(0, len(source), (DRAWS, 3))
    sides = [
        np.linalg.norm(points[triples] - points[np.roll(triples, 1, axis=1)], axis=2)
        for points in (source, target)
    ]
    shorter, longer = np.minimum(*sides), np.maximum(*sides)
    alike: Bool[np.ndarray, " d"] = (shorter > np.maximum(ALIKE * longer, SHORTEST)).all(axis=1)
    return triples[alike][:TRIED]


def _procrustes(
    source: Float[np.ndarray, "*b n 3"], target: Float[np.ndarray, "*b n 3"]
) -> tuple[Float[np.ndarray, "*b 3 3"], Float[np.ndarray, "*b 3"]]:
    """Rotations and translations that bring points best onto others (Kabsch 1976)."""
    middles = source.mean(axis=-2), target.mean(axis=-2)
    arms = source - middles[0][..., None, :], target - middles[1][..., None, :]
    rotation = nearest_rotation(np.swapaxes(arms[1], -1, -2) @ arms[0])
    return rotation, middles[1] - np.einsum("...ij,...j->...i", rotation, middles[0])
