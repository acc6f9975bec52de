"""Two methods without weights that Open3D does not have: KISS-Matcher and GICP.

Lengths are those of clouds in the unit sphere. KISS-Matcher's voxel is the best of five, from 0.02
to 0.1, on 20 validation pairs; GICP's keeps about all of 717 points.
"""

from typing import Any

import numpy as np

from dbdnet_jax.errors import MissingExtraError
from dbdnet_jax.types import OtherPoints, Points, Rigid

VOXEL = 0.08  # KISS-Matcher: its features' radii are 3 and 5 of it
GICP_VOXEL = 0.02
GICP_DISTANCE = 1.0  # as ICP's: the clouds start up to 1.7 apart
GICP_ITERATIONS = 200


def kiss_matcher(source: Points, target: OtherPoints) -> Rigid:
    """KISS-Matcher (Lim et al. 2025).

    Raises:
        MissingExtraError: it is not installed.
    """
    library = _load("kiss_matcher", "kiss-matcher")
    matcher = library.KISSMatcher(library.KISSMatcherConfig(VOXEL))
    found = matcher.estimate(np.float32(source), np.float32(target))
    return Rigid(np.float32(found.rotation), np.float32(found.translation).reshape(3))


def gicp(source: Points, target: OtherPoints) -> Rigid:
    """Generalised ICP (Segal et al. 2009) from the identity, as small_gicp has it.

    Raises:
        MissingExtraError: it is not installed.
    """
    library = _load("small_gicp", "small-gicp")
    found = library.align(
        np.float64(target),
        np.float64(source),
        registration_type="GICP",
        downsampling_resolution=GICP_VOXEL,
        max_correspondence_distance=GICP_DISTANCE,
        max_iterations=GICP_ITERATIONS,
    ).T_target_source
    return Rigid(np.float32(found[:3, :3]), np.float32(found[:3, 3]))


def _load(module: str, package: str) -> Any:
    try:
        return __import__(module)
    except ImportError as error:
        raise MissingExtraError(
            f"The row of {module} needs the library; importing it failed ({error}). Install it "
            f"with `pip install {package}`."
        ) from error
