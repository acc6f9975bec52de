"""ModelNet40 from its official HDF5 folder: 12,311 shapes of 2048 points in 40 categories.

The folder is the unpacked ``modelnet40_ply_hdf5_2048.zip`` (Qi et al. 2017): five train and two
test files with the arrays ``data``, ``normal`` and ``label``, centred and scaled to the unit sphere
there already. The models may be used for academic research only, so nothing of them is shipped.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from dbdnet_jax.data.shapes import Shapes

FILES = {
    "train": tuple(f"ply_data_train{number}.h5" for number in range(5)),
    "test": tuple(f"ply_data_test{number}.h5" for number in range(2)),
}
KEYS = ("data", "normal", "label")
POINTS = 2048
SEEN = 20  # the first 20 categories; the other 20 are "unseen"
CATEGORIES = (
    *("airplane", "bathtub", "bed", "bench", "bookshelf", "bottle", "bowl", "car", "chair"),
    *("cone", "cup", "curtain", "desk", "door", "dresser", "flower_pot", "glass_box", "guitar"),
    *("keyboard", "lamp", "laptop", "mantel", "monitor", "night_stand", "person", "piano", "plant"),
    *("radio", "range_hood", "sink", "sofa", "stairs", "stool", "table", "tent", "toilet"),
    *("tv_stand", "vase", "wardrobe", "xbox"),
)
WHERE = (
    "Unpack https://shapenet.cs.stanford.edu/media/modelnet40_ply_hdf5_2048.zip and give its "
    "folder modelnet40_ply_hdf5_2048."
)


def load_modelnet40(folder: str | Path, split: str, categories: str = "all") -> Shapes:
    """The "train" (9840) or "test" (2468) shapes, points and normals (s, 2048, 3) float32.

    ``categories`` keeps the "seen" half (the first 20 in alphabetical order), the "unseen" half
    (the last 20) or "all". Shapes and points stay in the order of the files.

    Raises:
        FileNotFoundError: the folder or one of the split's files is not there.
        ValueError: unknown split or categories; a file that is truncated, lacks an array, or holds
            one of another shape, a label outside 0..39, or a value that is not finite.
    """
    if split not in FILES:
        raise ValueError(f"split must be one of {tuple(FILES)}; got {split!r}. Choose one of them.")
    if categories not in ("seen", "unseen", "all"):
        raise ValueError(
            f"categories must be 'seen', 'unseen' or 'all'; got {categories!r}. Choose one of them."
        )
    folder = Path(folder)
    if not folder.is_dir():
        raise FileNotFoundError(f"ModelNet40 must be a folder; there is none at {folder}. {WHERE}")
    missing = [name for name in FILES[split] if not (folder / name).is_file()]
    if missing:
        raise FileNotFoundError(
            f"the {split} split is the files {', '.join(FILES[split])}; {folder} lacks "
            f"{', '.join(missing)}. {WHERE}"
        )
    points, normals, labels, names = [], [], [], []
    for name in FILES[split]:
        file_points, file_normals, file_labels = _read(folder / name)
        halves = np.where(file_labels < SEEN, "seen", "unseen")
        rows = np.flatnonzero((halves == categories) | (categories == "all"))
        points.append(file_points[rows])
        normals.append(file_normals[rows])
        labels.append(file_labels[rows])
        names += [f"{name}#{row}" for row in rows]
    label = np.concatenate(labels)
    nothing = np.full(len(label), "")
    return Shapes(
        points=np.concatenate(points),
        normals=np.concatenate(normals),
        names=np.array(names, dtype=str),
        labels=np.array(CATEGORIES)[label],
        halves=np.where(label < SEEN, "seen", "unseen"),
        categories=nothing,
        libraries=np.full(len(label), "ModelNet40"),
        paths=np.array(names, dtype=str),
        creators=nothing,
        licences=nothing,
    )


def _read(
    path: Path,
) -> tuple[Float[np.ndarray, "s n 3"], Float[np.ndarray, "s n 3"], Int[np.ndarray, " s"]]:
    """Points, normals and labels of one file, checked."""
    import h5py

    try:
        with h5py.File(path, "r") as file:
            lacking = [key for key in KEYS if not isinstance(file.get(key), h5py.Dataset)]
            if lacking:
                raise ValueError(
                    f"{path} must hold the arrays {', '.join(KEYS)}; it lacks "
                    f"{', '.join(lacking)} and holds {', '.join(file) or 'nothing'}. {WHERE}"
                )
            _check_shapes(path, *(file[key].shape for key in KEYS))
            points, normals = (file[key].astype(np.float32)[()] for key in KEYS[:2])
            labels = file["label"].astype(np.int64)[()].reshape(-1)
    except (OSError, RuntimeError, TypeError) as error:
        raise ValueError(
            f"{path} must be a whole HDF5 file of numbers; it cannot be read ({error}). {WHERE}"
        ) from error
    for key, values in (("data", points), ("normal", normals)):
        damaged = np.flatnonzero(~np.isfinite(values).all((1, 2)))
        if damaged.size:
            raise ValueError(
                f"'{key}' in {path} must be finite; {damaged.size} shapes are not, the first in "
                f"row {damaged[0]}. The file is damaged. {WHERE}"
            )
    if labels.size and not (0 <= labels.min() and labels.max() < len(CATEGORIES)):
        raise ValueError(
            f"'label' in {path} must lie in 0..{len(CATEGORIES) - 1}; got {labels.min()} to "
            f"{labels.max()}. {WHERE}"
        )
    return points, normals, labels


def _check_shapes(
    path: Path, data: tuple[int, ...], normal: tuple[int, ...], label: tuple[int, ...]
) -> None:
    shapes = data[0] if data else 0
    expected = (shapes, POINTS, 3)
    if data != expected or normal != expected or label not in ((shapes,), (shapes, 1)):
        raise ValueError(
            f"'data' and 'normal' in {path} must be (s, {POINTS}, 3) and 'label' (s, 1); got {data}"
            f", {normal} and {label}. {WHERE}"
        )
