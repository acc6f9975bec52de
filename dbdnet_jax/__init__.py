"""Partial-to-partial point-cloud registration in JAX: DBDNet (Li, Zhu & Xie 2024).

The public surface is what this module exports; everything else may change. What it exports is
imported when it is first asked for: JAX takes a second, and ``--help`` should not.
"""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from dbdnet_jax.alignment.align import Alignment, align
    from dbdnet_jax.alignment.align_many import MultiAlignment, align_many
    from dbdnet_jax.alignment.align_pairs import PairResult, align_pairs
    from dbdnet_jax.networks.dbdnet.register import register
    from dbdnet_jax.networks.dbdnet.released import from_released, to_released
    from dbdnet_jax.networks.weights import load_params, load_pretrained, save_params
    from dbdnet_jax.types import Registration

__version__ = "0.1.0"
__all__ = [
    "Alignment",
    "MultiAlignment",
    "PairResult",
    "Registration",
    "align",
    "align_many",
    "align_pairs",
    "from_released",
    "load_params",
    "load_pretrained",
    "register",
    "save_params",
    "to_released",
]
_MODULES = {
    "Alignment": "alignment.align",
    "MultiAlignment": "alignment.align_many",
    "PairResult": "alignment.align_pairs",
    "Registration": "types",
    "align": "alignment.align",
    "align_many": "alignment.align_many",
    "align_pairs": "alignment.align_pairs",
    "from_released": "networks.dbdnet.released",
    "load_params": "networks.weights",
    "load_pretrained": "networks.weights",
    "register": "networks.dbdnet.register",
    "save_params": "networks.weights",
    "to_released": "networks.dbdnet.released",
}


def __getattr__(name: str) -> Any:
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(importlib.import_module(f"{__name__}.{_MODULES[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
