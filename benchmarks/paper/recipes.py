"""The methods that are compared, each with its configuration."""

import importlib
from pathlib import Path
from typing import NamedTuple

from dbdnet_jax.networks.table import parts_of
from dbdnet_jax.training.config import read_config
from dbdnet_jax.training.task import RunConfig


class Recipe(NamedTuple):
    """A line of the tables: ``title`` there, ``config`` without its ending, a step of the ladder.

    ``overlap_only`` is said of methods without a pose.
    """

    title: str
    config: str
    step: str = ""
    overlap_only: bool = False


RECIPES = {
    "dcp": Recipe("DCP", "configs/peers/dcp_cad"),
    "omnet": Recipe("OMNet", "configs/peers/omnet_cad"),
    "rienet": Recipe("RIENet", "configs/peers/rienet_cad"),
    "finet": Recipe("FINet", "configs/peers/finet_cad"),
    "masknet": Recipe("MaskNet", "configs/peers/masknet_cad", overlap_only=True),
    "inenet": Recipe("INENet", "configs/peers/inenet_cad", overlap_only=True),
    "dual_branches": Recipe("DBDNet", "configs/ablations/dual_branches", "5 dual branches"),
    "cad": Recipe("DBDNet as shipped", "configs/cad"),
    "prior_overlap": Recipe("", "configs/ablations/prior_overlap", "4 prior overlap"),
    "joint_overlap": Recipe("", "configs/ablations/joint_overlap", "3 joint overlap"),
    "multiresolution": Recipe(
        "", "configs/ablations/multiresolution", "2 multi-resolution encoder"
    ),
    "dgcnn": Recipe("", "configs/ablations/dgcnn", "1 DGCNN encoder"),
}


def configuration(recipe: Recipe) -> RunConfig:
    """The records of a recipe's configuration file."""
    module = importlib.import_module(recipe.config.replace("/", "."))
    return read_config(module.get_config())


def stages(config: RunConfig) -> tuple[str, ...]:
    """The stages that are trained, one after the other; all share the budget alike."""
    return parts_of(config.model)


def seeds(recipe: Recipe, count: int) -> range:
    """The ladder's steps are trained from several seeds, all others from one."""
    return range(count if recipe.step else 1)


def run_folder(runs: Path, name: str, seed: int) -> Path:
    """Where a method's run of one seed lies."""
    return runs / (f"{name}_seed{seed}" if seed else name)
