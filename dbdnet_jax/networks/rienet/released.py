"""The authors' weights of RIENet: their names and layout to ours."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from dbdnet_jax.errors import CheckpointError
from dbdnet_jax.networks.params import Params, unflatten
from dbdnet_jax.networks.rienet.confidence import BRANCH, HEAD, TAPS
from dbdnet_jax.networks.rienet.network import RIENetConfig
from dbdnet_jax.networks.torch_state import (
    FIX,
    Entry,
    affine_entries,
    arrays_from_state,
    batch_norm_entries,
    read_state,
)

_UNUSED = ("single_point_embed.", "forwards.fuse.")  # declared by the code, used nowhere
_FIRST = "forwards.weight_function.model1.0.weight"


def from_released(
    path_or_state_dict: str | Path | Mapping[str, Any],
    *,
    k1: int = 5,
    k2: int = 5,
    margin: float = 0.7,
) -> Params:
    """Parameters of RIENet; its widths are read off the shapes.

    What no shape tells is given: the defaults are those of both ModelNet40 files; 7Scenes takes
    ``k1=8, k2=8, margin=0.5``, ICL-NUIM ``k1=32, k2=10, margin=0.5``.

    Raises:
      CheckpointError: the file is refused or damaged, or holds other entries than these.
    """
    owner, state = read_state(path_or_state_dict)
    state = {name: value for name, value in state.items() if not name.startswith(_UNUSED)}
    if _FIRST not in state:
        raise CheckpointError(f"{owner} must hold {_FIRST}; it does not. {FIX}")
    config = RIENetConfig(k1=k1, k2=k2, margin=margin, width=int(state[_FIRST].shape[0]))
    return unflatten(arrays_from_state(state, entries(config), owner), config)


def entries(config: RIENetConfig) -> dict[str, Entry]:
    """Torch's name and shape of every parameter."""
    found: dict[str, Entry] = {}
    widths = (3, *config.edges)
    sizes = [*zip(widths[:-1], widths[1:], strict=True), (sum(config.edges), config.features)]
    for i, (fan_in, features) in enumerate(sizes):
        ours = f"rienet/encoder/edge_{i}" if i < len(config.edges) else "rienet/encoder/point"
        theirs = f"emb_nn.model.conv{i + 1}", f"emb_nn.model.bn{i + 1}"
        found |= batch_norm_entries(ours, *theirs, fan_in, features, bias=False, axes=2)
    return found | _confidence_entries(config.width)


def _confidence_entries(width: int) -> dict[str, Entry]:
    stem = "forwards.weight_function.model"
    found: dict[str, Entry] = {}
    layers = [
        ("edge_0", f"{stem}1", 0, 3, width, 2),
        ("edge_1", f"{stem}1", 3, width, 2 * width, 2),
        ("value_0", f"{stem}2", 0, 2 * width, BRANCH, 2),
        ("value_1", f"{stem}2", 3, BRANCH, BRANCH, 2),
        ("weight_0", f"{stem}3", 0, 2 * width, BRANCH, 2),
        ("weight_1", f"{stem}3", 3, BRANCH, BRANCH, 2),
        ("head_0", f"{stem}4", 0, BRANCH, HEAD, 1),
    ]
    for name, theirs, place, fan_in, features, axes in layers:
        ours, names = f"rienet/confidence/{name}", (f"{theirs}.{place}", f"{theirs}.{place + 1}")
        found |= batch_norm_entries(ours, *names, fan_in, features, bias=True, axes=axes)
        if name.startswith("edge"):
            kernel = f"{ours}/conv/kernel"
            found[kernel] = found[kernel]._replace(shape=(features, fan_in, TAPS, 1))
    return found | affine_entries("rienet/confidence/head_1", f"{stem}4.3", HEAD, 1, axes=1)
