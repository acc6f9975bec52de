"""What may be asked of ``dbdnet-register``, and what its ``--help`` says."""

import argparse
import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NoReturn

from dbdnet_jax.io.terminal import printable

DESCRIPTION = "Find the motion that brings one point cloud onto another that it partly overlaps."
EXAMPLES = """\
examples:
  dbdnet-register scan_a.ply scan_b.ply
  dbdnet-register a.xyz b.xyz -o T.txt --save-aligned a_on_b.ply
  dbdnet-register part.stl scan.ply --json > answer.json
  dbdnet-register scan_a.ply scan_b.ply --report report.html --png report.png
  dbdnet-register --batch pairs.txt -o transforms/ --report pages/
  dbdnet-register --batch pairs.txt --results answers.jsonl --jobs 4

A file is a cloud (.ply .pcd .xyz .asc .pts .ptx .txt .csv .npy .npz .bin, and .las .laz .e57 with
the extra "formats") or a mesh (.ply .obj .off .stl .glb), of any size; both in the same unit.
The transform T is 4x4: B ~ T A.

A batch is a text file with two paths a line (from its own folder; # comments), or a folder whose
files are named NAME_source.* and NAME_target.*; transforms go to FOLDER/NAME.txt, reports to
FOLDER/NAME.html and pictures to FOLDER/NAME.png. Pairs are aligned in processes of their own, one
for each core (one in all where there is a GPU or TPU), and answered as they come. A pair that
fails, runs out of memory or kills its process does not stop the others; the latter is tried twice.
The answers in the file of --results are gone on from: with the same command again, pairs are left
out that it has an alignment of and whose outputs exist, and those that failed are tried again.

exit status: 0 aligned, 1 not aligned with confidence, 2 unusable input, 3 unexpected error, crash
or out of memory (DBDNET_DEBUG=1 shows where), 130 interrupted, 141 nobody reads the output any
more; of a batch: the largest of its pairs.
"""


class _Parser(argparse.ArgumentParser):
    def error(self, message: str) -> NoReturn:
        super().error(printable(message))  # it quotes arguments


def read_arguments(argv: Sequence[str]) -> argparse.Namespace:
    """The options of a command line; exits with status 2 where they make no sense together."""
    parser = make_parser()
    options = parser.parse_args(argv)
    if (options.batch is None) != (len(options.clouds) == 2) or len(options.clouds) not in (0, 2):
        parser.error("give two clouds, or --batch")
    if options.batch is not None and options.save_aligned is not None:
        parser.error("--save-aligned is for one pair, not for --batch")
    for name in ("jobs", "executor", "results"):
        if options.batch is None and getattr(options, name) is not None:
            parser.error(f"--{name} is for --batch")
    if options.jobs is not None and options.executor is not None:
        parser.error("--jobs is for processes of this machine, not for --executor")
    return options


def make_parser() -> argparse.ArgumentParser:
    """The parser; it has a message for all that is wrong with one option."""
    parser = _Parser(
        "dbdnet-register",
        description=DESCRIPTION,
        epilog=EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    add = parser.add_argument
    add("clouds", nargs="*", type=Path, metavar="CLOUD", help="source A and target B")
    add("-o", "--output", type=Path, metavar="T", help="transform: .txt .json .npy; batch: folder")
    add("--save-aligned", type=Path, metavar="PLY", help="write the moved source")
    add("--report", type=Path, metavar="HTML", help="write a page to look at; batch: folder")
    add("--png", type=Path, metavar="PNG", help="write a picture; batch: folder")
    add("--batch", type=Path, metavar="PAIRS", help="a list of pairs, or a folder")
    add("--jobs", type=_count, metavar="N", help="batch: processes; default one a core")
    add("--executor", type=_address, metavar="dask://HOST:PORT", help="batch: a Dask scheduler")
    add("--results", type=Path, metavar="FILE", help="batch: .jsonl or .parquet to go on from")
    add("--json", action="store_true", help="print JSON, a line for each pair, instead of text")
    add("--params", default="cad", metavar="W", help="weights: a .npz file, or a name (cad)")
    add("--search", choices=("auto", "near", "any"), default="auto", help="which rotations")
    add("--refine", action=argparse.BooleanOptionalAction, default=True, help="refine the pose")
    add("--initial", type=Path, metavar="T", help="a first guess of the transform")
    add("--scale", type=_scale, default="auto", help="factor to the weights' unit, or auto")
    add("--overlap-threshold", type=_share, metavar="P", help="default: the weights' own")
    add("--max-points", type=_points, default=768, metavar="N", help="for the network; default 768")
    add("--seed", type=_seed, default=0, help="of points drawn on a mesh; default 0")
    return parser


def _number(text: str, kind: type, rule: str, fits: Callable[[Any], bool]) -> Any:
    """An option's number, or what argparse says of one that is none or does not fit."""
    try:
        value = kind(text)
    except ValueError:
        value = None
    if value is None or not fits(value):
        raise argparse.ArgumentTypeError(f"must be {rule}; got {text!r}")
    return value


def _scale(text: str) -> float | str:
    rule = "auto, or a number from 1e-100 to 1e100"
    return text if text == "auto" else _number(text, float, rule, lambda x: 1e-100 <= x <= 1e100)


def _share(text: str) -> float:
    return _number(text, float, "a number from 0 to below 1", lambda x: 0 <= x < 1)


def _points(text: str) -> int:
    return _number(text, int, "a whole number from 64 to 65536", lambda x: 64 <= x <= 65536)


def _count(text: str) -> int:
    return _number(text, int, "a whole number from 1 to 4096", lambda x: 1 <= x <= 4096)


def _address(text: str) -> str:
    rule = "dask://HOST:PORT"
    return _number(text, str, rule, lambda x: re.fullmatch(r"dask://[^/\s]+:\d+", x) is not None)


def _seed(text: str) -> int:
    return _number(text, int, "a whole number from 0 to 4294967295", lambda x: 0 <= x < 2**32)
