"""The paper's network at the size of configs/cad.py: the last step of its ablation, and their base.

    python train.py --config=configs/ablations/dual_branches.py

Widths, blocks and the 256 points seen of each cloud are those of configs/cad.py, and so is the
neighbour search; what that adds to the paper is taken out: matches in the overlap network, turns,
local geometry. The registration learns on predicted masks. `python -m benchmarks.paper` trains the
whole ladder, at a constant rate; docs/peers.md has what came of it.
"""

from ml_collections import ConfigDict

from configs import cad


def get_config() -> ConfigDict:
    """The differences from the CAD configuration."""
    config = cad.get_config()
    config.model.overlap_matching = False
    config.model.overlap_passes = 1
    config.model.local_geometry = 0
    config.train.warmup_epochs = 0.25
    config.registration.masks = "predicted"
    config.registration.overlap_gamma = 0.0  # as config.overlap.gamma
    return config
