"""The parameters of the networks by name: what a file of weights must hold for a configuration.

Listed rather than traced: initialising the full-size network to learn its shapes takes seconds,
loading its weights should not. A test holds the list against ``init_params``.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping

import jax
import jax.numpy as jnp
import numpy as np
from flax.traverse_util import flatten_dict, unflatten_dict

from dbdnet_jax.model.config import ModelConfig
from dbdnet_jax.model.dbdnet import Params
from dbdnet_jax.model.overlap import HEAD
from dbdnet_jax.model.registration import GLOBAL_LAYERS, POINT_LAYERS
from dbdnet_jax.ops.pyramid import LEVELS
from dbdnet_jax.safe_pickle import CheckpointError

NETWORKS = ("overlap", "registration")
Shapes = dict[str, tuple[int, ...]]
_LISTED = 50  # names of each kind in an error: another network's file would fill pages


def parameter_shapes(config: ModelConfig, networks: Collection[str] = NETWORKS) -> Shapes:
    """Shape of every parameter by its name in the tree, joined with ``/``."""
    shapes: Shapes = {}
    if "overlap" in networks:
        width = 4 * config.overlap_channels
        _encoder(shapes, "overlap/encoder", config.overlap_channels)
        _blocks(shapes, "overlap/attention", config.overlap_blocks, width)
        last = _layers(shapes, "overlap/decoder", 2 * width, HEAD)
        _affine(shapes, "overlap/linear", last, 1)
    if "registration" in networks:
        width = 4 * config.registration_channels
        _encoder(shapes, "registration/encoder", config.registration_channels)
        _blocks(shapes, "registration/attention", config.shared_blocks, width)
        _blocks(shapes, "registration/attention_R", config.rotation_blocks, width)
        _blocks(shapes, "registration/attention_t", config.translation_blocks, width)
        last = _layers(shapes, "registration/weight_net/point", 4, POINT_LAYERS)
        last = _layers(shapes, "registration/weight_net/global", last, GLOBAL_LAYERS)
        _affine(shapes, "registration/weight_net/linear", last, 4)
    return shapes


def flatten(params: Params) -> dict[str, np.ndarray]:
    """The arrays of ``params`` on the host, by the names of ``parameter_shapes``."""
    networks = {name: getattr(params, name) for name in NETWORKS}
    tree = {name: network for name, network in networks.items() if network is not None}
    return {name: np.asarray(leaf) for name, leaf in flatten_dict(tree, sep="/").items()}


def unflatten(arrays: Mapping[str, np.ndarray], config: ModelConfig) -> Params:
    """``Params`` on the default device; a network without arrays is None."""
    leaves = {name: jnp.asarray(array) for name, array in arrays.items()}
    tree: dict[str, dict[str, jax.Array]] = unflatten_dict(leaves, sep="/")
    return Params(tree.get("overlap"), tree.get("registration"), config)


def require_shapes(found: Shapes, expected: Shapes, owner: str, fix: str) -> None:
    """Raise ``CheckpointError`` listing the missing, unknown and misshapen entries."""
    problems = {
        "missing": [name for name in expected if name not in found],
        "unknown": [name for name in found if name not in expected],
        "misshapen": [
            f"{name} is {shape} instead of {expected[name]}"
            for name, shape in found.items()
            if name in expected and shape != expected[name]
        ],
    }
    if any(problems.values()):
        lists = "; ".join(
            f"{len(entries)} {kind}: {', '.join(entries[:_LISTED])}"
            f"{', ...' if len(entries) > _LISTED else ''}"
            for kind, entries in problems.items()
            if entries
        )
        raise CheckpointError(f"{owner} must hold exactly the network's parameters; {lists}. {fix}")


def _affine(shapes: Shapes, name: str, fan_in: int, fan_out: int) -> None:
    shapes[f"{name}/kernel"] = (fan_in, fan_out)
    shapes[f"{name}/bias"] = (fan_out,)


def _norm(shapes: Shapes, name: str, width: int) -> None:
    shapes[f"{name}/scale"] = shapes[f"{name}/bias"] = (width,)


def _layers(shapes: Shapes, stem: str, fan_in: int, sizes: tuple[tuple[int, int], ...]) -> int:
    """Normalised dense layers of the given (features, groups); returns the last width."""
    for layer, (features, _) in enumerate(sizes):
        _affine(shapes, f"{stem}_{layer}/conv", fan_in, features)
        _norm(shapes, f"{stem}_{layer}/norm", features)
        fan_in = features
    return fan_in


def _blocks(shapes: Shapes, stem: str, count: int, width: int) -> None:
    for block in range(count):
        for step in ("self", "cross"):
            attention = f"{stem}_{block}/{step}_attention"
            _affine(shapes, f"{attention}/in_proj", width, 3 * width)
            _affine(shapes, f"{attention}/out_proj", width, width)
            _norm(shapes, f"{stem}_{block}/{step}_layer_norm", width)


def _encoder(shapes: Shapes, name: str, channels: int) -> None:
    widths = [channels << level for level in range(LEVELS)]
    for stage in range(1, LEVELS + 1):
        for level, width in enumerate(widths[:stage]):
            conv = f"{name}/stage{stage}_conv{level + 1}"
            for layer, fan_in in enumerate((2 * width if stage > 1 else 2 * 3, width)):
                _affine(shapes, f"{conv}/conv_{layer}", fan_in, width)
                _norm(shapes, f"{conv}/norm_{layer}", width)
        for level, width in enumerate(widths[: stage + 1]):
            for other, fan_in in enumerate(widths[:stage]):
                if other != level:
                    move = f"{'up' if other > level else 'down'}_{other + 1}_{level + 1}"
                    _affine(shapes, f"{name}/stage{stage}_{move}/conv", fan_in, width)
    for level, width in enumerate(widths):
        # What is fused: the level's output of every stage that holds it and the last exchange's.
        _affine(shapes, f"{name}/fusion_{level + 1}/conv", (LEVELS + 1 - level) * width, width)
        if level:
            _affine(shapes, f"{name}/neck_{level + 1}/conv", width, channels)
