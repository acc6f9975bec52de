"""FINet with its authors' settings, on ModelNet40 under the DBDNet paper's protocol.

    python train.py --config=configs/peers/finet.py --config.data.folder=/data/modelnet40

Published with 10,000 epochs of batch 64, Adam at 1e-4, constant: days of a GPU. The authors sample
every shape 40 times, and leave out the symmetric categories; here the shapes are those of all
methods. The best weights are chosen by the authors' score on held-out training shapes.
"""

from ml_collections import ConfigDict

from dbdnet_jax.training.config import default_config


def get_config() -> ConfigDict:
    """The stage's defaults are the authors'; here stand their optimizer and the data set."""
    config = default_config("finet")
    config.data.name = "modelnet40"
    config.train.optimizer = "adam"
    config.train.weight_decay = 0.0
    config.train.schedule = "constant"
    config.train.warmup_epochs = 0.0
    return config
