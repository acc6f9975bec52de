"""3DMatch and 3DLoMatch as Predator's release (Huang et al. 2021): pairs of indoor fragments.

The folder holds ``train|test/SCENE/cloud_bin_N.pth``, fragments of up to 60,000 points in metres,
and one info file for each split, a dict of ``src, tgt, rot, trans, overlap`` with
``tgt ~ rot @ src + trans``. Everything is read without torch, and no pickled code runs.

The info's ``overlap`` is Predator's: the share of the lower-numbered fragment closer than 0.03 m to
the other, measured on denser clouds than the stored ones. The labels here are another quantity.
"""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from dbdnet_jax.data.overlap import nearest_within, overlap_labels
from dbdnet_jax.io.torch_pickle import load_pickle, load_torch
from dbdnet_jax.ops.transforms import nearest_rotation
from dbdnet_jax.types import Cloud, Pair, Rigid

INFO_FILES = {  # the first name that is there; the second is the name in Predator's repository
    "train": ("train.pkl", "train_info.pkl"),
    "valid": ("valid.pkl", "val_info.pkl"),
    "3DMatch": ("3DMatch.pkl",),
    "3DLoMatch": ("3DLoMatch.pkl",),
}
KEYS = ("src", "tgt", "rot", "trans", "overlap")
POINTS = 2048
READ_AHEAD = 4  # batches
OVERLAP_RADIUS_M = 0.0375
# Nothing else is opened: a path from an info file cannot leave the folder.
FRAGMENT = re.compile(r"(?:train|test)/(\w[\w.-]*)/cloud_bin_([0-9]{1,6})\.pth")
# The info files' rotations are rounded: singular values up to 6e-4 from 1.
MAX_ROTATION_DEFECT = 0.01
WHERE = (
    "Both the fragments and the info files (configs/indoor) come with "
    "https://github.com/prs-eth/OverlapPredator: run its download script, put the info files "
    "beside train/ and test/, and give that folder."
)


@dataclasses.dataclass(frozen=True, eq=False)
class Info:
    """The ``p`` pairs of one split: ``target ~ rotation @ source + translation``, metres.

    ``source`` and ``target`` are the fragments' paths in the folder, ``overlap`` the value in the
    info file, ``scenes`` the scene of each pair. ``consecutive`` marks the pairs whose fragment
    numbers differ by one: 3DMatch's benchmark leaves them out.
    """

    source: tuple[str, ...]
    target: tuple[str, ...]
    rotation: Float[np.ndarray, "p 3 3"]
    translation: Float[np.ndarray, "p 3"]
    overlap: Float[np.ndarray, " p"]
    scenes: tuple[str, ...]
    consecutive: Bool[np.ndarray, " p"]

    def __len__(self) -> int:
        return len(self.source)


def load_info(folder: str | Path, split: str) -> Info:
    """The pairs of "train", "valid", "3DMatch" or "3DLoMatch", in the order of the file.

    Rotations are replaced by the nearest true rotation: the stored ones are off by up to 6e-4,
    which an arc cosine of the trace would report as two degrees.

    Raises:
        FileNotFoundError: the folder or the split's info file is not there.
        ValueError: unknown split, or a file that is no such table of pairs, refers to anything but
            ``train|test/SCENE/cloud_bin_N.pth``, or holds a matrix that is no rotation.
    """
    if split not in INFO_FILES:
        raise ValueError(f"split must be one of {tuple(INFO_FILES)}; got {split!r}. Choose one.")
    if not Path(folder).is_dir():
        raise FileNotFoundError(f"3DMatch must be a folder; there is none at {folder}. {WHERE}")
    found = [name for name in INFO_FILES[split] if (Path(folder) / name).is_file()]
    if not found:
        raise FileNotFoundError(
            f"the {split} split is listed in {' or '.join(INFO_FILES[split])}; {folder} has no "
            f"such file. {WHERE}"
        )
    path = Path(folder) / found[0]
    table = load_pickle(path)
    lengths = {}
    if isinstance(table, dict):
        lengths = {k: len(table[k]) for k in KEYS if isinstance(table.get(k), (list, np.ndarray))}
    if set(lengths) != set(KEYS) or len(set(lengths.values())) != 1:
        raise ValueError(
            f"{path} must hold a dict of lists {', '.join(KEYS)} of one length; got a "
            f"{type(table).__name__} with the lengths {lengths}. {WHERE}"
        )
    source, target = tuple(table["src"]), tuple(table["tgt"])
    rotation, translation, overlap = _numbers(path, table, len(source))
    scenes, source_numbers = zip(*(_scene_and_number(path, name) for name in source), strict=True)
    _, target_numbers = zip(*(_scene_and_number(path, name) for name in target), strict=True)
    return Info(
        source=source,
        target=target,
        rotation=rotation,
        translation=translation,
        overlap=overlap,
        scenes=scenes,
        consecutive=np.abs(np.subtract(source_numbers, target_numbers)) == 1,
    )


def _numbers(
    path: Path, table: dict, pairs: int
) -> tuple[Float[np.ndarray, "p 3 3"], Float[np.ndarray, "p 3"], Float[np.ndarray, " p"]]:
    """Rotations, translations and overlaps of an info file as float64, checked."""
    try:
        rotation, translation, overlap = (
            np.asarray(table[key], dtype=np.float64) for key in KEYS[2:]
        )
    except (TypeError, ValueError) as error:
        raise ValueError(
            f"rot, trans and overlap in {path} must be numbers of one shape each; {error}. {WHERE}"
        ) from error
    shapes = (rotation.shape, translation.shape, overlap.shape)
    if (
        not pairs
        or shapes[0] != (pairs, 3, 3)
        or shapes[1] not in ((pairs, 3), (pairs, 3, 1))
        or shapes[2] != (pairs,)
    ):
        raise ValueError(
            f"rot, trans and overlap in {path} must be (p, 3, 3), (p, 3) and (p,) with one row "
            f"for each of its {pairs} pairs; got {shapes}. {WHERE}"
        )
    translation = translation.reshape(pairs, 3)
    finite = np.isfinite(rotation).all((1, 2)) & np.isfinite(translation).all(1)
    known = np.where(np.isfinite(rotation), rotation, 0.0)
    nearest = nearest_rotation(known)
    rigid = np.linalg.norm(known - nearest, ord=2, axis=(1, 2)) < MAX_ROTATION_DEFECT
    if not (finite & rigid).all():
        row = np.argmin(finite & rigid)
        raise ValueError(
            f"every rot and trans in {path} must be a rigid motion; row {row} has rotation "
            f"{rotation[row].tolist()} and translation {translation[row].tolist()}. {WHERE}"
        )
    return nearest, translation, overlap


def _scene_and_number(path: Path, name: object) -> tuple[str, int]:
    match = FRAGMENT.fullmatch(name) if isinstance(name, str) else None
    if match is None:
        raise ValueError(
            f"fragments in {path} must be named train|test/SCENE/cloud_bin_N.pth; got {name!r}. "
            f"It is not opened. {WHERE}"
        )
    return match[1], int(match[2])


def load_fragment(folder: str | Path, name: str) -> Float[np.ndarray, "n 3"]:
    """All points of one fragment in metres, float64; ``name`` as in ``Info``.

    Raises:
        FileNotFoundError: no such file.
        ValueError: a file that would run code, is damaged, or holds no finite (n, 3) array.
    """
    path = Path(folder) / name
    if not path.is_file():
        raise FileNotFoundError(f"a fragment of the info file must stand at {path}. {WHERE}")
    points = load_torch(path)
    if not isinstance(points, np.ndarray) or points.dtype.kind != "f":
        raise ValueError(f"{path} must hold an array of floats; got {type(points)}. {WHERE}")
    if points.ndim != 2 or points.shape[1] != 3 or not len(points):
        raise ValueError(f"{path} must hold (n, 3) points, n >= 1; got {points.shape}. {WHERE}")
    if not np.isfinite(points).all():
        raise ValueError(f"the points in {path} must be finite; some are not. {WHERE}")
    return np.array(points, dtype=np.float64, order="C")  # a copy: what was read is the mapped file


def load_correspondences(
    folder: str | Path, info: Info, i: int, radius_m: float = OVERLAP_RADIUS_M
) -> tuple[Float[np.ndarray, "k 3"], Float[np.ndarray, "k 3"]]:
    """Ground-truth correspondences of pair ``i``: source points and their nearest target points.

    Those of all source points whose nearest target point under the true pose is closer than
    ``radius_m``; both in their own frame, in metres. ``k`` may be 0.
    """
    source = load_fragment(folder, info.source[i])
    target = load_fragment(folder, info.target[i])
    near, row = nearest_within(source @ info.rotation[i].T + info.translation[i], target, radius_m)
    return source[near], target[row[near]]


def load_pair(
    folder: str | Path,
    info: Info,
    i: int,
    *,
    points: int = POINTS,
    seed: int = 0,
    epoch: int = 0,
    radius_m: float = OVERLAP_RADIUS_M,
    cache: str | Path | None = None,
) -> Pair:
    """Pair ``i`` as NumPy arrays: ``points`` random points of each fragment, in metres, float32.

    The draw depends on (seed, epoch, i) only. A fragment of fewer points is kept whole, in random
    order, and padded with zeros. The overlap labels are those of the full fragments; ``cache`` is a
    folder where they are kept, created if need be, so that each pair is searched only once. The
    normals are zeros: the release has none.

    Raises:
        IndexError: ``i`` is no row of ``info``.
        FileNotFoundError, ValueError: as ``load_fragment``.
    """
    if not 0 <= i < len(info):
        raise IndexError(f"i must lie in 0..{len(info) - 1}; got {i}. Give a row of info.")
    source = load_fragment(folder, info.source[i])
    target = load_fragment(folder, info.target[i])
    moved = source @ info.rotation[i].T + info.translation[i]
    near_source, near_target = overlap_labels(moved, target, radius_m, cache)
    rng = np.random.default_rng((seed, epoch, i))
    no_normals: Any = np.zeros((points, 3), np.float32)
    source_cloud, source_overlap = _draw(source, near_source, points, rng)
    target_cloud, target_overlap = _draw(target, near_target, points, rng)
    return Pair(
        source=source_cloud,
        target=target_cloud,
        target_from_source=Rigid(
            info.rotation[i].astype(np.float32), info.translation[i].astype(np.float32)
        ),
        source_overlap=source_overlap,
        target_overlap=target_overlap,
        source_normals=no_normals,
        target_normals=no_normals,
    )


def _draw(
    points: Float[np.ndarray, "n 3"],
    overlap: Bool[np.ndarray, " n"],
    size: int,
    rng: np.random.Generator,
) -> tuple[Cloud, Any]:
    """``size`` random rows and their labels; Any, for the records are declared for JAX's arrays."""
    rows = rng.permutation(len(points))[:size]
    drawn: Any = np.zeros((size, 3), np.float32)
    labels: Any = np.zeros(size, bool)
    count: Any = np.asarray(len(rows), np.int32)
    drawn[: len(rows)], labels[: len(rows)] = points[rows], overlap[rows]
    return Cloud(drawn, count), labels


def batches(
    folder: str | Path,
    info: Info,
    *,
    batch_size: int,
    seed: int,
    start_step: int = 0,
    share: tuple[int, int] = (0, 1),
    points: int = POINTS,
    radius_m: float = OVERLAP_RADIUS_M,
    cache: str | Path | None = None,
) -> Iterator[Pair]:
    """Training batches without end, from step ``start_step``: every array with a batch axis first.

    Batch ``step`` depends on (seed, step) only, so a run resumed with ``start_step`` sees what the
    unbroken run would have seen. Every epoch is a new order and a new draw of points; a batch may
    span two epochs. A ``share`` of (i, n) reads and yields the i-th of n equal parts of each batch,
    which n must divide: what one of n processes needs. Two threads load up to `READ_AHEAD` batches
    ahead of the caller; an error in one of them is raised by ``next``.
    """
    import grain

    def load(index: int, i: int) -> Pair:
        return load_pair(
            folder,
            info,
            i,
            points=points,
            seed=seed,
            epoch=index // len(info),
            radius_m=radius_m,
            cache=cache,
        )

    order = grain.MapDataset.range(len(info)).shuffle(seed=seed).repeat()
    part, parts = share
    # The remainder is that of the endless order; kept, batches of 1 overflow Grain's length.
    of_steps = order.map_with_index(load).batch(batch_size // parts, drop_remainder=True)
    steps = of_steps[start_step * parts + part :: parts]
    return iter(
        steps.to_iter_dataset(grain.ReadOptions(num_threads=2, prefetch_buffer_size=READ_AHEAD))
    )
