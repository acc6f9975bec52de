"""Which pairs a configuration is tested on: frozen ones, the same for every method and run."""

import hashlib
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Bool

from dbdnet_jax.data.cad import HALVES, cad_split
from dbdnet_jax.data.config import DataConfig
from dbdnet_jax.data.frozen import CAD_VARIANTS, cad_test_pairs, load_test_set, save_test_set
from dbdnet_jax.data.modelnet40 import load_modelnet40
from dbdnet_jax.data.pairs import Protocol
from dbdnet_jax.data.shapes import Shapes
from dbdnet_jax.data.symmetry import symmetric_shapes
from dbdnet_jax.data.threedmatch import load_correspondences, load_info, load_pair
from dbdnet_jax.metrics.recall import Scans
from dbdnet_jax.types import Pair

TEST_SEED = 2024  # not the run's: results of runs with other seeds compare
CAD_PAIRS = 200
BENCHMARKS = ("3DMatch", "3DLoMatch")  # of scans: of much overlap, and of little


class PairSet(NamedTuple):
    """Stacked NumPy pairs (leading axis on every field), what they are, and their sha256.

    ``scans`` is there for pairs of scans only, ``symmetric`` for pairs of shapes: whether a turn
    brings the shape onto itself.
    """

    name: str
    pairs: Pair
    digest: str
    scans: Scans | None = None
    symmetric: Bool[np.ndarray, " pairs"] | None = None


def load_test_pairs(
    data: DataConfig, protocol: Protocol, folder: str | Path, benchmark: str = BENCHMARKS[0]
) -> PairSet:
    """The test pairs of a data set under a protocol.

    A network trained on the seen half of the classes is tested on the unseen one, and the other
    way round. Where the package has no frozen set for the protocol, the pairs are drawn from
    `TEST_SEED` and written to ``folder``. ``benchmark`` is one of `BENCHMARKS`, for scans.

    Raises:
        FileNotFoundError: the data set's folder, or a file in it, is not there.
        ValueError: no folder given, a damaged file, or a benchmark that the data set has not.
    """
    data.require_folder()
    if benchmark != BENCHMARKS[0] and data.name != "threedmatch":
        raise ValueError(
            f"the benchmark must be {BENCHMARKS[0]!r} unless config.data.name is 'threedmatch': "
            f"only scans have another; got {benchmark!r} for {data.name!r}. Leave --benchmark out, "
            "or use configs/threedmatch.py."
        )
    if data.name == "threedmatch":
        return _scans(data.folder, protocol, benchmark, Path(folder) / "overlap_labels")
    half = None if data.categories == "all" else HALVES[1 - HALVES.index(data.categories)]
    name = f"{data.name}_test_{half or 'all'}"
    if data.name == "cad":
        for variant, (frozen_protocol, frozen_half) in CAD_VARIANTS.items():
            if (protocol, half) == (frozen_protocol, frozen_half):
                pairs, digest = cad_test_pairs(variant)
                symmetric = _symmetric(cad_split("test", half), len(pairs.source.count))
                return PairSet(f"cad_test_{variant}", pairs, digest, symmetric=symmetric)
        shapes, count = cad_split("test", half), CAD_PAIRS
    else:
        shapes = load_modelnet40(data.folder, "test", half or "all")
        count = len(shapes)
    path = Path(folder) / f"{name}.npz"
    path.parent.mkdir(parents=True, exist_ok=True)
    save_test_set(path, shapes, protocol, seed=TEST_SEED, count=count)
    return PairSet(name, *load_test_set(path, shapes), symmetric=_symmetric(shapes, count))


def _symmetric(shapes: Shapes, count: int) -> Bool[np.ndarray, " count"]:
    """Whether the shape of each pair is symmetric; a frozen set takes the shapes in turn."""
    return symmetric_shapes(shapes.points)[np.arange(count) % len(shapes)]


def _scans(folder: str, protocol: Protocol, benchmark: str, cache: Path) -> PairSet:
    """All pairs of 3DMatch or 3DLoMatch; their fragments are read one after the other."""
    info = load_info(folder, benchmark)
    rows = range(len(info))
    pairs = [
        load_pair(
            folder,
            info,
            i,
            points=protocol.points,
            seed=TEST_SEED,
            radius_m=protocol.overlap_radius,
            cache=cache,
        )
        for i in rows
    ]
    stacked = jax.tree.map(lambda *leaves: np.stack(leaves), *pairs)
    digest = hashlib.sha256()
    for leaf in jax.tree.leaves(stacked):
        digest.update(np.ascontiguousarray(leaf).tobytes())
    correspondences = []  # of all pairs at once: some hundred MB in float32
    for i in rows:
        points = load_correspondences(folder, info, i, protocol.overlap_radius)
        correspondences.append((points[0].astype(np.float32), points[1].astype(np.float32)))
    scans = Scans(info.scenes, info.consecutive, correspondences)
    return PairSet(benchmark, stacked, digest.hexdigest(), scans)
