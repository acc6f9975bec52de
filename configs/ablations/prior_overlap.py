"""Step 4 of the paper's ablation: the overlap first, then a single branch.

    python train.py --config=configs/ablations/prior_overlap.py

One stack of correspondences gives rotation and translation.
"""

from ml_collections import ConfigDict

from configs.ablations import dual_branches


def get_config() -> ConfigDict:
    """The differences from the whole network."""
    config = dual_branches.get_config()
    config.model.branches = 1
    return config
