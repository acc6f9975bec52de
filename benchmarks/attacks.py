"""Attacks on `align` and on the files it reads: is anything wrong without a word?

    python -m benchmarks.attacks --part=outliers --count=20
    python -m benchmarks.attacks --part=mirrored --count=20
    python -m benchmarks.attacks --part=threads --count=64
    python -m benchmarks.attacks --part=points --count=10000000
    python -m benchmarks.attacks --part=programs --count=20
    python -m benchmarks.attacks --part=pickles --count=571
    python -m benchmarks.attacks --part=checkpoints --count=70

``outliers`` spoils pairs of validation shapes that no turn brings onto themselves, ``mirrored``
those of generated solids that a mirror shows otherwise: a row tells how many answers are right (5
degrees), valid, and both valid and wrong. ``threads`` aligns one pair in so many threads at once,
``points`` one of so many points; ``programs`` damages kept programs between alignments in new
processes, ``pickles`` and ``checkpoints`` change, cut or lengthen files at random: each must be
read or refused in words, within a minute. Ends with status 1 where one of these is not so, or where
a valid answer is wrong in more than one of fifty.
"""

from __future__ import annotations

import argparse
import collections
import os
import pickle
import random
import subprocess
import sys
import tempfile
import time
import warnings
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

import dbdnet_jax
from benchmarks.machine import peak_gib
from dbdnet_jax import align
from dbdnet_jax.data.cad import cad_split
from dbdnet_jax.data.procedural.shapes import procedural_shapes
from dbdnet_jax.data.symmetry import symmetric_shapes
from dbdnet_jax.errors import CheckpointError
from dbdnet_jax.io.programs import keep_compiled_programs
from dbdnet_jax.io.torch_pickle import load_pickle
from dbdnet_jax.networks.weights import load_params
from dbdnet_jax.ops.transforms import angle_between, move, transform_of
from dbdnet_jax.training.checkpoint import Checkpoints
from dbdnet_jax.training.step import init_state
from dbdnet_jax.types import Points, Transform

RIGHT_DEG = 5.0
TURNED_DEG = 30.0
KEPT = 0.7  # part of each cloud beyond a plane of its own
LONGEST_S = 60.0  # to read or refuse one small file
TOLERATED = 0.02  # part of the valid answers that may be wrong

HANDED_SEED = 4001  # no seed of a training's
QUERIES, UNLIKE = 512, 2.0  # points that are reflected; their mean distance per spacing

Spoil = Callable[[Points, np.random.Generator], Points]


class Drawn(NamedTuple):
    """Two partial drawings of one shape and the transform between them."""

    source: Points
    target: Points
    target_from_source: Transform


def drawn_pairs(count: int, *, handed: bool = False) -> Iterator[tuple[Drawn, np.random.Generator]]:
    """Pairs of validation shapes in turn, and what draws the rest of each.

    Where ``handed``, of generated solids that a mirror shows otherwise.
    """
    if handed:
        shapes = procedural_shapes(4 * count, seed=HANDED_SEED).points.astype(np.float64)
        shapes = shapes[[is_handed(shape) for shape in shapes]]
    else:
        shapes = cad_split("val").points.astype(np.float64)
    shapes = shapes[~symmetric_shapes(shapes)]
    for number in range(count):
        rng = np.random.default_rng((2026, number))
        points = rng.permutation(shapes[number % len(shapes)])
        clouds = []
        for half in (points[:1024], points[1024:]):
            side = half @ rng.normal(size=3)
            clouds.append(half[np.argsort(side)[: round(KEPT * len(half))]])
        axis = rng.normal(size=3)
        motion = _motion(axis / np.linalg.norm(axis), rng.uniform(-1, 1, 3))
        yield Drawn(clouds[0], move(motion, clouds[1]), motion), rng


def is_handed(points: Points) -> bool:
    """Whether no reflection at a coordinate or principal plane brings a shape onto itself."""
    centred = points - points.mean(axis=0)
    tree, some = cKDTree(centred), centred[:QUERIES]
    spacing = tree.query(some, k=2)[0][:, 1].mean()
    axes = np.concatenate([np.eye(3), np.linalg.eigh(np.cov(centred.T))[1].T])
    reflected = [some - 2 * np.outer(some @ axis, axis) for axis in axes]
    return min(tree.query(each)[0].mean() for each in reflected) > UNLIKE * spacing


def _motion(axis: np.ndarray, translation: np.ndarray) -> Transform:
    turn = Rotation.from_rotvec(TURNED_DEG * axis, degrees=True)
    return transform_of(turn.as_matrix(), translation)


def scattered(part: float, sizes: float) -> Spoil:
    """Add so many points anywhere in a box of so many sizes of the cloud."""

    def spoil(points: Points, rng: np.random.Generator) -> Points:
        box = np.ptp(points, axis=0).max() * sizes / 2
        count = round(part * len(points))
        return np.concatenate([points, points.mean(axis=0) + rng.uniform(-box, box, (count, 3))])

    return spoil


def heaped(part: float, away: float) -> Spoil:
    """Add so many points in one heap so many sizes away."""

    def spoil(points: Points, rng: np.random.Generator) -> Points:
        size = np.ptp(points, axis=0).max()
        direction = rng.normal(size=3)
        middle = points.mean(axis=0) + direction / np.linalg.norm(direction) * away * size
        heap = rng.normal(middle, 0.1 * size, (round(part * len(points)), 3))
        return np.concatenate([points, heap])

    return spoil


def marked(part: float, value: float) -> Spoil:
    """Set so many points to a value that stands for none."""

    def spoil(points: Points, rng: np.random.Generator) -> Points:
        points = points.copy()
        points[rng.permutation(len(points))[: round(part * len(points))]] = value
        return points

    return spoil


SPOILED = {
    "nothing": lambda points, rng: points,
    "2 % scattered, three sizes": scattered(0.02, 3),
    "5 % scattered, three sizes": scattered(0.05, 3),
    "10 % scattered, three sizes": scattered(0.10, 3),
    "10 % scattered, ten sizes": scattered(0.10, 10),
    "5 % in a heap, three sizes away": heaped(0.05, 3),
    "5 % in a heap, 50 sizes away": heaped(0.05, 50),
    "5 % at -9999": marked(0.05, -9999.0),
    "5 % at 1e10": marked(0.05, 1e10),
    "5 % at 3.4e38": marked(0.05, 3.4e38),
}
MIRRORED: dict[str, Spoil] = {"mirrored source": lambda points, rng: points * [1.0, 1.0, -1.0]}


def judge_answers(kinds: dict[str, Spoil], count: int, *, both: bool = True) -> bool:
    """Print a row for each kind; whether hardly any valid answer is wrong.

    The source is spoiled, and the target too where ``both``; of a mirrored one no pose is right.
    """
    wrong = valid = 0
    for name, spoil in kinds.items():
        rows = []
        for pair, rng in drawn_pairs(count, handed=not both):
            target = spoil(pair.target, rng) if both else pair.target
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                found = align(spoil(pair.source, rng), target)
            error = angle_between(found.transform, pair.target_from_source)[0]
            rows.append((both and error < RIGHT_DEG, found.valid, bool(found.warnings)))
        right, trusted, warned = np.array(rows).T
        wrong, valid = wrong + int((trusted & ~right).sum()), valid + int(trusted.sum())
        print(
            f"{name:34s} right {right.sum():3d} of {count}, valid {trusted.sum():3d}, "
            f"valid and wrong {(trusted & ~right).sum()}, of these without a warning "
            f"{(trusted & ~right & ~warned).sum()}",
            flush=True,
        )
    return wrong <= TOLERATED * valid


def in_threads(count: int) -> bool:
    """Whether so many threads that align one pair at once all get the same bits."""
    pair, _ = next(drawn_pairs(1))
    expected = align(pair.source, pair.target).transform
    with ThreadPoolExecutor(count) as executor:
        found = list(executor.map(lambda _: align(pair.source, pair.target), range(count)))
    same = sum(np.array_equal(each.transform, expected) for each in found)
    print(f"{same} of {count} threads got the answer of one")
    return same == count


def of_many_points(count: int) -> bool:
    """Whether a pair of so many points is right; seconds and memory."""
    pair, rng = next(drawn_pairs(1))
    clouds = [
        cloud[rng.integers(0, len(cloud), count)] + rng.normal(0, 0.002, (count, 3))
        for cloud in pair[:2]
    ]
    before, start = peak_gib(), time.perf_counter()
    found = align(*clouds)
    error = angle_between(found.transform, pair.target_from_source)[0]
    print(
        f"{count} points each: {error:.2f} degrees off, valid {found.valid}, "
        f"{time.perf_counter() - start:.1f} s, {before} GiB before, {peak_gib()} at most"
    )
    return error < RIGHT_DEG


def damaged(content: bytes, draw: random.Random) -> bytes:
    """The content with some bytes changed, cut or lengthened."""
    changed = bytearray(content)
    for _ in range(draw.choice([1, 1, 4, 64])):
        changed[draw.randrange(len(changed))] = draw.randrange(256)
    how = draw.randrange(4)
    if how == 1:
        del changed[draw.randrange(len(changed)) :]
    elif how == 2:
        changed += draw.randbytes(draw.randrange(1, 100))
    return bytes(changed)


ALIGN_ONCE = """
from benchmarks.attacks import drawn_pairs
from dbdnet_jax import align
from dbdnet_jax.io.programs import keep_compiled_programs
keep_compiled_programs()
pair, _ = next(drawn_pairs(1))
print(align(pair.source, pair.target).transform.tobytes().hex())
"""


def through_programs(count: int) -> bool:
    """Whether new processes give the answer whatever happened to the programs that are kept."""
    draw, answers = random.Random(7), []
    with tempfile.TemporaryDirectory() as folder:
        environment = {**os.environ, "JAX_COMPILATION_CACHE_DIR": folder}
        for _ in range(count + 1):
            command = [sys.executable, "-W", "ignore", "-c", ALIGN_ONCE]
            done = subprocess.run(command, env=environment, capture_output=True, text=True)
            answers.append(done.stderr[-300:] if done.returncode else done.stdout.strip())
            for path in draw.sample(sorted(Path(folder).glob("*-cache")), 1) + draw.sample(
                sorted(Path(folder).glob("*.stablehlo")), 1
            ):
                path.write_bytes(damaged(path.read_bytes(), draw))
    same = sum(answer == answers[0] for answer in answers[1:])
    print(f"{same} of {count} processes got the answer of the first")
    for answer in set(answers) - {answers[0]}:
        print(f"    {answer}")
    return same == count


def through_files(
    count: int, content: bytes, name: str, read: Callable[[Path], object], expected: object
) -> bool:
    """Whether a damaged file is read as it was, as other values, or refused in words, and soon."""
    draw, said = random.Random(11), collections.Counter[str]()
    slowest = 0.0
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / name
        for _ in range(count):
            path.write_bytes(damaged(content, draw))
            start = time.perf_counter()
            try:
                said["as it was" if read(path) == expected else "other values"] += 1
            except (CheckpointError, ValueError, OSError) as error:
                said["refused" if "must" in str(error) or "." in str(error) else repr(error)] += 1
            except Exception as error:
                said[f"wrong: {error!r:.80}"] += 1
            slowest = max(slowest, time.perf_counter() - start)
    listed = ", ".join(f"{number} {what}" for what, number in said.most_common())
    print(f"{name}: {listed}; {slowest:.1f} s at most, {peak_gib()} GiB")
    return slowest < LONGEST_S and not any(what.startswith("wrong") for what in said)


def through_pickles(count: int) -> bool:
    """Pickles of arrays, and the weights in the package."""
    values = {"points": np.arange(300.0).reshape(100, 3), "names": ["a", "b"], "more": (1, 2.5)}
    arrays = through_files(
        count,
        pickle.dumps(values),
        "scan.pkl",
        lambda path: str(load_pickle(path)),
        str(values),
    )
    weights = Path(dbdnet_jax.__file__).parent / "networks" / "pretrained" / "cad.npz"
    return arrays & through_files(
        count // 10, weights.read_bytes(), "weights.npz", lambda path: bool(load_params(path)), True
    )


def through_checkpoints(count: int) -> bool:
    """Whether a training goes on from one of two checkpoints whatever happened to the newer one."""
    draw, said = random.Random(13), collections.Counter[str]()
    optimizer = optax.adamw(1e-3)
    like = init_state({"kernel": jnp.zeros((64, 64)), "bias": jnp.zeros(7)}, optimizer)
    saved = [jax.tree.map(lambda leaf, n=n: leaf + n, like) for n in (1, 2)]
    for _ in range(count):
        with tempfile.TemporaryDirectory() as folder:
            with Checkpoints(Path(folder)) as checkpoints:
                for step, state in enumerate(saved, start=1):
                    checkpoints.save(step, state)
            newest = Path(folder) / "checkpoints" / "2"
            path = draw.choice(sorted(path for path in newest.rglob("*") if path.is_file()))
            if draw.randrange(4):
                path.write_bytes(damaged(path.read_bytes() or b"0", draw))
            else:
                path.unlink()
            with warnings.catch_warnings(), Checkpoints(Path(folder)) as checkpoints:
                warnings.simplefilter("ignore")
                resumed = checkpoints.resume(like)
            step = resumed.step if resumed else 0
            same = step and jax.tree.all(
                jax.tree.map(lambda a, b: bool((a == b).all()), resumed.state, saved[step - 1])
            )
            said[f"went on from {step}" if same else "wrong"] += 1
    print("checkpoints: " + ", ".join(f"{number} {what}" for what, number in said.items()))
    return "wrong" not in said


PARTS: dict[str, tuple[Callable[[int], bool], int]] = {
    "outliers": (lambda count: judge_answers(SPOILED, count), 20),
    "mirrored": (lambda count: judge_answers(MIRRORED, count, both=False), 20),
    "threads": (in_threads, 64),
    "points": (of_many_points, 10_000_000),
    "programs": (through_programs, 20),
    "pickles": (through_pickles, 571),
    "checkpoints": (through_checkpoints, 70),
}


def main() -> None:
    """Attack, print what came of it, and fail if it broke anything."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--part", choices=PARTS, required=True)
    parser.add_argument("--count", type=int)
    options = parser.parse_args()
    keep_compiled_programs()
    attack, usual = PARTS[options.part]
    sys.exit(0 if attack(options.count or usual) else 1)


if __name__ == "__main__":
    main()
