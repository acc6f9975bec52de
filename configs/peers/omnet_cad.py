"""OMNet on the CAD shapes inside the package, for two cores.

    python train.py --config=configs/peers/omnet_cad.py

A quarter of the authors' widths, batches of 8 and 100 epochs of 642 shapes instead of 10,000: not
what they published, and not yet run to its end.
"""

from ml_collections import ConfigDict

from configs.peers import omnet


def get_config() -> ConfigDict:
    """The differences from the authors' settings."""
    config = omnet.get_config()
    config.data.name = "cad"
    config.train.log_every = 80
    config.train.validate_every = 800
    config.train.checkpoint_every = 800
    config.train.validation_pairs = 97
    config.model.encoder = (32, 32, 32, 64, 256)
    config.model.fusion = (256, 256, 128)
    config.model.decoder = (128, 64, 64)
    config.model.regression = (512, 256, 128, 64)
    config.omnet.learning_rate = 1e-3
    config.omnet.epochs = 100.0
    config.omnet.batch_size = 8
    return config
