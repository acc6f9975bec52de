"""RIENet on the CAD shapes inside the package, for two cores.

    python train.py --config=configs/peers/rienet_cad.py

The authors' width for seen categories, which is small, and their schedule with batches of 8. Not
yet run to its end: 50 epochs of 642 shapes.
"""

from ml_collections import ConfigDict

from configs.peers import rienet


def get_config() -> ConfigDict:
    """The differences from the authors' settings."""
    config = rienet.get_config()
    config.data.name = "cad"
    config.train.log_every = 80
    config.train.validate_every = 800
    config.train.checkpoint_every = 800
    config.train.validation_pairs = 97
    config.model.width = 8
    config.rienet.epochs = 50.0
    config.rienet.batch_size = 8
    return config
