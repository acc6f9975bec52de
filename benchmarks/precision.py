"""What products in bfloat16 do to the answers of the weights in the package.

    python -m benchmarks.precision --count=200

Scores the network as it is and with rounded kernels (`params.bfloat16_kernels`) on the first frozen
noisy test pairs of the CAD shapes and on as many pairs of the validation shapes under the same
protocol. Prints JSON: mean and median errors, recall, and by how much the answers to one pair
differ, in degrees.
"""

import argparse
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.machine import publish, record
from dbdnet_jax.data.cad import cad_split
from dbdnet_jax.data.frozen import cad_test_pairs
from dbdnet_jax.data.pairs import Protocol
from dbdnet_jax.data.training_pairs import pairs_of_shapes
from dbdnet_jax.evaluation.methods import Method, from_network
from dbdnet_jax.evaluation.run import Row, evaluate_method
from dbdnet_jax.metrics.pose import motion_errors
from dbdnet_jax.networks.params import bfloat16_kernels
from dbdnet_jax.networks.weights import load_pretrained
from dbdnet_jax.types import Pair

FIGURES = (
    "error_rotation_deg",
    "error_translation",
    "median_rotation_deg",
    "median_translation",
    "recall_5deg_0p1",
    "recall_15deg_0p3",
)


def compared(pairs: Pair) -> dict[str, Any]:
    """Figures of both precisions on stacked pairs, and how far their answers lie apart."""
    params = load_pretrained("cad")
    low = params.replace(networks=bfloat16_kernels(params.networks))
    answers = {"float32": params, "bfloat16": low}
    rows = {
        name: evaluate_method(Method(name, from_network(x)), pairs) for name, x in answers.items()
    }
    found: dict[str, Any] = {name: _figures(row) for name, row in rows.items()}
    apart = jax.vmap(motion_errors)(
        *(jax.tree.map(jnp.asarray, row.motions) for row in rows.values())
    )
    degrees = np.asarray(apart.rotation_deg)
    parts = {"median": 50, "at_90_percent": 90, "largest": 100}
    return found | {"apart_deg": {k: _short(np.percentile(degrees, x)) for k, x in parts.items()}}


def _figures(row: Row) -> dict[str, float]:
    assert row.summary is not None and row.overlap is not None
    found = {name: _short(getattr(row.summary, name)) for name in FIGURES}
    return found | {"overlap_f1": _short(row.overlap.f1), "seconds": _short(row.seconds_per_pair)}


def _short(value: float | None) -> float:
    return float(f"{value:.4g}")


def main() -> None:
    """Print one JSON object."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--count", type=int, default=200, help="pairs of each kind")
    parser.add_argument("--out", help="file for the record, beside printing it")
    options = parser.parse_args()
    test = jax.tree.map(lambda leaf: np.asarray(leaf)[: options.count], cad_test_pairs("noise")[0])
    shapes = cad_split("val")
    stream = pairs_of_shapes(shapes, shapes, Protocol(), seed=0, validation_pairs=options.count)
    validation = jax.tree.map(np.asarray, stream.validation)
    figures = {"test_pairs": compared(test), "validation_pairs": compared(validation)}
    publish(record("benchmarks.precision", {"pairs": options.count, **figures}), options.out)


if __name__ == "__main__":
    main()
