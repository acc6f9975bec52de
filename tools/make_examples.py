"""Write the two partial scans of ``examples/``, and the motion between them.

    python -m tools.make_examples

A shape of the validation split (public domain), some 1.5 m across; each scan sees 70 % of 1024
points drawn on its own, with 5 mm of noise, in a frame of its own.
"""

from pathlib import Path

import jax
import numpy as np

from dbdnet_jax.alignment.writing import write_ply
from dbdnet_jax.data.cad import cad_split
from dbdnet_jax.data.pairs import Protocol, make_pair
from dbdnet_jax.io.files import write_atomic
from dbdnet_jax.ops.transforms import transform_of

FOLDER = Path(__file__).parents[1] / "examples"
SHAPE = "corner sofa"
RADIUS_M = 0.75
FRAME_M = np.array([12.0, -3.5, 0.8])  # where the target's frame puts the shape


def main() -> None:
    """Draw the pair under the paper's protocol and write it in metres."""
    shapes = cad_split("val")
    row = next(i for i, name in enumerate(shapes.names) if SHAPE in name.lower())
    protocol = Protocol(noise_sigma=0.005 / RADIUS_M)
    pair = make_pair(jax.random.key(0), shapes.points[row], shapes.normals[row], protocol)
    pair = jax.tree.map(lambda x: np.asarray(x, np.float64), pair)
    rotation, translation = pair.target_from_source
    motion = transform_of(rotation, RADIUS_M * translation + FRAME_M)
    FOLDER.mkdir(exist_ok=True)
    write_ply(FOLDER / "scan_a.ply", RADIUS_M * pair.source.points)
    write_ply(FOLDER / "scan_b.ply", RADIUS_M * pair.target.points + FRAME_M)
    rows = "".join(" ".join(f"{x:.9g}" for x in row) + "\n" for row in motion)
    write_atomic(FOLDER / "b_from_a.txt", rows.encode())
    print(f"{FOLDER}: {shapes.names[row]} by {shapes.creators[row]}, {shapes.licences[row]}")


if __name__ == "__main__":
    main()
