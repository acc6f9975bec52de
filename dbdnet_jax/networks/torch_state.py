"""The peers' public weights: tensors by torch's names, read without torch, to ours.

Torch's kernels are (out, in), with axes of length 1 behind for a 1 x 1 convolution and the taps of
any other; ours are (in, out), and (taps * in, out) where a layer sees neighbouring rows at once.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from dbdnet_jax.errors import CheckpointError
from dbdnet_jax.io.torch_pickle import load_torch
from dbdnet_jax.networks.params import require_shapes

FIX = "Give a file that the authors' code saved, unaltered."
_COUNTER = "num_batches_tracked"  # of torch's batch norms: how many they have seen
_LEAVES = {"scale": "weight", "mean": "running_mean", "variance": "running_var"}


class Entry(NamedTuple):
    """Torch's name and shape of one of our parameters."""

    name: str
    shape: tuple[int, ...]


def batch_norm_entries(
    ours: str, theirs: str, norm: str, fan_in: int, features: int, *, bias: bool, axes: int
) -> dict[str, Entry]:
    """Entries of a `DenseBatchNorm`: its map ``theirs`` and its norm ``norm`` in torch's names."""
    found = affine_entries(f"{ours}/conv", theirs, fan_in, features, bias=bias, axes=axes)
    for leaf in ("scale", "bias", "mean", "variance"):
        name = f"{norm}.{_LEAVES.get(leaf, leaf)}"
        found[f"{ours}/batch_norm/{leaf}"] = Entry(name, (features,))
    return found


def affine_entries(
    ours: str, theirs: str, fan_in: int, features: int, *, bias: bool = True, axes: int = 0
) -> dict[str, Entry]:
    """Entries of an affine map whose torch kernel has ``axes`` of length 1 behind (out, in)."""
    found = {f"{ours}/kernel": Entry(f"{theirs}.weight", (features, fan_in, *[1] * axes))}
    if bias:
        found[f"{ours}/bias"] = Entry(f"{theirs}.bias", (features,))
    return found


def read_state(path_or_state_dict: str | Path | Mapping[str, Any]) -> tuple[str, dict[str, Any]]:
    """What to call the weights in an error, and their tensors by name.

    They may stand under "model" beside the optimiser's state, and begin with ``module.``. Torch's
    counters of batches are left out.

    Raises:
      CheckpointError: the file is refused or damaged, or holds no tensors by name.
    """
    if isinstance(path_or_state_dict, Mapping):
        owner, saved = "The state dict", path_or_state_dict
    else:
        owner, saved = str(path_or_state_dict), load_torch(path_or_state_dict)
    if isinstance(saved, Mapping) and isinstance(saved.get("model"), Mapping):
        saved = saved["model"]
    if not isinstance(saved, Mapping):
        raise CheckpointError(f"{owner} must hold a state dict; got {type(saved).__name__}. {FIX}")
    named = {str(name).removeprefix("module."): value for name, value in saved.items()}
    return owner, {name: value for name, value in named.items() if not name.endswith(_COUNTER)}


def arrays_from_state(
    state: Mapping[str, Any], entries: Mapping[str, Entry], owner: str
) -> dict[str, np.ndarray]:
    """Our parameters, in the type that the tensors have.

    Raises:
      CheckpointError: entries are missing, unknown or misshapen, or no floating-point numbers.
    """
    require_shapes(
        {name: tuple(np.shape(value)) for name, value in state.items()},
        dict(entries.values()),
        owner,
        FIX,
    )
    arrays = {}
    for name, entry in entries.items():
        array = np.asarray(state[entry.name])
        if array.dtype.kind != "f":
            raise CheckpointError(
                f"{owner} must hold floating-point numbers; {entry.name} is {array.dtype}. {FIX}"
            )
        if name.endswith("/kernel"):
            out, fan_in = entry.shape[:2]
            array = array.reshape(out, fan_in, -1).transpose(2, 1, 0).reshape(-1, out)
        arrays[name] = np.ascontiguousarray(array)
    return arrays
