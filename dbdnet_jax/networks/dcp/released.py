"""The authors' weights of DCP: their names and layout to ours."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from dbdnet_jax.networks.dcp.network import DCPConfig
from dbdnet_jax.networks.params import Params, unflatten
from dbdnet_jax.networks.torch_state import (
    Entry,
    affine_entries,
    arrays_from_state,
    batch_norm_entries,
    read_state,
)

_REFLECT = "head.reflect"  # a constant of their pose head
_PROJECTIONS = ("query", "key", "value", "out")


def from_released(path_or_state_dict: str | Path | Mapping[str, Any]) -> Params:
    """Parameters of DCP-v1 or v2, with the widths of the released code.

    Raises:
      CheckpointError: the file is refused or damaged, or holds other entries than these.
    """
    owner, state = read_state(path_or_state_dict)
    state.pop(_REFLECT, None)
    transformer = any(name.startswith("pointer.") for name in state)
    config = DCPConfig(pointer="transformer" if transformer else "identity")
    return unflatten(arrays_from_state(state, entries(config), owner), config)


def entries(config: DCPConfig) -> dict[str, Entry]:
    """Torch's name and shape of every parameter."""
    found: dict[str, Entry] = {}
    widths = (6, *config.edges)
    sizes = [*zip(widths[:-1], widths[1:], strict=True), (sum(config.edges), config.features)]
    for i, (fan_in, features) in enumerate(sizes):
        ours = f"dcp/encoder/edge_{i}" if i < len(config.edges) else "dcp/encoder/point"
        theirs = f"emb_nn.conv{i + 1}", f"emb_nn.bn{i + 1}"
        found |= batch_norm_entries(ours, *theirs, fan_in, features, bias=False, axes=2)
    if config.pointer == "transformer":
        found |= _layer_entries(config, "encoder", ("self",))
        found |= _layer_entries(config, "decoder", ("self", "cross"))
    return found


def _layer_entries(config: DCPConfig, half: str, kinds: tuple[str, ...]) -> dict[str, Entry]:
    found: dict[str, Entry] = {}
    ours, theirs = f"dcp/pointer_{half}", f"pointer.model.{half}"
    width = config.features
    for block in range(config.blocks):
        layer = f"{theirs}.layers.{block}"
        for kind in kinds:
            attention = f"{layer}.{'self' if kind == 'self' else 'src'}_attn"
            for i, part in enumerate(_PROJECTIONS):
                name = f"{ours}/{kind}_attention_{block}/{part}"
                found |= affine_entries(name, f"{attention}.linears.{i}", width, width)
        for i, (fan_in, features) in enumerate([(width, config.hidden), (config.hidden, width)]):
            name = f"{ours}/forward_{block}_{i}"
            found |= affine_entries(name, f"{layer}.feed_forward.w_{i + 1}", fan_in, features)
        for i, kind in enumerate((*kinds, "forward")):
            name = f"{ours}/{kind}_norm_{block}"
            found |= _norm_entries(name, f"{layer}.sublayer.{i}.norm", width)
    return found | _norm_entries(f"{ours}/norm", f"{theirs}.norm", width)


def _norm_entries(ours: str, theirs: str, width: int) -> dict[str, Entry]:
    return {
        f"{ours}/scale": Entry(f"{theirs}.a_2", (width,)),
        f"{ours}/bias": Entry(f"{theirs}.b_2", (width,)),
    }
