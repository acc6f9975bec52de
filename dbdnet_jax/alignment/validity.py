"""Whether a pose is to be trusted, and what its user should know: in words."""

from collections.abc import Iterator

import numpy as np
from jaxtyping import Float

from dbdnet_jax.alignment.normalised import NormalisedPair, size_ratio
from dbdnet_jax.alignment.quality import PoseQuality, in_words, written
from dbdnet_jax.alignment.search import AlternativePose, NetworkPose

LOW_OVERLAP, NO_OVERLAP = 0.3, 0.1  # inlier ratios that give a warning, and no valid pose
UNEQUAL, INCOMPATIBLE = 2.0, 4.0  # sizes of the clouds that do the same
LINE = 1e-3  # width of what counts as a line, per length
AS_GOOD = 0.1  # logarithm of an alternative's truncated RMSE per the pose's: below, they fit alike
LIKELY = 0.5  # success probability of a valid pose


def rejection_reason(
    scene: NormalisedPair, predicted: NetworkPose, quality: PoseQuality, probability: float
) -> str:
    """Why the pose is not to be trusted; "" if it is."""
    for name, side in (("source", scene.source), ("target", scene.target)):
        if _is_line(side.sparse):
            return f"the {name}'s points lie on a line: the rotation about it is free"
    if size_ratio(scene) > INCOMPATIBLE:
        return _unequal(scene)
    if not predicted.valid:
        return "the network found too few points that the clouds have in common"
    inliers = quality.inlier.mean()
    if inliers < NO_OVERLAP:
        return f"only {inliers:.0%} of the source comes close to the target"
    if quality.degenerate_motions:
        return f"the surfaces leave free: {in_words(quality.degenerate_motions)}"
    if probability < LIKELY:
        return f"the pose is right with a probability of only {probability:.2f}"
    return ""


def warnings(
    scene: NormalisedPair, quality: PoseQuality, alternative: AlternativePose
) -> Iterator[str]:
    """What should be known even of a valid pose."""
    for name, side in (("source", scene.source), ("target", scene.target)):
        if outliers := side.downsampled.outliers:
            yield f"{outliers} points of the {name}, far from the rest, were left out"
    if size_ratio(scene) > UNEQUAL:
        yield _unequal(scene)
    if (inliers := quality.inlier.mean()) < LOW_OVERLAP:
        yield f"low overlap: {inliers:.0%} of the source comes close to the target"
    if quality.degenerate_motions:
        yield f"the surfaces leave free: {in_words(quality.degenerate_motions)}"
    if alternative.margin < AS_GOOD:
        turn = f"turned by {alternative.angle_deg:.0f} degrees about {written(alternative.axis)}"
        yield f"the clouds fit as well when {turn}: a symmetric shape?"


def _unequal(scene: NormalisedPair) -> str:
    return f"the clouds' sizes differ {size_ratio(scene):.1f} : 1; are both in the same unit?"


def _is_line(points: Float[np.ndarray, "n 3"]) -> bool:
    lengths = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    return bool(lengths[1] < LINE * lengths[0])
