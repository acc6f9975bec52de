"""INENet with its authors' settings, on ModelNet40 under the DBDNet paper's protocol.

    python train.py --config=configs/peers/inenet.py --config.data.folder=/data/modelnet40

A GPU's task: 300 epochs of batch 32, AdamW at 1e-3 with a decay of 0.01, gradients clipped to a
norm of 5. The authors train on a whole source; here both clouds are partial, and each is in turn
the source. They choose the best epoch by the test accuracy, we by that of held-out training shapes.
"""

from ml_collections import ConfigDict

from dbdnet_jax.training.config import default_config


def get_config() -> ConfigDict:
    """The stage's defaults are the authors'; here stand their optimizer and the data set."""
    config = default_config("inenet")
    config.data.name = "modelnet40"
    config.train.weight_decay = 0.01
    config.train.schedule = "constant"
    config.train.warmup_epochs = 0.0
    config.train.clip_norm = 5.0
    return config
