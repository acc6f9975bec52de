"""Partial-to-partial point-cloud registration in JAX: DBDNet (Li, Zhu & Xie 2024).

The public surface is what this module exports; everything else may change.
"""

from dbdnet_jax.alignment.align import Alignment, align
from dbdnet_jax.alignment.align_many import MultiAlignment, align_many
from dbdnet_jax.networks.dbdnet.register import register
from dbdnet_jax.networks.dbdnet.released import from_released, to_released
from dbdnet_jax.networks.weights import load_params, load_pretrained, save_params
from dbdnet_jax.types import Registration

__version__ = "0.1.0"
__all__ = [
    "Alignment",
    "MultiAlignment",
    "Registration",
    "align",
    "align_many",
    "from_released",
    "load_params",
    "load_pretrained",
    "register",
    "save_params",
    "to_released",
]
