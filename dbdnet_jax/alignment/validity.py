"""Whether a pose is to be trusted, and what its user should know: in words."""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from dbdnet_jax.alignment.normalised import NormalisedPair, size_ratio
from dbdnet_jax.alignment.quality import in_words, written
from dbdnet_jax.alignment.search import CONFIDENT, LIKELY, Found
from dbdnet_jax.ops.transforms import angle_between

LOW_OVERLAP, NO_OVERLAP = 0.3, 0.1  # inlier ratios that give a warning, and no valid pose
# Sizes of the clouds that give a warning and ask for a confident pose, and that give no valid one.
UNEQUAL, INCOMPATIBLE = 2.0, 4.0
LINE = 1e-3  # width of what counts as a line, per length
AS_GOOD = 0.3  # how much the best other pose's score is lower, a logarithm of odds: they fit alike


class Trust(NamedTuple):
    """The probability that a pose is right, why not to trust it ("" if it is), what to know."""

    probability: float
    reason: str
    warnings: tuple[str, ...]


def rejection_reason(scene: NormalisedPair, found: Found) -> str:
    """Why the pose is not to be trusted, and what may help; "" if it is."""
    for name, side in (("source", scene.source), ("target", scene.target)):
        if _is_line(side.sparse):
            return f"the {name}'s points lie on a line: the rotation about it is free"
    ratio = size_ratio(scene)
    if ratio > INCOMPATIBLE or (ratio > UNEQUAL and found.probability < CONFIDENT):
        return _unequal(scene)
    inliers = found.quality.inlier.mean()
    if inliers < NO_OVERLAP:
        return f"only {inliers:.0%} of the source comes close to the target"
    if found.quality.degenerate_motions:
        return f"the surfaces leave free: {in_words(found.quality.degenerate_motions)}"
    if found.probability < LIKELY:
        return _doubt(found, inliers)
    return ""


def _doubt(found: Found, inliers: float) -> str:
    """A low probability in words: what was searched, what was found, what may help."""
    words = f"the pose is right with a probability of only {found.probability:.2f}"
    if found.margin < AS_GOOD:
        cause = "other poses fit as well"
    else:
        cause = f"{inliers:.0%} of the source comes close to the target"
    if not found.refined:
        return f"{words}: {cause}, of poses as they were given; refine=True may help"
    where = "all rotations" if found.everywhere else "only what is near the given orientation"
    cure = "" if found.everywhere else 'search="any" or '
    return f"{words}: {cause}, of {where}; {cure}a rough initial= may help"


def warnings(scene: NormalisedPair, found: Found) -> Iterator[str]:
    """What should be known even of a valid pose."""
    for name, side in (("source", scene.source), ("target", scene.target)):
        if outliers := side.downsampled.outliers:
            yield f"{outliers} points of the {name}, far from the rest, were left out"
    if size_ratio(scene) > UNEQUAL:
        yield _unequal(scene)
    if (inliers := found.quality.inlier.mean()) < LOW_OVERLAP:
        yield f"low overlap: {inliers:.0%} of the source comes close to the target"
    if found.quality.degenerate_motions:
        yield f"the surfaces leave free: {in_words(found.quality.degenerate_motions)}"
    if found.margin < AS_GOOD:
        angle, axis = angle_between(found.others[0].pose, found.pose)
        turn = f"turned by {angle:.0f} degrees about {written(axis)}"
        yield f"the clouds fit as well when {turn}: a symmetric shape?"


def _unequal(scene: NormalisedPair) -> str:
    return f"the clouds' sizes differ {size_ratio(scene):.1f} : 1; are both in the same unit?"


def _is_line(points: Float[np.ndarray, "n 3"]) -> bool:
    lengths = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    return bool(lengths[1] < LINE * lengths[0])
