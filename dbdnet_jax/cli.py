"""``dbdnet-register``: `align` for the command line."""

import argparse
import glob
import io
import math
import shlex
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    import numpy as np

    from dbdnet_jax.alignment.align import Alignment

ALIGNED, UNSURE, UNUSABLE, INTERRUPTED = 0, 1, 2, 130

DESCRIPTION = "Find the motion that brings one point cloud onto another that it partly overlaps."
EXAMPLES = """\
examples:
  dbdnet-register scan_a.ply scan_b.ply
  dbdnet-register a.xyz b.xyz -o T.txt --save-aligned a_on_b.ply
  dbdnet-register part.stl scan.ply --json > answer.json
  dbdnet-register scan_a.ply scan_b.ply --report report.html --png report.png
  dbdnet-register --batch pairs.txt -o transforms/ --report pages/

A file is a cloud (.ply .pcd .xyz .asc .pts .ptx .txt .csv .npy .npz .bin, and .las .laz .e57 with
the extra "formats") or a mesh (.ply .obj .off .stl .glb), of any size; both in
the same unit. The transform T is 4x4: B ~ T A.

A batch is a text file with two paths a line (from its own folder; # comments), or a folder whose
files are named NAME_source.* and NAME_target.*; transforms go to FOLDER/NAME.txt, reports to
FOLDER/NAME.html and pictures to FOLDER/NAME.png.

exit status: 0 aligned, 1 not aligned with confidence (of a batch: not all), 2 unusable input.
"""


class Job(NamedTuple):
    """One pair and where its results go."""

    source: Path
    target: Path
    transform: Path | None
    aligned: Path | None
    report: Path | None
    picture: Path | None


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
    try:
        jobs = _jobs(options)
        settings = _settings(options)
    except (ValueError, OSError, ImportError) as error:
        return _complain(error)
    except KeyboardInterrupt:
        return INTERRUPTED
    try:
        return max([_run(job, options, settings) for job in jobs])
    except KeyboardInterrupt:
        print("interrupted; no file was left half-written", file=sys.stderr)
        return INTERRUPTED


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
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
    add("--refine", action=argparse.BooleanOptionalAction, default=True, help="refine the pose")
    add("--initial", type=Path, metavar="T", help="a first guess of the transform")
    add("--scale", type=_scale, default="auto", help="factor to the weights' unit, or auto")
    add("--overlap-threshold", type=float, default=0.5, metavar="P", help="default 0.5")
    add("--max-points", type=int, default=768, metavar="N", help="for the network; default 768")
    add("--seed", type=int, default=0, help="of points drawn on a mesh; default 0")
    return parser


def _scale(text: str) -> float | str:
    return text if text == "auto" else float(text)


def _settings(options: argparse.Namespace) -> dict:
    """Arguments of `align` that all pairs share; imports what takes time to import."""
    from dbdnet_jax.io.point_files import read_transform
    from dbdnet_jax.io.programs import keep_compiled_programs
    from dbdnet_jax.networks.weights import load_named

    keep_compiled_programs()
    return {
        "params": load_named(options.params),
        "refine": options.refine,
        "initial": None if options.initial is None else read_transform(options.initial),
        "scale": options.scale,
        "overlap_threshold": options.overlap_threshold,
        "max_points": options.max_points,
        "seed": options.seed,
    }


def _jobs(options: argparse.Namespace) -> list[Job]:
    """The pairs that are asked for; their outputs are checked before any work is done."""
    from dbdnet_jax.alignment.writing import TRANSFORM_ENDINGS, check_output

    if options.report or options.png:
        from dbdnet_jax.errors import require_drawing

        require_drawing()
    outputs = options.output, options.save_aligned, options.report, options.png
    if options.batch is None:
        source, target = options.clouds
        jobs = [Job(source, target, *outputs)]
    else:
        jobs = [
            Job(
                source,
                target,
                *(
                    folder and folder / f"{name}{ending}"
                    for folder, ending in zip(outputs, (".txt", "", ".html", ".png"), strict=True)
                ),
            )
            for name, source, target in _pairs(options.batch)
        ]
        if not jobs:
            raise ValueError(f"a batch must have at least one pair; {options.batch} has none.")
    for job in jobs:
        for path, endings in zip(
            job[2:], (TRANSFORM_ENDINGS, (".ply",), (".html",), (".png",)), strict=True
        ):
            if path is not None:
                check_output(path, endings)
    return jobs


def _pairs(batch: Path) -> Iterator[tuple[str, Path, Path]]:
    """Name, source and target of every pair of a folder or of a list."""
    if batch.is_dir():
        for source in sorted(batch.glob("*_source.*")):
            name = source.stem.removesuffix("_source")
            same = glob.escape(name)
            counts = [len(list(batch.glob(f"{same}_{kind}.*"))) for kind in ("source", "target")]
            if counts != [1, 1]:
                raise ValueError(
                    f"{batch} must hold one {name}_source.* and one {name}_target.*; got "
                    f"{counts[0]} and {counts[1]}. Rename or remove the others."
                )
            yield name, source, next(batch.glob(f"{same}_target.*"))
        return
    lines = batch.read_text(errors="surrogateescape").splitlines()
    for number, line in enumerate(lines, 1):
        paths = shlex.split(line, comments=True)
        if not paths:
            continue
        if len(paths) != 2:
            raise ValueError(f"{batch}:{number} must hold two paths; got {len(paths)}: {line!r}.")
        source, target = (batch.parent / path for path in paths)
        yield f"{number:04d}_{source.stem}_{target.stem}", source, target


def _run(job: Job, options: argparse.Namespace, settings: dict) -> int:
    """Align one pair, write and print what is asked for; returns its exit status."""
    import json

    from dbdnet_jax.alignment.align import align
    from dbdnet_jax.alignment.writing import as_json, write_ply, write_transform
    from dbdnet_jax.io.point_files import read_point_file

    print(f"{job.source} -> {job.target} ...", file=sys.stderr)
    try:
        source = read_point_file(job.source, "source", seed=options.seed)
        target = read_point_file(job.target, "target", seed=options.seed + 1)
        alignment = align(source, target, **settings)
        if job.transform is not None:
            write_transform(job.transform, alignment)
        if job.aligned is not None:
            write_ply(job.aligned, source.points @ alignment.rotation.T + alignment.translation)
        _draw(job, alignment, source.points, target.points, options.command)
    except (ValueError, OSError, ImportError, MemoryError) as error:
        return _complain(error)
    if options.json:
        files = {"source": str(job.source), "target": str(job.target)}
        print(json.dumps(files | as_json(alignment)))
    else:
        print(summary(job.source, job.target, alignment))
    return ALIGNED if alignment.valid else UNSURE


def _draw(
    job: Job, alignment: "Alignment", source: "np.ndarray", target: "np.ndarray", command: str
) -> None:
    """Write the page and the picture that are asked for."""
    from dbdnet_jax.io.files import write_atomic

    names = str(job.source), str(job.target)
    if job.report is not None:
        from dbdnet_jax.drawing.alignment_page import alignment_page

        page = alignment_page(alignment, source, target, names=names, command=command)
        write_atomic(job.report, page)
    if job.picture is not None:
        from dbdnet_jax.drawing.picture import alignment_picture

        write_atomic(job.picture, alignment_picture(alignment, source, target, names=names))


def summary(source: Path, target: Path, alignment: "Alignment") -> str:
    """An alignment in a few lines."""
    from scipy.spatial.transform import Rotation

    from dbdnet_jax.alignment.success import SUCCESS_DEG

    turn = Rotation.from_matrix(alignment.rotation).magnitude()
    rows = [" ".join(f"{x:16.9g}" for x in row) for row in alignment.transform]
    laps = ", ".join(f"{name} {lap:.2f}" for name, lap in alignment.timings.items())
    return "\n".join(
        [
            f"{target} ~ T {source}, T =",
            *rows,
            f"rotation     {math.degrees(turn):.3f} degrees",
            f"inliers      {alignment.inlier_ratio:.1%} of the source within "
            f"{alignment.inlier_distance:.3g} of the target, RMSE {alignment.rmse:.3g}",
            f"probability  {alignment.success_probability:.3f} that the rotation is right to "
            f"{SUCCESS_DEG:g} deg",
            *(f"warning      {warning}" for warning in alignment.warnings),
            f"time         {sum(alignment.timings.values()):.2f} s ({laps})",
            ": ".join(filter(None, (alignment.verdict, alignment.reason))),
        ]
    )


def _complain(error: Exception) -> int:
    print(f"error: {error}", file=sys.stderr)
    return UNUSABLE
