"""What is done for one pair, in whatever process: files in, and out what to write and to say."""

import math
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from dbdnet_jax.cli.jobs import Job
from dbdnet_jax.io.terminal import for_command_line

if TYPE_CHECKING:
    import numpy as np

    from dbdnet_jax.alignment.align import Alignment


class Settings(NamedTuple):
    """What all pairs share: weights by name, options of `align`, the command, and its folder."""

    weights: str
    options: dict[str, Any]
    command: str
    folder: str


class Answer(NamedTuple):
    """An alignment as what is written and said of it."""

    valid: bool
    files: tuple[tuple[Path, bytes], ...]
    numbers: dict[str, Any]
    summary: list[str]


def prepare(weights: str) -> None:
    """What a process does once: find the programs that are kept, the device and the weights.

    Raises:
      ValueError, OSError: what is the matter with them.
    """
    from dbdnet_jax.io.programs import keep_compiled_programs, require_device
    from dbdnet_jax.networks.weights import load_once

    keep_compiled_programs()
    require_device()
    load_once(weights)


def align_files(settings: Settings, job: Job) -> Answer:
    """Align one pair and make what is asked for; nothing is written.

    Raises:
      Exception: as `align` and the readers of files.
    """
    from dbdnet_jax.alignment.align import align
    from dbdnet_jax.alignment.writing import as_json, ply_file, transform_file
    from dbdnet_jax.io.point_files import read_point_file
    from dbdnet_jax.networks.weights import load_once

    params = load_once(settings.weights)
    seed = settings.options["seed"]
    source = read_point_file(Path(settings.folder, job.pair.source), "source", seed=seed)
    target = read_point_file(Path(settings.folder, job.pair.target), "target", seed=seed + 1)
    alignment = align(source, target, params, **settings.options)
    files = _drawn(job, alignment, source.points, target.points, settings.command)
    if job.transform is not None:
        files[job.transform] = transform_file(job.transform, alignment)
    if job.aligned is not None:
        moved = source.points @ alignment.rotation.T + alignment.translation
        files[job.aligned] = ply_file(moved)
    summary = summarise(job.pair.source, job.pair.target, alignment)
    return Answer(alignment.valid, tuple(files.items()), as_json(alignment), summary)


def _drawn(
    job: Job, alignment: "Alignment", source: "np.ndarray", target: "np.ndarray", command: str
) -> dict[Path, bytes]:
    """The page and the picture that are asked for."""
    names = str(job.pair.source), str(job.pair.target)
    files = {}
    if job.report is not None:
        from dbdnet_jax.drawing.alignment_page import alignment_page

        page = alignment_page(alignment, source, target, names=names, command=command)
        files[job.report] = page
    if job.picture is not None:
        from dbdnet_jax.drawing.picture import alignment_picture

        files[job.picture] = alignment_picture(alignment, source, target, names=names)
    return files


def summarise(source: Path, target: Path, alignment: "Alignment") -> list[str]:
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
