"""What weights make of each part of the mixture, on shapes that nothing was trained on.

    python -m benchmarks.mixture cad runs/mine/params.npz --count=48
    python -m benchmarks.mixture cad --model overlap_points=512 overlap_passes=2

A row for the paper's protocol (194 pairs on the validation shapes, those that training chooses by)
and one for each part of `data.mixture`, drawn from a fixed seed; the hash is of the drawn clouds.
Overlap accuracy stands beside that of the pairs of which less than half overlaps; the time is that
of an answer. `--split=test` draws on the test shapes: for the last table, never to choose by.
`--model` changes what the network sees and how often, without any training for it.
"""

import argparse
import dataclasses
import hashlib
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from dbdnet_jax.data.cad import cad_split
from dbdnet_jax.data.mixture import PARTS, make_part_pair, stock_of
from dbdnet_jax.data.pairs import Protocol, make_pair
from dbdnet_jax.data.training_pairs import VALIDATION_SEED
from dbdnet_jax.data.worlds import OTHERS
from dbdnet_jax.evaluation.methods import Method, from_network
from dbdnet_jax.evaluation.run import evaluate_method
from dbdnet_jax.networks.params import Params
from dbdnet_jax.networks.weights import load_named
from dbdnet_jax.types import Pair

PROTOCOL_PAIRS = 194
LITTLE = 0.5  # overlap below which a pair counts as one of little


class Drawn(NamedTuple):
    """Stacked pairs and what names them."""

    pairs: Pair
    digest: str


def draw_sets(split: str, count: int) -> dict[str, Drawn]:
    """The protocol's pairs and ``count`` of each part, shapes in turn."""
    shapes, protocol = cad_split(split), Protocol()
    stock = jax.tree.map(jnp.asarray, stock_of(shapes.points))
    key = jax.random.key(VALIDATION_SEED)

    @jax.jit
    def of_part(number, part):
        own = jax.random.fold_in(key, number)
        others = jax.random.randint(jax.random.fold_in(own, 9), (OTHERS,), 0, len(shapes))
        return make_part_pair(own, number % len(shapes), others, stock, part, protocol)

    @jax.jit
    def of_protocol(number):
        row = number % len(shapes)
        points = stock.points[row]
        return make_pair(jax.random.fold_in(key, number), points, jnp.zeros_like(points), protocol)

    sets = {"protocol": _stacked([of_protocol(jnp.asarray(i)) for i in range(PROTOCOL_PAIRS)])}
    for name, part in PARTS.items():
        part = jax.tree.map(jnp.float32, part)
        sets[name] = _stacked([of_part(jnp.asarray(i), part) for i in range(count)])
    return sets


def _stacked(pairs: list[Pair]) -> Drawn:
    stacked = jax.tree.map(lambda *leaves: np.stack(leaves), *jax.device_get(pairs))
    clouds = np.concatenate([stacked.source.points, stacked.target.points])
    return Drawn(stacked, hashlib.sha256(clouds.tobytes()).hexdigest()[:12])


def row_of(method: Method, pairs: Pair) -> str:
    """Errors, parts of the pairs that are right, and overlap of one set."""
    row = evaluate_method(method, pairs)
    summary, errors, overlap = row.summary, row.errors, row.overlap
    assert summary is not None and errors is not None and overlap is not None
    right = (errors.rotation_deg < 15) & (errors.translation < 0.2)
    overlapping = pairs.source_overlap.sum(axis=1) + pairs.target_overlap.sum(axis=1)
    little = overlapping < LITTLE * (pairs.source.count + pairs.target.count)
    of_little = "-"
    if little.any():
        few = evaluate_method(method, jax.tree.map(lambda leaf: leaf[little], pairs)).overlap
        assert few is not None
        of_little = f"{few.accuracy:.3f} ({little.sum()})"
    seconds = row.seconds_per_pair
    milliseconds = "-" if seconds is None else f"{1000 * seconds:.0f}"
    return (
        f"{summary.error_rotation_deg:.2f} | {summary.median_rotation_deg:.2f} | "
        f"{summary.error_translation:.3f} | {100 * right.mean():.1f} | "
        f"{overlap.accuracy:.4f} | {overlap.f1:.4f} | {of_little} | {milliseconds}"
    )


def load_changed(name: str, fields: list[str]) -> Params:
    """Weights whose configuration has other numbers in ``fields``, each ``FIELD=NUMBER``."""
    params = load_named(name)
    numbers = {field: int(number) for field, number in (text.split("=") for text in fields)}
    return dataclasses.replace(params, config=dataclasses.replace(params.config, **numbers))


def main() -> None:
    """Read the arguments, draw, print a table for each file of weights."""
    parser = argparse.ArgumentParser("mixture")
    parser.add_argument("weights", nargs="+", help="names in the package or .npz files")
    parser.add_argument("--split", choices=("val", "test"), default="val")
    parser.add_argument("--count", type=int, default=48, help="pairs of each part")
    parser.add_argument("--model", nargs="+", default=[], metavar="FIELD=NUMBER")
    options = parser.parse_args()
    sets = draw_sets(options.split, options.count)
    for name in options.weights:
        try:
            params = load_changed(name, options.model)
        except (TypeError, ValueError, OSError) as error:
            parser.error(str(error))
        method = Method("DBDNet", from_network(params))  # compiled once
        print(f"\n{' '.join([name, *options.model])}, {options.split} shapes\n")
        print(
            "| part | sha256 | Error R | median R | Error t | % below 15 degrees and 0.2 | "
            "overlap accuracy | F1 | accuracy where less than half overlaps (pairs) | ms |"
        )
        print("|---|---|---|---|---|---|---|---|---|---|")
        for part, drawn in sets.items():
            print(f"| {part} | {drawn.digest} | {row_of(method, drawn.pairs)} |", flush=True)


if __name__ == "__main__":
    main()
