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


class Training(NamedTuple):
    """One run of a method: its seed, and whether it sees a half of the categories only."""

    seed: int = 0
    half: bool = False

    def folder(self, runs: Path, name: str) -> Path:
        """Where the method's run lies."""
        seed = f"_seed{self.seed}" if self.seed else ""
        return runs / f"{name}{seed}{'_seen' if self.half else ''}"


def trainings(recipe: Recipe, seeds: int, half: bool) -> list[Training]:
    """The runs of a method.

    On all categories the ladder's steps have several seeds and all others one; on a half of them
    the methods that have a row have one.
    """
    if half:
        return [Training(half=True)] if recipe.title else []
    return [Training(seed) for seed in range(seeds if recipe.step else 1)]
