"""Whether a pose holds because one cloud is the mirror image of the other.

Much of a thing fits its mirror image nearly as well, so no single measure tells: how the poses fit,
how far the points lie from each other and how many matches agree are added up.
"""

import math

import numpy as np

from dbdnet_jax.alignment import pose_programs
from dbdnet_jax.alignment.candidates import examine, far_starts
from dbdnet_jax.alignment.consensus import agreed_poses, agreement
from dbdnet_jax.alignment.normalised import NormalisedPair
from dbdnet_jax.alignment.search import LIKELY, Found, even_points
from dbdnet_jax.alignment.success import Coefficients, fit_score
from dbdnet_jax.alignment.surfaces import inlier_distance, mapped, measure_fit
from dbdnet_jax.alignment.validity import Trust
from dbdnet_jax.ops.transforms import finer_cube_rotations, move

# Logarithms of odds, added up from three measures. On 32 pairs of asymmetric chairs of boxes that
# were aligned well they came to at most -0.4; on 26 whose source was mirrored, to at least 0.23. On
# right ones of `tools/scan_pairs` they came to up to 1.2, and of validation shapes turned by 30
# degrees to up to 4.9: of things with a plane of symmetry the mirrored source may happen to cover
# more. So they have to outweigh that mirrored sources are rare, and then the odds of the pose.
RARE = 2.0
PERHAPS = 0.2  # from here on a warning
PER_RMSE = 8.0  # for each part by which the truncated RMSE is lower
FEW = 3  # added to both numbers of matches: of few, the ratio tells little
KEPT = 4  # of the coarsely refined poses: with twice as many no evidence on 73 pairs grew
# Not asked where so many matches agree with the answer, and so many times as with any mirrored one.
MANY, TELLING = 12, 2.0


def trust_beside_mirror(scene: NormalisedPair, found: Found, coefficients: Coefficients) -> Trust:
    """What is left of the trust in a pose by what mirroring the source would better."""
    return weigh(found.probability, mirrored_evidence(scene, found, coefficients))


def weigh(probability: float, evidence: float) -> Trust:
    """The odds of a pose that is right, less those of a mirrored source beyond what is `RARE`."""
    cure = "when it is mirrored: is one cloud in a left-handed frame? Negate one coordinate of it"
    odds = probability * math.exp(-max(evidence - RARE, 0.0))
    left = odds / (odds + 1 - probability)
    if left < LIKELY:
        return Trust(left, f"the source fits better {cure}", ())
    if evidence >= PERHAPS:
        warning = f"the source fits as well or better {cure}, if it has no symmetry"
        return Trust(left, "", (warning,))
    return Trust(left, "", ())


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
    reflection = flip[:, None] * found.pose[:3, :3]
    mirrored = mapped(source, (moved - middle) * flip, reflection)
    starts = far_starts(mirrored, target, finer_cube_rotations())  # no network proposes one here
    best = examine(starts, mirrored, target, coefficients, keep=KEPT, close=poses)[0]
    fit = measure_fit(found.pose, source, target, inlier_distance(source, target))
    rmse, rmse_mirrored = (
        pose_programs.truncated_rmse(pose, even_points(side), even_points(target))
        for pose, side in ((found.pose, source), (best.pose, mirrored))
    )
    better_fit = best.score - fit_score(fit, coefficients)
    nearer = PER_RMSE * (1 - rmse_mirrored / max(rmse, 1e-9))
    agreeing = math.log((agreement(best.pose, reflected) + FEW) / (own + FEW))
    return better_fit + nearer + agreeing
