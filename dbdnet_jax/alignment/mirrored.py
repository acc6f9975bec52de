"""Whether a pose holds because one cloud is the mirror image of the other.

Much of a thing fits its mirror image nearly as well, so no single measure tells: how the poses fit,
how far the points lie from each other and how many matches agree are added up.
"""

import math

import numpy as np

from dbdnet_jax.alignment import search
from dbdnet_jax.alignment.candidates import examine, far_starts
from dbdnet_jax.alignment.consensus import agreed_poses, agreement
from dbdnet_jax.alignment.finding import Found, even_points
from dbdnet_jax.alignment.normalised import NormalisedPair
from dbdnet_jax.alignment.success import Coefficients, fit_score
from dbdnet_jax.alignment.surfaces import inlier_distance, measure_fit, surface
from dbdnet_jax.ops.transforms import finer_cube_rotations, move

# Logarithms of odds, added up from three measures. On 32 pairs of asymmetric chairs of boxes that
# were aligned well it came to at most -0.4, and on 26 whose source was mirrored, to at least 0.23.
# On 34 of `tools/scan_pairs` it came to up to 1.13: of things with a plane of symmetry that overlap
# little, the mirrored source may cover more. So all but far more than that is a warning only.
MIRRORED, PERHAPS = 3.0, 0.2
PER_RMSE = 8.0  # for each part by which the truncated RMSE is lower
FEW = 3  # added to both numbers of matches: of few, the ratio tells little
KEPT = 8  # of the coarsely refined poses
# Not asked where so many matches agree with the answer, and so many times as with any mirrored one.
MANY, TELLING = 12, 2.0


def mirror_doubts(
    scene: NormalisedPair, found: Found, coefficients: Coefficients
) -> tuple[str, tuple[str, ...]]:
    """Why the clouds are mirrored images ("" if that is not sure), and a warning if they may be."""
    return in_words(mirrored_evidence(scene, found, coefficients))


def in_words(evidence: float) -> tuple[str, tuple[str, ...]]:
    """The reason and the warnings that a logarithm of odds gives."""
    cure = "when it is mirrored: is one cloud in a left-handed frame? Negate one coordinate of it"
    if evidence >= MIRRORED:
        return f"the source fits clearly better {cure}", ()
    if evidence >= PERHAPS:
        return "", (f"the source fits as well or better {cure}, if it has no symmetry",)
    return "", ()


def mirrored_evidence(scene: NormalisedPair, found: Found, coefficients: Coefficients) -> float:
    """The logarithm of the odds that the mirrored source's best pose is the better answer."""
    source, target = scene.source.surface, scene.target.surface
    flip = np.array([1.0, 1.0, -1.0])
    moved = move(found.pose, source.points)
    middle = moved.mean(axis=0)
    matched = found.clues.matched
    # What the surfaces look like does not tell a mirrored one, so the same matches serve.
    reflected = matched._replace(source=(move(found.pose, matched.source) - middle) * flip)
    poses = agreed_poses(reflected)
    own = agreement(found.pose, matched)
    if own > max(MANY, TELLING * max((agreement(pose, reflected) for pose in poses), default=0)):
        return -math.inf
    mirrored = surface((moved - middle) * flip, source.even)
    starts = far_starts(mirrored, target, finer_cube_rotations())  # no network proposes one here
    best = examine(starts, mirrored, target, coefficients, keep=KEPT, close=poses)[0]
    fit = measure_fit(found.pose, source, target, inlier_distance(source, target))
    rmse, rmse_mirrored = (
        search.truncated_rmse(pose, even_points(side), even_points(target))
        for pose, side in ((found.pose, source), (best.pose, mirrored))
    )
    better_fit = best.score - fit_score(fit, coefficients)
    nearer = PER_RMSE * (1 - rmse_mirrored / max(rmse, 1e-9))
    agreeing = math.log((agreement(best.pose, reflected) + FEW) / (own + FEW))
    return better_fit + nearer + agreeing
