"""Cut the peers' golden bundles down to fixtures of at most 300 kB: fewer numbers of every kind.

    python tools/cut_peers.py ../shared/peers tests/fixtures/peers

Inputs, weights, poses, losses and masks stay whole; of large intermediate arrays the first corner
stays, of gradients and running averages those of the first and the last turn. What the authors'
weights gave is left out, as these weights are not in the repository either.
"""

import re
import sys
from pathlib import Path

import numpy as np

NAMES = ("dcp", "rienet", "omnet", "finet", "masknet", "inenet")
LIMIT = 300_000
CORNER = (2, 24, 24)
INPUTS = re.compile(
    r"(source|target|template|(source|template)_mask_gt|dropout_uniform)$|override/|config/"
)
DROPPED = {
    "dcp": r"trained",
    "rienet": r"trained",
    "omnet": r"(grad_norm|after_one_forward)/\w+\.[12]\.",
    # The tests in the repository stop after the first turn.
    "finet": r"(grad_norm|after_one_forward|override)/\w+\.[123]\.|iteration[123]/",
    "masknet": r"^$",
    "inenet": r"^$",
}


def cut(name: str, arrays: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """The arrays that stay, and what stays of them."""
    found = {}
    for key, array in arrays.items():
        if re.search(DROPPED[name], key):
            continue
        if key.startswith("fill/check/"):
            # Drawn whole: a corner would be of another shape.
            array = array if array.size <= 4096 else None
        elif array.dtype == np.float32 and not INPUTS.match(key):
            array = array[tuple(slice(size) for size in CORNER[: array.ndim])]
        if array is not None:
            found[key] = array
    return found


def main(source: str, target: str) -> None:
    """Write all fixtures, and say how large they are."""
    Path(target).mkdir(parents=True, exist_ok=True)
    for name in NAMES:
        path = Path(target) / f"{name}_golden.npz"
        arrays = cut(name, dict(np.load(Path(source) / path.name)))
        np.savez_compressed(path, **arrays)
        size = path.stat().st_size
        print(f"{path}: {size:,} bytes, {len(arrays)} arrays")
        if size > LIMIT:
            raise SystemExit(f"{path} must be at most {LIMIT:,} bytes; it has {size:,}. Cut more.")


if __name__ == "__main__":
    main(*sys.argv[1:])
