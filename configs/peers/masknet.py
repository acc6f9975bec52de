"""MaskNet with its authors' settings, on ModelNet40 under the DBDNet paper's protocol.

    python train.py --config=configs/peers/masknet.py --config.data.folder=/data/modelnet40

A GPU's task: 500 epochs of batch 32, Adam at 1e-4, constant. The authors train on a whole template
and pairs with exact twins; here both clouds are partial, each is in turn the template, and the
labels follow the protocol's distance. They choose the best epoch by the test loss, we by the
overlap of held-out training shapes.
"""

from ml_collections import ConfigDict

from dbdnet_jax.training.config import default_config


def get_config() -> ConfigDict:
    """The stage's defaults are the authors'; here stand their optimizer and the data set."""
    config = default_config("masknet")
    config.data.name = "modelnet40"
    config.train.optimizer = "adam"
    config.train.weight_decay = 0.0
    config.train.schedule = "constant"
    config.train.warmup_epochs = 0.0
    return config
