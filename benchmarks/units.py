"""`align` on test pairs as they are, and in other units, far away and in another order.

    python -m benchmarks.units --pairs=100

Each pair is multiplied by a factor between 0.001 and 1000, moved by up to a million times its size,
and its rows are shuffled; the answer is brought back and must be as right as the plain one. Prints
both rows of errors, in the units of the shapes, and how far the two answers lie apart.
"""

import argparse

import jax
import numpy as np
from tqdm import tqdm

from dbdnet_jax.alignment.align import Alignment, align
from dbdnet_jax.data.frozen import cad_test_pairs
from dbdnet_jax.io.programs import keep_compiled_programs
from dbdnet_jax.metrics.pose import motion_errors, summarise
from dbdnet_jax.types import Rigid

FAR = 1e6  # shape radii: map projections of small scenes
SEED = 11


def main() -> None:
    """Align every pair twice and print both summaries."""
    parser = argparse.ArgumentParser("units")
    parser.add_argument("--pairs", type=int, default=100)
    count = parser.parse_args().pairs
    keep_compiled_programs()
    pairs, digest = cad_test_pairs("noise")
    rng = np.random.default_rng(SEED)
    errors: dict[str, list] = {"as they are": [], "re-expressed": []}
    apart = []
    for i in tqdm(range(count)):
        source, target = (np.asarray(c.points[i], np.float64) for c in (pairs.source, pairs.target))
        truth = jax.tree.map(lambda leaf: leaf[i], pairs.target_from_source)  # noqa: B023
        plain = pose_of(align(source, target))
        factor = 10.0 ** rng.uniform(-3, 3)
        shifts = rng.uniform(-FAR, FAR, (2, 3))
        moved = (
            rng.permutation((cloud + shift) * factor)
            for cloud, shift in zip((source, target), shifts, strict=True)
        )
        found = pose_of(align(*moved))
        translation = found.translation / factor - shifts[1] + found.rotation @ shifts[0]
        found = Rigid(found.rotation, translation)
        for name, pose in zip(errors, (plain, found), strict=True):
            errors[name].append(motion_errors(pose, truth))
        apart.append(motion_errors(found, plain))
    print(f"{count} test pairs with noise (sha256 {digest[:8]})")
    for name, of_pairs in {**errors, "between the two": apart}.items():
        row = summarise(jax.tree.map(lambda *leaves: np.stack(leaves), *of_pairs))
        print(
            f"{name:16s} Error R {row.error_rotation_deg:7.3f}"
            f"  median {row.median_rotation_deg:7.4f}  Error t {row.error_translation:.4f}"
            f"  median {row.median_translation:.5f}"
            f"  < 5 deg & < 0.1: {row.recall_5deg_0p1:.1%}"
        )


def pose_of(alignment: Alignment) -> Rigid:
    """The motion, in float64."""
    return Rigid(alignment.rotation, alignment.translation)


if __name__ == "__main__":
    main()
