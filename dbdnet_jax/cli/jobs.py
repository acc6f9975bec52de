"""Which pairs are asked for, and where what becomes of them goes."""

import argparse
from pathlib import Path
from typing import NamedTuple

from dbdnet_jax.cli.parquet import PARQUET, lines_file
from dbdnet_jax.io.outputs import TRANSFORM_ENDINGS, check_output, require_apart
from dbdnet_jax.io.pair_lists import FilePair, read_pairs


class Job(NamedTuple):
    """One pair and where its results go."""

    pair: FilePair
    transform: Path | None
    aligned: Path | None
    report: Path | None
    picture: Path | None

    @property
    def outputs(self) -> list[Path]:
        """The files that are asked for."""
        return [path for path in self[1:] if path is not None]


def read_jobs(options: argparse.Namespace) -> list[Job]:
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
    if options.results is not None:
        check_output(options.results, (".jsonl", PARQUET))
        written += {options.results, lines_file(options.results)}
    read = [path for job in jobs for path in (job.pair.source, job.pair.target)]
    read += filter(None, (options.initial, options.batch, Path(options.params)))
    require_apart(read, written)
    return jobs
