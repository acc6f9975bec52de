"""RIENet with its authors' settings, on ModelNet40 under the DBDNet paper's protocol.

    python train.py --config=configs/peers/rienet.py --config.data.folder=/data/modelnet40

A GPU's task: 50 epochs of batch 16, Adam at 1e-3 with an L2 term of 1e-4, times 0.3 after 25 and 50
epochs (their code, under the PyTorch it names, one epoch earlier). The width is theirs for unseen
categories. Training is told neither pose nor overlap; validation is.
"""

from ml_collections import ConfigDict

from dbdnet_jax.training.config import default_config


def get_config() -> ConfigDict:
    """The stage's defaults are the authors'; here stand their optimizer and the data set."""
    config = default_config("rienet")
    config.data.name = "modelnet40"
    config.model.width = 16
    config.train.optimizer = "adam"
    config.train.weight_decay = 1e-4
    config.train.schedule = "steps"
    config.train.milestones = (25.0, 50.0)
    config.train.factor = 0.3
    config.train.warmup_epochs = 0.0
    return config
