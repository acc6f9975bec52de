"""Which pairs of files a batch is: a folder by its names, or a list as people write it."""

import glob
import os
import re
import shlex
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

_LONGEST_STEM = 80  # of each cloud, in an output's name: names have at most 255 bytes


class FilePair(NamedTuple):
    """Two files, the name of what is written for them, and where they were asked for ("")."""

    name: str
    source: Path
    target: Path
    origin: str


def read_pairs(batch: Path) -> list[FilePair]:
    """The pairs of a folder (``NAME_source.*``, ``NAME_target.*``) or of a list.

    A list has two paths a line, from its own folder, and ``#`` comments. Paths with spaces stand in
    quotes, or are separated by a tab or a comma; quotes, backslashes and ``#`` that belong to names
    are taken so where such files exist. Byte order marks (UTF-8, UTF-16) are skipped.

    Raises:
      ValueError: a line that is not two paths, half a pair, or no pair at all.
      OSError: it cannot be read.
    """
    pairs = list(_of_folder(batch) if batch.is_dir() else _of_list(batch))
    if not pairs:
        raise ValueError(
            f"a batch must have at least one pair; {batch} has none. Write two paths a line."
        )
    return pairs


def _of_folder(batch: Path) -> Iterator[FilePair]:
    for source in sorted(batch.glob("*_source.*")):
        name = source.stem.removesuffix("_source")
        same = glob.escape(name)
        counts = [len(list(batch.glob(f"{same}_{kind}.*"))) for kind in ("source", "target")]
        if counts != [1, 1]:
            raise ValueError(
                f"{batch} must hold one {name}_source.* and one {name}_target.*; got "
                f"{counts[0]} and {counts[1]}. Rename or remove the others."
            )
        yield FilePair(name, source, next(batch.glob(f"{same}_target.*")), "")


def _of_list(batch: Path) -> Iterator[FilePair]:
    data = batch.read_bytes()
    utf16 = data[:2] in (b"\xff\xfe", b"\xfe\xff")
    # Names need not be text: what is no UTF-8 stays as it is.
    text = data.decode("utf-16", "replace") if utf16 else data.decode("utf-8", "surrogateescape")
    for number, line in enumerate(text.removeprefix("\ufeff").splitlines(), 1):
        line = line.strip()
        if not line or line.startswith("#"):
            continue
        origin = f"{batch}:{number}"
        source, target = (batch.parent / path for path in _two_paths(line, batch.parent, origin))
        stems = [path.stem[:_LONGEST_STEM] for path in (source, target)]
        yield FilePair(f"{number:04d}_{stems[0]}_{stems[1]}", source, target, origin)


def _two_paths(line: str, folder: Path, origin: str) -> list[str]:
    """The paths of a line: the first way to read it that gives two files which exist.

    Where none does, the documented way, by quotes and spaces: the error is then about its files.
    """
    try:
        by_quotes, wrong = shlex.split(line, comments=True), ""
    except ValueError as error:
        by_quotes, wrong = [], f": {error}"
    bare = re.sub(r"(^|\s)#.*", "", line)
    ways = [by_quotes, bare.split()]
    ways += [[part.strip(" \"'") for part in re.split(mark, bare)] for mark in (r"\t+", r"[,;]\s*")]
    ways += [[part.replace("\\", "/") for part in way] for way in ways[1:]]
    pairs = [way for way in ways if len(way) == 2 and all(way)]
    for way in pairs:
        if all(os.path.exists(folder / path) for path in way):
            return way
    if wrong or not pairs:
        raise ValueError(
            f"{origin} must hold two paths; got {len(by_quotes or bare.split())}{wrong}: "
            f"{line!r:.200}. Put a path with spaces into double quotes."
        )
    return pairs[0]
