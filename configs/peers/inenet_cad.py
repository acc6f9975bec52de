"""INENet on the CAD shapes inside the package, for two cores.

    python train.py --config=configs/peers/inenet_cad.py

The authors' widths, which two cores can bear, and batches of 8. Not yet run to its end: 100
epochs of 642 shapes.
"""

from ml_collections import ConfigDict

from configs.peers import inenet


def get_config() -> ConfigDict:
    """The differences from the authors' settings."""
    config = inenet.get_config()
    config.data.name = "cad"
    config.train.log_every = 80
    config.train.validate_every = 800
    config.train.checkpoint_every = 800
    config.train.validation_pairs = 97
    config.inenet.epochs = 100.0
    config.inenet.batch_size = 8
    return config
