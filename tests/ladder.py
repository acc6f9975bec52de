"""The steps of the paper's ablation, from the whole network down to the first one."""

import dataclasses

from configs.ablations import (
    dgcnn,
    dual_branches,
    joint_overlap,
    multiresolution,
    prior_overlap,
)
from dbdnet_jax.networks.dbdnet.config import ModelConfig
from tests.networks.dbdnet.small import SMALL

LADDER = {
    "dual_branches": dual_branches,
    "prior_overlap": prior_overlap,
    "joint_overlap": joint_overlap,
    "multiresolution": multiresolution,
    "dgcnn": dgcnn,
}


def small_step(name: str, **changes: object) -> ModelConfig:
    """A step's network, small enough for a test."""
    model = LADDER[name].get_config().model
    kinds = {field: model[field] for field in ("encoder", "branches", "overlap")}
    return dataclasses.replace(SMALL, **{**kinds, **changes})
