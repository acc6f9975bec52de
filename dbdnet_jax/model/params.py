"""The parameters of both networks, the architecture they fit, and their initial values."""

import math
from collections.abc import Collection, Mapping
from typing import Any

import flax.struct
import jax
import numpy as np
from flax.traverse_util import flatten_dict, unflatten_dict
from jaxtyping import PRNGKeyArray

from dbdnet_jax.model.config import ModelConfig
from dbdnet_jax.model.matching import FIT_FEATURES
from dbdnet_jax.ops.pyramid import LEVELS
from dbdnet_jax.safe_pickle import CheckpointError

NETWORKS = ("overlap", "registration")
Shapes = dict[str, tuple[int, ...]]
_LISTED = 50  # names of each kind in an error: another network's file would fill pages


@flax.struct.dataclass
class Params:
    """The parameters of both networks and, as static metadata, the configuration they fit.

    ``jax.jit(register)(params, src, tgt)`` therefore needs no further argument. ``registration``
    is None for an overlap network on its own.
    """

    overlap: Any
    registration: Any
    config: ModelConfig = flax.struct.field(pytree_node=False)


def init_params(key: PRNGKeyArray, config: ModelConfig) -> Params:
    """Fresh parameters, distributed as in the released code (torch's defaults).

    One draw serves the whole network: a random operation per parameter takes minutes to compile.
    """
    shapes = parameter_shapes(config)
    ends = np.cumsum([math.prod(shape) for shape in shapes.values()])
    uniform = np.asarray(jax.random.uniform(key, (int(ends[-1]),), minval=-1.0))
    draws = np.split(uniform, ends[:-1])
    arrays = {
        name: np.ones(shape, np.float32)
        if name.endswith("/scale")
        else draw.reshape(shape) * np.float32(_bound(name, shapes))
        for (name, shape), draw in zip(shapes.items(), draws, strict=True)
    }
    if config.overlap_matching:
        # Fresh features, normalised, lie about sqrt(2 width) apart: soft matches, half of the mass.
        width = 4 * config.overlap_channels
        arrays["overlap/matching/alpha"] = np.array(1.5 * width, np.float32)
        arrays["overlap/matching/beta"] = np.array(math.log(math.expm1(4.0 / width)), np.float32)
    return unflatten(arrays, config)


def _bound(name: str, shapes: Shapes) -> float:
    """Half the width of a kernel's or bias's uniform distribution around zero.

    1 / sqrt(fan in) for convolutions and linear layers; attention's packed projection is
    Glorot-uniform (Glorot & Bengio 2010); its biases, as a norm's, start at zero.
    """
    parent, leaf = name.rsplit("/", 1)
    kernel = shapes.get(f"{parent}/kernel")
    if kernel is None or (leaf == "bias" and parent.endswith(("in_proj", "out_proj"))):
        return 0.0
    if parent.endswith("in_proj"):
        return (6.0 / sum(kernel)) ** 0.5
    return kernel[0] ** -0.5


def parameter_shapes(config: ModelConfig, networks: Collection[str] = NETWORKS) -> Shapes:
    """Shape of every parameter by its name in the tree, joined with ``/``.

    Listed rather than traced: tracing the full-size network takes seconds, loading weights should
    not. A test holds the list against the networks.
    """
    shapes: Shapes = {}
    if "overlap" in networks:
        width = 4 * config.overlap_channels
        _encoder(shapes, "overlap/encoder", config.overlap_channels, config.inputs)
        _blocks(shapes, "overlap/attention", config.overlap_blocks, width)
        fan_in = 2 * width
        if config.overlap_matching:
            shapes |= {"overlap/matching/alpha": (), "overlap/matching/beta": ()}
            fan_in += FIT_FEATURES
        last = _layers(shapes, "overlap/decoder", fan_in, config.head_layers)
        _affine(shapes, "overlap/linear", last, 1)
    if "registration" in networks:
        width = 4 * config.registration_channels
        _encoder(shapes, "registration/encoder", config.registration_channels, config.inputs)
        _blocks(shapes, "registration/attention", config.shared_blocks, width)
        _blocks(shapes, "registration/attention_R", config.rotation_blocks, width)
        _blocks(shapes, "registration/attention_t", config.translation_blocks, width)
        last = _layers(shapes, "registration/weight_net/point", 4, config.point_layers)
        last = _layers(shapes, "registration/weight_net/global", last, config.global_layers)
        _affine(shapes, "registration/weight_net/linear", last, 4)
    return shapes


def flatten(params: Params) -> dict[str, np.ndarray]:
    """The arrays of ``params`` on the host, by the names of ``parameter_shapes``."""
    networks = {name: getattr(params, name) for name in NETWORKS}
    tree = {name: network for name, network in networks.items() if network is not None}
    return {name: np.asarray(leaf) for name, leaf in flatten_dict(tree, sep="/").items()}


def unflatten(arrays: Mapping[str, np.ndarray], config: ModelConfig) -> Params:
    """``Params`` on the default device; a network without arrays is None."""
    leaves = jax.device_put(dict(arrays))  # at once: hundreds of single ones take half a second
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


def _encoder(shapes: Shapes, name: str, channels: int, inputs: int) -> None:
    widths = [channels << level for level in range(LEVELS)]
    for stage in range(1, LEVELS + 1):
        for level, width in enumerate(widths[:stage]):
            conv = f"{name}/stage{stage}_conv{level + 1}"
            for layer, fan_in in enumerate((2 * width if stage > 1 else 2 * inputs, width)):
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
