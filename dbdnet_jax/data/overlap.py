"""Overlap labels of clouds too large for a distance matrix, kept on disk."""

from __future__ import annotations

import hashlib
import io
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Int

from dbdnet_jax.io.files import warn_without_cache, write_atomic


def nearest_within(
    query: Float[np.ndarray, "n 3"], points: Float[np.ndarray, "m 3"], radius: float
) -> tuple[Bool[np.ndarray, " n"], Int[np.ndarray, " n"]]:
    """Which queries have a point closer than ``radius``, and the row of the nearest (else m).

    By a k-d tree: memory and time grow as (n + m) log m, never as n m.
    """
    from scipy.spatial import cKDTree

    distance, row = cKDTree(points).query(query, distance_upper_bound=radius)
    return np.isfinite(distance), row


def overlap_labels(
    source: Float[np.ndarray, "n 3"],
    target: Float[np.ndarray, "m 3"],
    radius: float,
    cache: str | Path | None = None,
) -> tuple[Bool[np.ndarray, " n"], Bool[np.ndarray, " m"]]:
    """Which points of two aligned clouds have a point of the other closer than ``radius``.

    ``cache`` is a folder, created if need be, where the answer is kept. The file there is named by
    a hash of the input, so it may be missing or damaged (then it is written again), never stale. A
    folder that cannot be written costs a warning.
    """
    if cache is None:
        return nearest_within(source, target, radius)[0], nearest_within(target, source, radius)[0]
    digest = hashlib.sha256(f"{len(source)} {len(target)} {float(radius)!r}".encode())
    digest.update(source.tobytes())
    digest.update(target.tobytes())
    file = Path(cache) / f"overlap_{digest.hexdigest()[:32]}.npz"
    try:
        with np.load(io.BytesIO(file.read_bytes()), allow_pickle=False) as stored:
            return (
                np.unpackbits(stored["source"], count=len(source)).astype(bool),
                np.unpackbits(stored["target"], count=len(target)).astype(bool),
            )
    except Exception:  # not there yet, or damaged: zipfile answers with a dozen types of error
        near_source, near_target = overlap_labels(source, target, radius)
    labels = io.BytesIO()
    np.savez_compressed(labels, source=np.packbits(near_source), target=np.packbits(near_target))
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
        write_atomic(file, labels.getbuffer())
    except OSError as error:
        warn_without_cache(str(error))
    return near_source, near_target
