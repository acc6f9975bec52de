"""The embedded data set: 820 CAD models of furniture and household objects.

The models come from the libraries of Sweet Home 3D; creators and licences stand in
``CAD_ATTRIBUTION.md`` beside this file, and ``tools/build_cad.py`` rebuilds the npz. Each model is
2048 points spaced as evenly as the ModelNet40 HDF5 clouds, in random order, so that any first k of
them are a fair draw. 11 validation or test models have a near-duplicate in the training part.
"""

from __future__ import annotations

import hashlib
import io
from functools import lru_cache
from pathlib import Path

import numpy as np

from dbdnet_jax.data.shapes import Shapes, select

CAD_FILE = Path(__file__).with_name("cad.npz")
CAD_SHA256 = "d89f0748c75074edcc04333eecd9d26801187433f408d74438d4e935bed1b53b"
SPLITS = ("train", "val", "test", "all")
HALVES = ("seen", "unseen")


@lru_cache(maxsize=1)
def load_cad(path: Path = CAD_FILE) -> Shapes:
    """All 820 models, sorted by ``library|path``: points and normals (820, 2048, 3) float32.

    The arrays are read once and shared between callers, hence read-only; ``cad_split`` copies.

    Raises:
        FileNotFoundError: the installation lacks the file.
        ValueError: the file is not the one this version was published with.
    """
    if not path.is_file():
        raise FileNotFoundError(
            f"the embedded CAD set must stand at {path}; there is no such file. Reinstall "
            "dbdnet_jax, or build it with tools/build_cad.py."
        )
    data = path.read_bytes()
    digest = hashlib.sha256(data).hexdigest()
    if digest != CAD_SHA256:
        raise ValueError(
            f"the embedded CAD set must have sha256 {CAD_SHA256}; {path} has {digest}, so it is "
            "damaged. Reinstall dbdnet_jax."
        )
    with np.load(io.BytesIO(data), allow_pickle=False) as arrays:
        stored = arrays["points"].transpose(0, 2, 1)  # (s, 3, n) in the file
        points = np.ascontiguousarray(stored, dtype=np.float32) / np.iinfo(np.int16).max
        normals = arrays["normals"].astype(np.float32)
        normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
        shapes = Shapes(
            points=points,
            normals=normals,
            names=arrays["name"],
            labels=arrays["label"],
            halves=arrays["half"],
            categories=arrays["category"],
            libraries=arrays["library"],
            paths=arrays["path"],
            creators=arrays["creator"],
            licences=arrays["licence"],
        )
    for array in vars(shapes).values():
        array.setflags(write=False)
    return shapes


def split_fraction(key: str) -> float:
    """The place of a model in [0, 1) that decides its split, from its ``library|path``.

    Raises:
        ValueError: ``key`` has no "|".
    """
    if "|" not in key:
        raise ValueError(
            f"a model's key must be 'library|path'; got {key!r}. Join Shapes.libraries[i] and "
            "Shapes.paths[i] with '|'."
        )
    return int(hashlib.sha256(key.encode()).hexdigest()[:12], 16) / 16**12


def split_of(key: str) -> str:
    """The split of the model ``library|path``: "train" below 0.8, "val" below 0.9, else "test".

    The rule needs no list, so it never moves a model when others come or go.
    """
    fraction = split_fraction(key)
    if fraction < 0.8:
        return "train"
    return "val" if fraction < 0.9 else "test"


def cad_split(split: str, half: str | None = None) -> Shapes:
    """One part of the set: "train" (642 models), "val" (97), "test" (81) or "all" (820).

    ``half`` keeps one half of the shape classes, "seen" or "unseen" (410 models each over all
    splits), to train on one and test on the other; None keeps both. The arrays are copies.

    Raises:
        ValueError: unknown split or half.
    """
    if split not in SPLITS:
        raise ValueError(f"split must be one of {SPLITS}; got {split!r}. Choose one of these.")
    if half is not None and half not in HALVES:
        raise ValueError(
            f"half must be one of {HALVES} or None; got {half!r}. Give None for all classes."
        )
    shapes = load_cad()
    keep = np.ones(len(shapes), dtype=bool)
    if split != "all":
        keys = zip(shapes.libraries, shapes.paths, strict=True)
        keep &= np.array([split_of(f"{library}|{path}") == split for library, path in keys])
    if half is not None:
        keep &= shapes.halves == half
    return select(shapes, keep)
