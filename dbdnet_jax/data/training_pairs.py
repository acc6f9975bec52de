"""Where training gets its pairs: drawn on the device from shapes, or read from disk as scans.

Either way the pairs are a pure function of (seed, step), so a resumed run sees what an unbroken
one would have seen.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, PRNGKeyArray

from dbdnet_jax.data.augment import make_augmented_pair, require_enough_points, stretched
from dbdnet_jax.data.cad import cad_split
from dbdnet_jax.data.config import DataConfig
from dbdnet_jax.data.mixture import Mixture, Stock, make_mixture_pair, stock_of
from dbdnet_jax.data.modelnet40 import load_modelnet40
from dbdnet_jax.data.pairs import Protocol, make_pair
from dbdnet_jax.data.procedural.shapes import procedural_shapes
from dbdnet_jax.data.shapes import Shapes, joined, select
from dbdnet_jax.io.files import cache_folder
from dbdnet_jax.types import Pair

VALIDATION_SEED = 71  # not the run's seed: errors of runs with other seeds compare
HELD_OUT = 20  # every 20th training shape of a set that has no validation split


class PairStream(NamedTuple):
    """Pairs without end for training, and a fixed set for validation.

    ``arrays(start)`` yields what step ``start`` and those after it draw from;
    ``draw(key, number, arrays)`` makes pair ``number`` of the run from it, under jit. Where they
    are ``batched``, that is an array with a row for each pair of the step, of which a process
    yields its own; ``draw`` is given the pair's row.
    """

    epoch_pairs: int
    arrays: Callable[[int], Iterator[Any]]
    draw: Callable[[PRNGKeyArray, Int[Array, ""], Any], Pair]
    validation: Pair  # stacked: every field with a leading axis
    batched: bool = False


def load_training_pairs(
    data: DataConfig, protocol: Protocol, *, seed: int, validation_pairs: int, batch_size: int
) -> PairStream:
    """The pairs that ``data`` names.

    ``batch_size`` is that of the stage: scans are read from disk in batches.

    Raises:
        FileNotFoundError: its folder, or a file in it, is not there; says where to get it.
        ValueError: no folder given, or a damaged file.
    """
    data.require_folder()
    if data.name == "threedmatch":
        return _scans(data.folder, protocol, seed, validation_pairs, batch_size)
    train, validation = load_training_shapes(data)
    return pairs_of_shapes(
        train,
        validation,
        protocol,
        seed=seed,
        validation_pairs=validation_pairs,
        stretch=data.stretch,
        augment=data.augment,
        mixture=data.mixture,
    )


def load_training_shapes(data: DataConfig) -> tuple[Shapes, Shapes]:
    """Training and validation shapes. No test shape is among them.

    ModelNet40 has no validation split of its own: every 20th training shape serves as one.
    """
    if data.name == "cad":
        half = None if data.categories == "all" else data.categories
        train = cad_split("train", half)
        if data.procedural:
            train = joined(train, procedural_shapes(data.procedural, seed=0))
        return train, cad_split("val", half)
    shapes = load_modelnet40(data.folder, "train", data.categories)
    held_out = np.arange(len(shapes)) % HELD_OUT == HELD_OUT - 1
    return select(shapes, ~held_out), select(shapes, held_out)


def pairs_of_shapes(
    train: Shapes,
    validation: Shapes,
    protocol: Protocol,
    *,
    seed: int,
    validation_pairs: int,
    stretch: float = 1.0,
    augment: float = 0.0,
    mixture: Mixture | None = None,
) -> PairStream:
    """Pairs drawn on the device; every epoch sees every shape once, in an order of its own.

    The parts of ``mixture`` have their shares of the training pairs (`make_mixture_pair`); the
    others are of shapes stretched by up to ``stretch`` (`stretched`), and a share of ``augment`` of
    them is drawn by `make_augmented_pair`.

    Raises:
        ValueError: no shape to train or to validate on, or shapes of too few points.
    """
    if not len(train) or not len(validation):
        raise ValueError(
            "training and validation need at least one shape each; got "
            f"{len(train)} and {len(validation)}. Choose other config.data.categories."
        )
    mixed = mixture.total if mixture is not None else 0.0
    if augment:
        require_enough_points(train.points.shape[1], protocol)
    held: Array | np.ndarray | Stock = stock_of(train.points) if mixed else train.points
    count = len(train)
    order_key = jax.random.key(seed)

    def draw(key: PRNGKeyArray, number: Int[Array, ""], arrays: Any) -> Pair:
        order = jax.random.permutation(jax.random.fold_in(order_key, number // count), count)
        row = order[number % count]
        if mixture is not None and mixed:
            mixed_key, key = jax.random.split(key)
            return jax.lax.cond(
                jax.random.uniform(mixed_key) < mixed,
                lambda: make_mixture_pair(key, row, arrays, mixture, protocol),
                lambda: _pair_of(key, arrays.points[row], protocol, stretch, augment),
            )
        return _pair_of(key, arrays[row], protocol, stretch, augment)

    return PairStream(
        epoch_pairs=count,
        arrays=lambda start: itertools.repeat(held),
        draw=draw,
        validation=_fixed_pairs(validation, protocol, validation_pairs),
    )


def _pair_of(
    key: PRNGKeyArray,
    shape: Float[Array, "s 3"],
    protocol: Protocol,
    stretch: float,
    augment: float,
) -> Pair:
    """A pair of a shape, perhaps stretched, perhaps drawn more widely than the protocol says."""
    if stretch > 1:
        stretch_key, key = jax.random.split(key)
        shape = stretched(stretch_key, shape, stretch)
    normals = jnp.zeros_like(shape)  # nothing trains on them
    if not augment:
        return make_pair(key, shape, normals, protocol)
    choice_key, key = jax.random.split(key)
    return jax.lax.cond(
        jax.random.uniform(choice_key) < augment,
        lambda: make_augmented_pair(key, shape, normals, protocol),
        lambda: make_pair(key, shape, normals, protocol),
    )


def _fixed_pairs(shapes: Shapes, protocol: Protocol, count: int) -> Pair:
    """``count`` stacked pairs, the same ones always; shapes in turn."""
    key = jax.random.key(VALIDATION_SEED)
    rows = np.arange(count) % len(shapes)

    @jax.jit
    def draw(numbers: Array, points: Array, normals: Array) -> Pair:
        return jax.lax.map(
            lambda args: make_pair(jax.random.fold_in(key, args[0]), args[1], args[2], protocol),
            (numbers, points, normals),
        )

    return draw(np.arange(count), shapes.points[rows], shapes.normals[rows])


def _scans(
    folder: str, protocol: Protocol, seed: int, validation_pairs: int, batch_size: int
) -> PairStream:
    """3DMatch's pairs, read ahead of the step that needs them; a process reads its own."""
    from dbdnet_jax.data.threedmatch import batches, load_info, load_pair

    train, validation = load_info(folder, "train"), load_info(folder, "valid")
    options: dict[str, Any] = {
        "points": protocol.points,
        "radius_m": protocol.overlap_radius,
        "cache": cache_folder("threedmatch"),
    }
    count = min(validation_pairs, len(validation))
    rows = [i * len(validation) // count for i in range(count)]
    fixed = [load_pair(folder, validation, i, seed=VALIDATION_SEED, **options) for i in rows]
    return PairStream(
        epoch_pairs=len(train),
        arrays=lambda start: batches(
            folder,
            train,
            batch_size=batch_size,
            seed=seed,
            start_step=start,
            share=(jax.process_index(), jax.process_count()),
            **options,
        ),
        draw=lambda key, number, pair: pair,
        validation=jax.tree.map(lambda *leaves: np.stack(leaves), *fixed),
        batched=True,
    )
