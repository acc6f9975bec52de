"""DCP-v2 on the CAD shapes inside the package, for two cores.

    python train.py --config=configs/peers/dcp_cad.py

Half of the authors' width and batches of 8. Not yet run to its end: 50 epochs of 642 shapes, the
rate a tenth after 30 and 40.
"""

from ml_collections import ConfigDict

from configs.peers import dcp


def get_config() -> ConfigDict:
    """The differences from the authors' settings."""
    config = dcp.get_config()
    config.data.name = "cad"
    config.train.log_every = 80
    config.train.validate_every = 800
    config.train.checkpoint_every = 800
    config.train.validation_pairs = 97
    config.model.edges = (32, 32, 64, 128)
    config.model.features = 256
    config.model.hidden = 512
    config.train.milestones = (30.0, 40.0)
    config.dcp.epochs = 50.0
    config.dcp.batch_size = 8
    return config
