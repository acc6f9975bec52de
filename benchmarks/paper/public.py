"""The authors' public weights, as they are, on our frozen pairs."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from benchmarks.paper.scoring import figures, of_params
from benchmarks.paper.tables import ISOTROPIC, number, table
from dbdnet_jax.data.test_pairs import PairSet
from dbdnet_jax.networks.params import Params
from dbdnet_jax.networks.table import LEARNED

SETS = ("noise", "clean")
# What no shape tells of files that differ from the defaults.
_SIZES: dict[str, dict[str, Any]] = {
    "rienet_7scenes": {"k1": 8, "k2": 8, "margin": 0.5},
    "rienet_icl_nuim": {"k1": 32, "k2": 10, "margin": 0.5},
}


def public_params(path: Path) -> Params:
    """The weights of a file named METHOD_ANYTHING.t7.

    Raises:
        ValueError: the name begins with no method whose public weights are read.
    """
    method = path.stem.split("_")[0]
    read = LEARNED[method].from_released if method in LEARNED else None
    if read is None:
        known = [name for name, line in LEARNED.items() if line.from_released is not None]
        raise ValueError(
            f"a file of public weights must be named after one of {', '.join(known)}, as "
            f"dcp_v1.t7; got {path.name}. Rename it."
        )
    return read(path, **_SIZES.get(path.stem, {}))


def tables(folder: Path, sets: Mapping[str, PairSet]) -> str:
    """Error R and t of every file in the folder, on each set.

    Raises:
        ValueError: the folder holds no such file.
    """
    files = sorted(folder.glob("*.t7"))
    if not files:
        raise ValueError(f"--public must be a folder with .t7 files; {folder} has none. Name one.")
    body = []
    for path in files:
        method = of_params(path.stem, public_params(path))
        cells = [path.stem]
        for test in sets.values():
            summary = figures(method, test)["all"]
            cells += [number(summary[field], digits) for field, digits in ISOTROPIC.values()]
        body.append(cells)
    return table(["file", *(f"{key}: {head}" for key in sets for head in ISOTROPIC)], body)
