"""``dbdnet-register``: `align` for the command line."""

import argparse
import functools
import io
import math
import os
import re
import shlex
import sys
import traceback
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, NoReturn

from dbdnet_jax.io.outputs import TRANSFORM_ENDINGS, check_output, require_apart
from dbdnet_jax.io.pair_lists import FilePair, read_pairs
from dbdnet_jax.io.terminal import for_command_line, printable, say

if TYPE_CHECKING:
    import numpy as np

    from dbdnet_jax.alignment.align import Alignment

ALIGNED, UNSURE, UNUSABLE, FAILED, INTERRUPTED, UNREAD = 0, 1, 2, 3, 130, 141
DEBUG = "DBDNET_DEBUG"  # an environment variable
REFUSED = ValueError, OSError, ImportError  # what is the matter with the input, in words

DESCRIPTION = "Find the motion that brings one point cloud onto another that it partly overlaps."
EXAMPLES = """\
examples:
  dbdnet-register scan_a.ply scan_b.ply
  dbdnet-register a.xyz b.xyz -o T.txt --save-aligned a_on_b.ply
  dbdnet-register part.stl scan.ply --json > answer.json
  dbdnet-register scan_a.ply scan_b.ply --report report.html --png report.png
  dbdnet-register --batch pairs.txt -o transforms/ --report pages/

A file is a cloud (.ply .pcd .xyz .asc .pts .ptx .txt .csv .npy .npz .bin, and .las .laz .e57 with
the extra "formats") or a mesh (.ply .obj .off .stl .glb), of any size; both in the same unit.
The transform T is 4x4: B ~ T A.

A batch is a text file with two paths a line (from its own folder; # comments), or a folder whose
files are named NAME_source.* and NAME_target.*; transforms go to FOLDER/NAME.txt, reports to
FOLDER/NAME.html and pictures to FOLDER/NAME.png. A pair that fails does not stop the others.

exit status: 0 aligned, 1 not aligned with confidence, 2 unusable input, 3 unexpected error or out
of memory (DBDNET_DEBUG=1 shows where), 130 interrupted, 141 nobody reads the output any more; of a
batch: the largest of its pairs.
"""


class Job(NamedTuple):
    """One pair and where its results go."""

    pair: FilePair
    transform: Path | None
    aligned: Path | None
    report: Path | None
    picture: Path | None


class _Parser(argparse.ArgumentParser):
    def error(self, message: str) -> NoReturn:
        super().error(printable(message))  # it quotes arguments


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line and return its exit status."""
    for stream in (sys.stdout, sys.stderr):  # a file's name need not be valid text
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")
    parser = _parser()
    argv = sys.argv[1:] if argv is None else argv
    options = parser.parse_args(argv)
    options.command = shlex.join(["dbdnet-register", *argv])
    if (options.batch is None) != (len(options.clouds) == 2) or len(options.clouds) not in (0, 2):
        parser.error("give two clouds, or --batch")
    if options.batch is not None and options.save_aligned is not None:
        parser.error("--save-aligned is for one pair, not for --batch")
    with warnings.catch_warnings():
        warnings.showwarning = lambda message, *_, **__: say(f"warning: {message}", to_stderr=True)
        try:
            return _guarded(lambda: _run_all(options), "")
        except BrokenPipeError:  # of standard output: `| head` has seen enough
            return UNREAD
        except KeyboardInterrupt:
            say("interrupted; no file was left half-written", to_stderr=True)
            return INTERRUPTED


def _run_all(options: argparse.Namespace) -> int:
    """Every pair that is asked for; the largest exit status."""
    jobs = _jobs(options)
    settings = _settings(options)
    runs = [functools.partial(_run, job, options, settings) for job in jobs]
    return max([_guarded(run, job.pair.origin) for run, job in zip(runs, jobs, strict=True)])


def _guarded(run: Callable[[], int], origin: str) -> int:
    """The status that ``run`` returns, or that of its error, which is said in one line."""
    try:
        return run()
    except BrokenPipeError:
        raise
    except Exception as error:  # a traceback tells most people nothing, and status 1 is taken
        if os.environ.get(DEBUG):
            traceback.print_exc()
        what, status = str(error), UNUSABLE
        if isinstance(error, MemoryError) or re.search("RESOURCE_EXHAUSTED|[Oo]ut of memory", what):
            what, status = (
                f"out of memory: {what.splitlines()[0] if what else 'no details'}",
                FAILED,
            )
            what += ". Give fewer points, or stop other programs."
        elif not isinstance(error, REFUSED):
            what = " ".join(what.split())[:1000]
            what = f"unexpected {type(error).__name__}: {what}. {DEBUG}=1 shows where it happened."
            status = FAILED
        origin = origin and f"{origin}: "
        say(f"error: {origin}{for_command_line(what)}", to_stderr=True)
        return status


def _parser() -> argparse.ArgumentParser:
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
    add("--json", action="store_true", help="print JSON, a line for each pair, instead of text")
    add("--params", default="cad", metavar="W", help="weights: a .npz file, or a name (cad)")
    add("--search", choices=("auto", "near", "any"), default="auto", help="which rotations")
    add("--refine", action=argparse.BooleanOptionalAction, default=True, help="refine the pose")
    add("--initial", type=Path, metavar="T", help="a first guess of the transform")
    add("--scale", type=_scale, default="auto", help="factor to the weights' unit, or auto")
    add("--overlap-threshold", type=_share, default=0.5, metavar="P", help="default 0.5")
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


def _seed(text: str) -> int:
    return _number(text, int, "a whole number from 0 to 4294967295", lambda x: 0 <= x < 2**32)


def _settings(options: argparse.Namespace) -> dict:
    """Arguments of `align` that all pairs share; imports what takes time to import."""
    from dbdnet_jax.io.programs import keep_compiled_programs, require_device
    from dbdnet_jax.io.transform_files import read_transform
    from dbdnet_jax.networks.weights import load_named

    keep_compiled_programs()
    require_device()
    return {
        "params": load_named(options.params),
        "refine": options.refine,
        "search": options.search,
        "initial": None if options.initial is None else read_transform(options.initial),
        "scale": options.scale,
        "overlap_threshold": options.overlap_threshold,
        "max_points": options.max_points,
        "seed": options.seed,
    }


def _jobs(options: argparse.Namespace) -> list[Job]:
    """The pairs that are asked for; their outputs are checked before any work is done."""
    if options.report or options.png:
        from dbdnet_jax.errors import require_drawing

        require_drawing()
    outputs = options.output, options.save_aligned, options.report, options.png
    if options.batch is None:
        source, target = options.clouds
        jobs = [Job(FilePair("", source, target, ""), *outputs)]
    else:
        jobs = [
            Job(
                pair,
                *(
                    folder and folder / f"{pair.name}{ending}"
                    for folder, ending in zip(outputs, (".txt", "", ".html", ".png"), strict=True)
                ),
            )
            for pair in read_pairs(options.batch)
        ]
    written = []
    for job in jobs:
        for path, endings in zip(
            job[1:], (TRANSFORM_ENDINGS, (".ply",), (".html",), (".png",)), strict=True
        ):
            if path is not None:
                check_output(path, endings)
                written.append(path)
    read = [path for job in jobs for path in (job.pair.source, job.pair.target)]
    read += filter(None, (options.initial, options.batch, Path(options.params)))
    require_apart(read, written)
    return jobs


def _run(job: Job, options: argparse.Namespace, settings: dict) -> int:
    """Align one pair, write and print what is asked for; returns its exit status."""
    import json

    from dbdnet_jax.alignment.align import align
    from dbdnet_jax.alignment.writing import as_json, write_ply, write_transform
    from dbdnet_jax.io.point_files import read_point_file

    files = {"source": str(job.pair.source), "target": str(job.pair.target)}
    say(f"{files['source']} -> {files['target']} ...", to_stderr=True)
    source = read_point_file(job.pair.source, "source", seed=options.seed)
    target = read_point_file(job.pair.target, "target", seed=options.seed + 1)
    alignment = align(source, target, **settings)
    if job.transform is not None:
        write_transform(job.transform, alignment)
    if job.aligned is not None:
        write_ply(job.aligned, source.points @ alignment.rotation.T + alignment.translation)
    _draw(job, alignment, source.points, target.points, options.command)
    if options.json:
        # Escaped as text is everywhere: JSON itself leaves one control character as it is.
        say(json.dumps(files | as_json(alignment)).replace("\x7f", "\\u007f"))
    else:
        say(*summary(job.pair.source, job.pair.target, alignment))
    return ALIGNED if alignment.valid else UNSURE


def _draw(
    job: Job, alignment: "Alignment", source: "np.ndarray", target: "np.ndarray", command: str
) -> None:
    """Write the page and the picture that are asked for."""
    from dbdnet_jax.io.files import write_atomic

    names = str(job.pair.source), str(job.pair.target)
    if job.report is not None:
        from dbdnet_jax.drawing.alignment_page import alignment_page

        page = alignment_page(alignment, source, target, names=names, command=command)
        write_atomic(job.report, page)
    if job.picture is not None:
        from dbdnet_jax.drawing.picture import alignment_picture

        write_atomic(job.picture, alignment_picture(alignment, source, target, names=names))


def summary(source: Path, target: Path, alignment: "Alignment") -> list[str]:
    """An alignment in a few lines."""
    from scipy.spatial.transform import Rotation

    from dbdnet_jax.alignment.success import SUCCESS_DEG, SUCCESS_PART

    turn = Rotation.from_matrix(alignment.rotation).magnitude()
    rows = [" ".join(f"{x:16.9g}" for x in row) for row in alignment.transform]
    laps = ", ".join(f"{name} {lap:.2f}" for name, lap in alignment.timings.items())
    return [
        f"{target} ~ T {source}, T =",
        *rows,
        f"rotation     {math.degrees(turn):.3f} degrees",
        f"inliers      {alignment.inlier_ratio:.1%} of the source within "
        f"{alignment.inlier_distance:.3g} of the target, RMSE {alignment.rmse:.3g}",
        f"probability  {alignment.success_probability:.3f} that the pose is right to "
        f"{SUCCESS_DEG:g} deg and {SUCCESS_PART:.0%}",
        *(["alternatives " + str(len(alignment.alternatives))] if alignment.alternatives else []),
        *(f"warning      {for_command_line(warning)}" for warning in alignment.warnings),
        f"time         {sum(alignment.timings.values()):.2f} s ({laps})",
        for_command_line(": ".join(filter(None, (alignment.verdict, alignment.reason)))),
    ]
