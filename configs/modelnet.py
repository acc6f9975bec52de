"""The paper's settings on ModelNet40: unseen shapes of all categories, with noise.

    python train.py --config=configs/modelnet.py --config.data.folder=/path/modelnet40_ply_hdf5_2048

A GPU's task: 300 + 300 epochs of 9,348 shapes. The paper reports, for unseen shapes with noise, a
mean rotation error of 4.612 degrees and a mean translation error of 0.085. For its unseen
categories add --config.data.categories=seen; without noise, --config.protocol.noise_sigma=0.0.

Departs from the paper in one thing: every 20th training shape is held out to choose the best
checkpoint, because nothing here is chosen on test shapes. `config.joint` is for --stage=joint,
which the paper does not have, and nothing else reads it.
"""

from ml_collections import ConfigDict

from dbdnet_jax.training.config import default_config


def get_config() -> ConfigDict:
    """The defaults of all records are the paper's; only the data set must be named."""
    config = default_config()
    config.data.name = "modelnet40"
    return config
