"""The parameters of a method: its networks by name, and the configuration they fit."""

from collections.abc import Mapping
from typing import Any

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
from flax.traverse_util import flatten_dict, unflatten_dict

from dbdnet_jax.errors import CheckpointError

Shapes = dict[str, tuple[int, ...]]  # of every parameter, by its names in the tree joined with /
_LISTED = 50  # names of each kind in an error: another network's file would fill pages


@flax.struct.dataclass
class Params:
    """The parameters of one method's networks by name and, as static metadata, its configuration.

    ``jax.jit(register)(params, src, tgt)`` therefore needs no further argument. A network that is
    not there is left out: DBDNet's two may be trained, kept and shipped apart.
    """

    networks: dict[str, Any]
    config: Any = flax.struct.field(pytree_node=False)

    @property
    def overlap(self) -> Any:
        """DBDNet's overlap network; None where it is not there."""
        return self.networks.get("overlap")

    @property
    def registration(self) -> Any:
        """DBDNet's registration network; None where it is not there."""
        return self.networks.get("registration")


def flatten(params: Params) -> dict[str, np.ndarray]:
    """The arrays of ``params`` on the host, by their names."""
    flat = flatten_dict(params.networks, sep="/")
    return {name: np.asarray(leaf) for name, leaf in flat.items()}


def unflatten(arrays: Mapping[str, np.ndarray], config: Any) -> Params:
    """``Params`` on the default device, of the networks that have arrays."""
    leaves = jax.device_put(dict(arrays))  # at once: hundreds of single ones take half a second
    return Params(unflatten_dict(leaves, sep="/"), config)


def bfloat16_kernels(networks: Any) -> Any:
    """The same tree with its kernels in bfloat16, and with them the products (`ops.products`).

    Geometry stays in float32: neighbours, Sinkhorn, poses, what a norm computes, and the layers
    that are given coordinates. Files hold float32, so this is for what is loaded or trained.
    """

    def rounded(path: tuple[Any, ...], leaf: Any) -> Any:
        return leaf.astype(jnp.bfloat16) if path[-1].key == "kernel" else leaf

    return jax.tree_util.tree_map_with_path(rounded, networks)


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


def require_finite(arrays: Mapping[str, np.ndarray], owner: str) -> None:
    """Raise ``CheckpointError`` listing the arrays that have no finite float32 for every number."""
    with np.errstate(over="ignore"):
        bad = [name for name, x in arrays.items() if not np.isfinite(np.asarray(x, "f4")).all()]
    if bad:
        raise CheckpointError(
            f"{owner} must hold finite numbers; NaN, infinity or more than float32 holds is in "
            f"{len(bad)} of {len(arrays)} arrays: {', '.join(bad[:_LISTED])}. Train again, or "
            "fetch the file again."
        )
