"""Step 3 of the paper's ablation: the overlap from the registration's own features.

    python train.py --config=configs/ablations/joint_overlap.py

All points pass the attention; a head on the features that are matched says which of them take
part. There is one network, and one stage: registration.
"""

from ml_collections import ConfigDict

from configs.ablations import dual_branches


def get_config() -> ConfigDict:
    """The differences from the whole network."""
    config = dual_branches.get_config()
    config.model.branches = 1
    config.model.overlap = "joint"
    return config
