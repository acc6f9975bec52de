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
of fifty valid answers more than one is wrong that is not wrong unspoiled.
"""

import argparse
import sys
from collections.abc import Callable

from benchmarks.attacks.clouds import (
    MIRRORED,
    SPOILED,
    in_threads,
    judge_answers,
    of_many_points,
)
from benchmarks.attacks.files import through_checkpoints, through_pickles, through_programs
from dbdnet_jax.io.programs import keep_compiled_programs

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
