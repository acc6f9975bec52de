"""Attacks by what clouds are made of, how many there are at once, and how large they are."""

import time
import warnings
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

import numpy as np

from benchmarks.attacks.drawn import drawn_pairs
from benchmarks.machine import peak_gib
from dbdnet_jax import align
from dbdnet_jax.ops.transforms import angle_between
from dbdnet_jax.types import Points

RIGHT_DEG = 5.0
TOLERATED = 0.02  # part of the valid answers that may be wrong

Spoil = Callable[[Points, np.random.Generator], Points]


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
    """Print a row for each kind; whether hardly any more valid answers are wrong than unspoiled.

    The source is spoiled, and the target too where ``both``; of a mirrored one no pose is right.
    """
    wrong = valid = unspoiled = 0
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
        if name == "nothing":
            unspoiled = int((trusted & ~right).sum())
        wrong, valid = wrong + int((trusted & ~right).sum()), valid + int(trusted.sum())
        print(
            f"{name:34s} right {right.sum():3d} of {count}, valid {trusted.sum():3d}, "
            f"valid and wrong {(trusted & ~right).sum()}, of these without a warning "
            f"{(trusted & ~right & ~warned).sum()}",
            flush=True,
        )
    return wrong - unspoiled * len(kinds) <= TOLERATED * valid


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
