"""What the peers' released codes computed in float64, and the weights they did it with.

The weights are a rule, not a file: drawn from torch's names. Whole bundles are used where
../shared/peers is there, otherwise those in tests/fixtures/peers, which hold fewer numbers of every
kind. Large arrays are stored rounded to float32.
"""

import functools
import math
import zlib
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from dbdnet_jax.networks.params import Params, unflatten
from dbdnet_jax.networks.torch_state import Entry, arrays_from_state, batch_norm_entries
from dbdnet_jax.types import Cloud

SHARED = Path(__file__).parents[2] / "shared" / "peers"
FIXTURES = Path(__file__).parent / "fixtures" / "peers"
WEIGHTS = (SHARED if SHARED.exists() else FIXTURES) / "weights"

# Relative to an array's largest entry: a float64 port that sums in another order, and half of
# float32's eps for what is stored in float32.
EVALUATION = 1e-10
STORED = 1e-7
TRAINING = 1e-9
GRADIENT = 1e-9


@functools.cache
def bundle(name: str) -> dict[str, np.ndarray]:
    """The arrays of one peer."""
    file = f"{name}_golden.npz"
    path = SHARED / file
    return dict(np.load(path if path.exists() else FIXTURES / file))


def draw(seed: int, name: str, shape: tuple[int, ...]) -> np.ndarray:
    """The tensor of this name, by the bundles' rule."""
    rng = np.random.default_rng([seed, zlib.crc32(name.encode())])
    last = name.rsplit(".", 1)[-1]
    if last == "running_var":
        x = 0.5 + rng.random(shape)
    elif len(shape) > 1:
        x = rng.standard_normal(shape) * np.sqrt(2 / np.prod(shape[1:]))
    else:
        x = 0.1 * rng.standard_normal(shape) + (last in ("weight", "a_2"))
    return x.astype(np.float32)


def filled(name: str, entries: dict[str, Entry], config) -> Params:
    """The parameters that a bundle was computed with, in float64."""
    arrays = bundle(name)
    seed = int(arrays["fill/seed"])
    for key in arrays:
        if key.startswith("fill/check/"):
            tensor = key.removeprefix("fill/check/")
            drawn = draw(seed, tensor, arrays[key].shape)
            np.testing.assert_array_equal(drawn.ravel()[: arrays[key].size], arrays[key].ravel())
    state = {
        entry.name: arrays.get(f"override/{entry.name}", draw(seed, *entry))
        for entry in entries.values()
    }
    state = {k: x.astype(np.float64) for k, x in state.items()}
    return unflatten(arrays_from_state(state, entries, name), config)


def clouds(points: np.ndarray) -> Cloud:
    """Stacked clouds without padding, in float64."""
    count = jnp.full(points.shape[:-2], points.shape[-2])
    return Cloud(jnp.asarray(points, jnp.float64), count)


def assert_near(actual, expected, relative: float) -> None:
    """Within a part of the largest entry; float32 entries may be rounded beside it.

    Of a large array the fixture holds a corner, which then is what is compared.
    """
    expected = np.asarray(expected)
    actual = np.asarray(actual)
    if expected.dtype == np.float32:
        actual = actual[tuple(slice(size) for size in expected.shape)]
    assert actual.shape == expected.shape, f"shapes {actual.shape} and {expected.shape}"
    if expected.dtype == np.float32:
        relative = max(relative, STORED)
    expected = expected.astype(np.float64)
    assert np.max(np.abs(actual - expected), initial=0) <= relative * np.max(np.abs(expected))


def assert_gradients(gradient: dict, entries: dict[str, Entry], arrays, prefix, relative) -> None:
    """The norms of the gradients, one for each tensor, with a floor for those that are zero."""
    prefix = f"{prefix}/grad_norm/"
    expected = {k.removeprefix(prefix): float(x) for k, x in arrays.items() if k.startswith(prefix)}
    assert expected
    ours = {
        entries[name].name: float(np.linalg.norm(np.asarray(x)))
        for name, x in flat(gradient).items()
    }
    floor = relative * max(expected.values())
    unknown = expected.keys() - ours.keys()
    assert all(expected[name] == 0 for name in unknown), unknown
    for name in expected.keys() - unknown:
        assert abs(ours[name] - expected[name]) <= floor + relative * expected[name], name


def flat(networks) -> dict[str, jax.Array]:
    """Leaves by their names joined with /."""
    return {
        "/".join(str(key.key) for key in path): leaf
        for path, leaf in jax.tree_util.tree_leaves_with_path(networks)
    }


def assert_running(batch_stats, entries: dict[str, Entry], arrays, prefix, relative) -> None:
    """The running averages after one forward pass."""
    ours = {entries[name].name: x for name, x in flat(batch_stats).items()}
    prefix = f"{prefix}/after_one_forward/"
    names = [k for k in arrays if k.startswith(prefix)]
    assert names
    for name in names:
        assert_near(ours[name.removeprefix(prefix)], arrays[name], relative)


def chain_entries(
    ours: str,
    theirs: list[tuple[str, str]],
    fan_in: int,
    widths: tuple[int, ...],
    *,
    bias: bool = True,
    axes: int = 1,
) -> dict[str, Entry]:
    """Entries of a `Chain`; ``theirs`` are the names of each layer's map and norm."""
    found: dict[str, Entry] = {}
    for i, (names, width) in enumerate(zip(theirs, widths, strict=True)):
        layer = f"{ours}/layer_{i}"
        found |= batch_norm_entries(layer, *names, fan_in, width, bias=bias, axes=axes)
        fan_in = width
    return found


def assert_shapes(entries: dict[str, Entry], shapes: dict[str, tuple[int, ...]]) -> None:
    """The entries are of exactly these parameters."""
    assert len({entry.name for entry in entries.values()}) == len(entries)
    found = {}
    for name, entry in entries.items():
        found[name] = entry.shape
        if name.endswith("/kernel"):
            out, fan_in, *taps = entry.shape
            found[name] = (math.prod(taps) * fan_in, out)
    assert found == shapes
