"""How often `align` is right on pairs of real clouds whose true pose is known.

    taskset -c 0 python -m benchmarks.real_pairs FOLDER --out=real_pairs.jsonl

FOLDER holds NAME.npz files: ``source`` and ``target``, (n, 3) and (m, 3) integers in a common
frame, each with a ``_step`` and an ``_origin`` that make lengths of them, and ``native`` (4, 4),
the pose in which the files came (NaN where there was none). The source is moved back to where it
came from, by a rotation of 10 to 45 degrees, and by one of 45 to 180, drawn from a seed of the
name. Right: within 5 degrees, and the source's centroid within 5 % of the target's extent.
Seconds are of the CPU, after a first call has loaded the programs.
"""

import argparse
import json
import time
import zlib
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from dbdnet_jax.alignment.align import align
from dbdnet_jax.io.programs import keep_compiled_programs
from dbdnet_jax.networks.params import Params
from dbdnet_jax.networks.weights import load_named
from dbdnet_jax.ops.transforms import angle_between, move, transform_of
from dbdnet_jax.types import Points, Transform

VARIANTS = {"native": "as they came", "near": "10 to 45 degrees", "any": "45 to 180 degrees"}


def extent(points: Points) -> float:
    """The diagonal of the box that holds all but the outermost hundredths."""
    low, high = np.percentile(points, [1, 99], axis=0)
    return float(np.linalg.norm(high - low))


def drawn_motion(name: str, variant: str, source: Points) -> Transform:
    """A rotation about the source's centroid and a shift by half of its extent."""
    rng = np.random.default_rng([zlib.crc32(name.encode()), list(VARIANTS).index(variant)])
    degrees = rng.uniform(10, 45) if variant == "near" else rng.uniform(45, 180)
    axis, shift = rng.normal(size=(2, 3))
    turn = Rotation.from_rotvec(degrees * axis / np.linalg.norm(axis), degrees=True).as_matrix()
    middle = source.mean(axis=0)
    shift *= extent(source) / (2 * np.linalg.norm(shift))
    return transform_of(turn, middle - turn @ middle + shift)


def variants(path: Path) -> Iterator[tuple[str, Points, Points, Transform]]:
    """Each variant of a pair: its name, both clouds and the true target_from_source."""
    with np.load(path) as held:
        source, target = (
            held[side] * held[f"{side}_step"] + held[f"{side}_origin"]
            for side in ("source", "target")
        )
        native = held["native"]
    for variant in VARIANTS:
        if variant == "native" and np.isnan(native).any():
            continue
        moved_back = native if variant == "native" else drawn_motion(path.stem, variant, source)
        true = moved_back if variant == "native" else np.linalg.inv(moved_back)
        yield variant, move(np.linalg.inv(true), source), target, true


def measure(params: Params, source: Points, target: Points, true: Transform) -> dict:
    """One answer, how far off it is, and what it took."""
    start = time.process_time()
    answer = align(source, target, params)
    seconds = time.process_time() - start
    middle = source.mean(axis=0)
    shift = np.linalg.norm(move(answer.transform, middle) - move(true, middle)) / extent(target)
    degrees = angle_between(answer.transform, true)[0]
    return {
        "degrees": degrees,
        "shift": float(shift),
        "right": bool(degrees < 5 and shift < 0.05),
        "valid": answer.valid,
        "probability": answer.success_probability,
        "seconds": seconds,
    }


def show(rows: list[dict]) -> None:
    """A line for each variant, and how far what is called valid may be trusted."""
    print("| source | pairs | % right | median error of these, degrees | median CPU seconds |")
    print("|---|---|---|---|---|")
    for variant, words in VARIANTS.items():
        some = [row for row in rows if row["variant"] == variant]
        if some:
            error = np.median([row["degrees"] for row in some if row["right"]] or [np.nan])
            part = 100 * np.mean([row["right"] for row in some])
            seconds = np.median([row["seconds"] for row in some])
            print(f"| {words} | {len(some)} | {part:.0f} | {error:.3f} | {seconds:.2f} |")
    valid = [row["right"] for row in rows if row["valid"]]
    right = [row["valid"] for row in rows if row["right"]]
    print(f"\n{sum(valid)} of {len(valid)} valid answers are right,", end=" ")
    print(f"{sum(right)} of {len(right)} right ones valid")


def main() -> None:
    """Read the arguments, align every pair, write a line for each and print the table."""
    parser = argparse.ArgumentParser("real_pairs")
    parser.add_argument("folder", type=Path)
    parser.add_argument("--params", default="cad", help="a name in the package or an .npz file")
    parser.add_argument("--out", type=Path, default=Path("real_pairs.jsonl"))
    options = parser.parse_args()
    keep_compiled_programs()
    params = load_named(options.params)
    rows: list[dict] = []
    with options.out.open("w") as file:
        for path in sorted(options.folder.glob("*.npz")):
            for variant, source, target, true in variants(path):
                if not rows:
                    align(source, target, params)
                found = measure(params, source, target, true)
                row = {"name": path.stem, "variant": variant, **found}
                rows.append(row)
                print(json.dumps(row), file=file, flush=True)
    if not rows:
        parser.error(f"FOLDER must hold .npz files; {options.folder} has none")
    show(rows)


if __name__ == "__main__":
    main()
