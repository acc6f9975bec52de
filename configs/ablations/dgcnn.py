"""Step 1 of the paper's ablation: a DGCNN as encoder, no overlap, a single branch.

    python train.py --config=configs/ablations/dgcnn.py

All points are matched. There is one network, and one stage: registration.
"""

from ml_collections import ConfigDict

from configs.ablations import dual_branches


def get_config() -> ConfigDict:
    """The differences from the whole network."""
    config = dual_branches.get_config()
    config.model.encoder = "dgcnn"
    config.model.branches = 1
    config.model.overlap = "none"
    return config
