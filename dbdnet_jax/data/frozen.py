"""Test sets that are drawn once and then stay: files of draws, named by their hash."""

import hashlib
import io
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from dbdnet_jax.data.cad import cad_split
from dbdnet_jax.data.pairs import PairDraw, Protocol, assemble, draw_pair
from dbdnet_jax.data.shapes import Shapes
from dbdnet_jax.io.files import write_atomic
from dbdnet_jax.types import Pair, Rigid

NOISE_UNIT = 2.0**-15  # of the stored integers: 3e-5 of a radius, far below any noise of interest

CAD_FOLDER = Path(__file__).with_name("frozen")
CAD_VARIANTS: dict[str, tuple[Protocol, str | None]] = {  # protocol, half of the shape classes
    "noise": (Protocol(), None),
    "clean": (Protocol(noise_sigma=0.0), None),
    "disjoint": (Protocol(disjoint=True), None),
    "unseen": (Protocol(), "unseen"),
}


def save_test_set(
    path: str | Path, shapes: Shapes, protocol: Protocol, *, seed: int, count: int
) -> str:
    """Draw ``count`` pairs, shapes in turn, and write them to ``path``; returns the hash.

    Raises:
        ValueError: noise that the file's integers cannot hold.
    """
    if protocol.noise_clip >= 2**15 * NOISE_UNIT and protocol.noise_sigma > 0:
        raise ValueError(
            f"a frozen set holds noise below {2**15 * NOISE_UNIT}; got noise_clip="
            f"{protocol.noise_clip}. Lower it."
        )
    shape = np.arange(count) % len(shapes)
    keys = jax.random.split(jax.random.key(seed), count)
    draw_one = jax.jit(lambda args: draw_pair(args[0], args[1], protocol))
    drawn = [
        draw_one((key, jnp.asarray(shapes.points[s]))) for key, s in zip(keys, shape, strict=True)
    ]
    draws = jax.tree.map(lambda *leaves: np.stack(leaves), *drawn)
    buffer = io.BytesIO()
    np.savez_compressed(
        buffer,
        shape=shape.astype(np.int32),
        source_rows=draws.source_rows.astype(np.int32),
        target_rows=draws.target_rows.astype(np.int32),
        rotation=draws.source_from_target.rotation,
        translation=draws.source_from_target.translation,
        source_noise=np.rint(draws.source_noise / NOISE_UNIT).astype(np.int16),
        target_noise=np.rint(draws.target_noise / NOISE_UNIT).astype(np.int16),
        overlap_radius=np.float64(protocol.overlap_radius),
        points_sha256=np.str_(points_hash(shapes)),
    )
    write_atomic(Path(path), buffer.getvalue())
    return hashlib.sha256(buffer.getvalue()).hexdigest()


def load_test_set(path: str | Path, shapes: Shapes) -> tuple[Pair, str]:
    """The pairs of a frozen set, as NumPy arrays with a leading axis, and the file's hash.

    Raises:
        FileNotFoundError: no such file.
        ValueError: a damaged file, or one that was frozen on other shapes.
    """
    path = Path(path)
    data = path.read_bytes()
    try:
        with np.load(io.BytesIO(data), allow_pickle=False) as stored:
            held = {name: stored[name] for name in stored.files}
        expected = str(held["points_sha256"])
        draws = PairDraw(
            held["source_rows"],
            held["target_rows"],
            Rigid(held["rotation"], held["translation"]),
            held["source_noise"].astype(np.float32) * np.float32(NOISE_UNIT),
            held["target_noise"].astype(np.float32) * np.float32(NOISE_UNIT),
        )
        rows, radius = held["shape"], float(held["overlap_radius"])
    except Exception as error:  # zipfile, zlib and NumPy raise many kinds
        raise ValueError(
            f"a frozen test set must be readable; {path} is not ({error}). Delete it and draw "
            "it again, or reinstall dbdnet_jax if it is part of the package."
        ) from error
    if points_hash(shapes) != expected:
        raise ValueError(
            f"{path} was frozen on shapes with hash {expected[:12]}; these have "
            f"{points_hash(shapes)[:12]}. Give the same data set and split, or draw it anew."
        )

    @jax.jit
    def pair(draw: PairDraw, points: jax.Array, normals: jax.Array) -> Pair:
        return assemble(draw, points, normals, radius)

    pairs = [
        jax.device_get(
            pair(jax.tree.map(lambda leaf: leaf[i], draws), shapes.points[s], shapes.normals[s])  # noqa: B023
        )
        for i, s in enumerate(rows)
    ]
    return jax.tree.map(lambda *leaves: np.stack(leaves), *pairs), hashlib.sha256(data).hexdigest()


def points_hash(shapes: Shapes) -> str:
    """What tells one set of shapes from another: the sha256 of their points."""
    return hashlib.sha256(np.ascontiguousarray(shapes.points).tobytes()).hexdigest()


def cad_test_pairs(variant: str) -> tuple[Pair, str]:
    """200 frozen pairs of the embedded CAD test split, and their hash.

    "noise" is the paper's protocol, "clean" has none, in "disjoint" no point of a shape stands in
    both clouds, and "unseen" (with noise) keeps the half of the shape classes to test on when a
    network was trained on the other half.

    Raises:
        ValueError: unknown variant.
    """
    if variant not in CAD_VARIANTS:
        raise ValueError(
            f"variant must be one of {tuple(CAD_VARIANTS)}; got {variant!r}. Choose one of these."
        )
    _, half = CAD_VARIANTS[variant]
    return load_test_set(CAD_FOLDER / f"cad_test_{variant}.npz", cad_split("test", half))
