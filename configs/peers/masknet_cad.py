"""MaskNet on the CAD shapes inside the package, for two cores.

    python train.py --config=configs/peers/masknet_cad.py

The authors' schedule with batches of 8, which learn more from as many pairs. Not yet run to its
end: 100 epochs of 642 shapes, 64,200 pairs.
"""

from ml_collections import ConfigDict

from configs.peers import masknet


def get_config() -> ConfigDict:
    """The differences from the authors' settings."""
    config = masknet.get_config()
    config.data.name = "cad"
    config.train.log_every = 80
    config.train.validate_every = 800
    config.train.checkpoint_every = 800
    config.train.validation_pairs = 97
    config.masknet.epochs = 100.0
    config.masknet.batch_size = 8
    return config
