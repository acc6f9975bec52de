"""The authors' checkpoints: their names and layout to ours and back.

Theirs are PyTorch's: convolutions (out, in, 1) or (out, in, 1, 1), linear layers (out, in), the
attention's query, key and value projections stacked as (3 d, d). Ours are kernels (in, out).
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from dbdnet_jax.errors import CheckpointError
from dbdnet_jax.io.torch_pickle import load_torch
from dbdnet_jax.networks.dbdnet.config import ModelConfig
from dbdnet_jax.networks.dbdnet.overlap import overlap_shapes
from dbdnet_jax.networks.dbdnet.registration import registration_shapes
from dbdnet_jax.networks.params import (
    Params,
    Shapes,
    flatten,
    require_finite,
    require_shapes,
    unflatten,
)

_NESTED = ("state_dict", "model_state_dict", "model", "net", "network")
_OVERLAP = "overlap_predictor."
_FULL = (_OVERLAP, "feature_extractor.", "RegNet.")
# Declared beside the overlap network's blocks and used by none of its computations.
_UNUSED = ("self_attention.", "self_layer_norm.", "cross_attention.", "cross_layer_norm.")
_FIXED = {
    name: getattr(ModelConfig(), name)
    for name in (
        "encoder",
        "branches",
        "overlap",
        "neighbour_space",
        "heads",
        "head_width",
        "parameter_width",
        "overlap_matching",
        "overlap_passes",
        "overlap_points",
        "registration_points",
        "local_geometry",
    )
}
_MOST_ENTRIES = 20_000  # the released network has 700
_FIX = "Give a checkpoint that the released code saved, unaltered."
# Our names to theirs, in this order, before / becomes a dot.
_RULES = (
    (r"^overlap/", "overlap_predictor/"),
    (r"^registration/encoder/", "feature_extractor/"),
    (r"^registration/", "RegNet/"),
    (r"overlap_predictor/linear/", "overlap_predictor/linear/0/"),
    (
        r"weight_net/linear/",
        f"weight_net/pre_parameter_layer/{3 * len(ModelConfig().global_layers)}/",
    ),
    (r"(stage\d_conv\d)/(conv|norm)_(\d)/", r"\1/conv/\3/\2/"),
    (r"(stage\d_(?:up|down)_\d_\d|neck_\d)/conv/", r"\1/conv/conv/"),
    (r"(attention|attention_R|attention_t|decoder)_(\d+)/", r"\1/\2/"),
    (r"in_proj/kernel$", "in_proj_weight"),
    (r"in_proj/bias$", "in_proj_bias"),
    (r"(kernel|scale)$", "weight"),
)


class _Entry(NamedTuple):
    """One tensor of a released checkpoint."""

    name: str
    shape: tuple[int, ...]


def from_released(path_or_state_dict: str | Path | Mapping[str, Any], *, k: int = 20) -> Params:
    """Parameters from the authors' PyTorch checkpoint, read without torch and running nothing.

    Widths and numbers of blocks are read off the shapes. ``released=True`` is set in the
    configuration, so that the numbers are the authors' too. A checkpoint of their overlap network
    alone (``HROverlapNet``) gives ``registration=None``.

    Args:
      path_or_state_dict: a file written by ``torch.save`` (either format), or its content; the
        state dict may be nested under a usual key, its names may start with ``module.``.
      k: the number of neighbours the network was trained with, which no shape tells.

    Returns:
      Float32 parameters.

    Raises:
      CheckpointError: the file is refused or damaged, or entries are missing, unknown or
        misshapen; all are listed. The four modules that the released code declares and never uses
        are ignored. Or numbers are not finite.
    """
    if isinstance(path_or_state_dict, Mapping):
        owner, saved = "The state dict", path_or_state_dict
    else:
        owner, saved = str(path_or_state_dict), load_torch(path_or_state_dict)
    state = _state_dict(saved, owner)
    if len(state) > _MOST_ENTRIES:
        raise CheckpointError(
            f"{owner} must hold at most {_MOST_ENTRIES} entries; got {len(state)}. {_FIX}"
        )
    full = any(name.startswith(_FULL) for name in state)
    overlap = _OVERLAP if full else ""
    unused = tuple(overlap + name for name in _UNUSED)
    state = {name: value for name, value in state.items() if not name.startswith(unused)}
    found = {name: tuple(np.shape(value)) for name, value in state.items()}
    config = _infer(found, full, k, owner)
    entries = _entries(config, full)
    require_shapes(found, dict(entries.values()), owner, _FIX)
    arrays = {}
    for name, entry in entries.items():
        array = np.asarray(state[entry.name])
        if array.dtype.kind != "f":
            raise CheckpointError(
                f"{owner} must hold floating-point numbers; {entry.name} is {array.dtype}. {_FIX}"
            )
        if name.endswith("/kernel"):
            array = array.reshape(entry.shape[:2]).T
        arrays[name] = np.array(array, np.float32, order="C")
    require_finite(arrays, owner)
    return unflatten(arrays, config)


def to_released(params: Params) -> dict[str, np.ndarray]:
    """``params`` as a state dict of NumPy arrays in the released code's names and layout.

    ``{name: torch.from_numpy(array) for ...}`` passes their strict ``load_state_dict``, given
    their network built with the same widths, blocks and k. The four modules it declares and never
    uses are filled with zeros (attention, biases) and ones (the norms' weights). The computation
    there is that of ``released=True``, whatever these parameters were trained with.

    Raises:
      ValueError: there is no overlap network, or neighbours are not searched among features;
        their code knows neither.
    """
    config = params.config
    if params.overlap is None:
        raise ValueError(
            "The released code always has an overlap network; got overlap=None. Train one first."
        )
    for name, fixed in _FIXED.items():
        if getattr(config, name) != fixed:
            raise ValueError(
                f"{name} is {fixed!r} in the released code and cannot be changed there; got "
                f"{getattr(config, name)!r}. Train with {name}={fixed!r}."
            )
    full = params.registration is not None
    ours = flatten(params)
    state = {}
    for name, entry in _entries(config, full).items():
        array = ours[name].T if name.endswith("/kernel") else ours[name]
        state[entry.name] = np.array(array, np.float32, order="C").reshape(entry.shape)
    prefix = _OVERLAP if full else ""
    for name, array in list(state.items()):
        # They have the shapes of a block's entries.
        unused = name.removeprefix(f"{prefix}attention.0.")
        if unused != name:
            fill = np.ones_like if unused.endswith("norm.weight") else np.zeros_like
            state[prefix + unused] = fill(array)
    return state


def _state_dict(saved: Any, owner: str) -> dict[str, Any]:
    """The mapping of names to arrays, out of what may be around it."""
    for _ in range(len(_NESTED)):  # a mapping may hold itself
        if isinstance(saved, Mapping):
            nested = [saved[key] for key in _NESTED if isinstance(saved.get(key), Mapping)]
            if not nested:
                names = [name for name in saved if isinstance(name, str)]
                return {name.removeprefix("module."): saved[name] for name in names}
            saved = nested[0]
    raise CheckpointError(f"{owner} must hold a state dict; got a {type(saved).__name__}. {_FIX}")


def _infer(found: Shapes, full: bool, k: int, owner: str) -> ModelConfig:
    """The configuration that the shapes tell."""

    def channels(encoder: str) -> int:
        name = f"{encoder}stage1_conv1.conv.0.conv.weight"
        if len(found.get(name, ())) != 4:
            raise CheckpointError(
                f"{owner} must hold {name} (channels, 6, 1, 1); got {found.get(name)} among "
                f"{len(found)} entries. {_FIX}"
            )
        return found[name][0]

    def blocks(stem: str) -> int:
        stem += "."
        return len({n[len(stem) :].split(".")[0] for n in found if n.startswith(stem)})

    overlap = _OVERLAP if full else ""
    sizes: dict[str, Any] = {
        "overlap_channels": channels(f"{overlap}encoder."),
        "overlap_blocks": blocks(f"{overlap}attention"),
    }
    if full:
        sizes |= {
            "registration_channels": channels("feature_extractor."),
            "shared_blocks": blocks("RegNet.attention"),
            "rotation_blocks": blocks("RegNet.attention_R"),
            "translation_blocks": blocks("RegNet.attention_t"),
        }
    try:
        return ModelConfig(**sizes, neighbours=k, released=True)
    except ValueError as error:
        raise CheckpointError(f"{owner}: its shapes give no network: {error}") from error


def _entries(config: ModelConfig, full: bool) -> dict[str, _Entry]:
    """Their name and shape of each of our parameters, by our name."""
    shapes = overlap_shapes(config) | (registration_shapes(config) if full else {})
    return {name: _entry(name, shape, full) for name, shape in shapes.items()}


def _entry(name: str, shape: tuple[int, ...], full: bool) -> _Entry:
    theirs = re.sub(r"weight_net/(point|global)_(\d)/(conv|norm)/", _sequential, name)
    for pattern, replacement in _RULES:
        theirs = re.sub(pattern, replacement, theirs)
    theirs = theirs.replace("/", ".")
    if not full:
        theirs = theirs.removeprefix(_OVERLAP)
    if name.endswith("/kernel"):
        shape = (*shape[::-1], *[1] * _window_axes(name))
    return _Entry(theirs, shape)


def _sequential(match: re.Match[str]) -> str:
    """Their parameter net is two ``Sequential`` of convolution, norm, ReLU, counted through."""
    kind, layer, part = match.groups()
    stack = "encoder" if kind == "point" else "pre_parameter_layer"
    return f"weight_net/{stack}/{3 * int(layer) + (part == 'norm')}/"


def _window_axes(name: str) -> int:
    """How many axes of length 1 follow (out, in): none for linear layers, 2 over neighbours."""
    if re.search(r"/(in_proj|out_proj)/|weight_net/(global_|linear)", name):
        return 0
    # Edge convolutions, and the transition that opens the level after its stage.
    return 2 if re.search(r"/conv_\d/|stage(\d)_down_\1_", name) else 1
