"""DCP-v2 with its authors' settings, on ModelNet40 under the DBDNet paper's protocol.

    python train.py --config=configs/peers/dcp.py --config.data.folder=/data/modelnet40

A GPU's task: 250 epochs of batch 32, Adam at 1e-3 with an L2 term of 1e-4, a tenth after 75, 150
and 200 epochs. The authors train on whole clouds and angles of 0 to 45 degrees; here both clouds
are partial. They choose the best epoch by the test loss, we by that of held-out training shapes.
``--config.model.pointer=identity`` is DCP-v1.
"""

from ml_collections import ConfigDict

from dbdnet_jax.training.config import default_config


def get_config() -> ConfigDict:
    """The stage's defaults are the authors'; here stand their optimizer and the data set."""
    config = default_config("dcp")
    config.data.name = "modelnet40"
    config.train.optimizer = "adam"
    config.train.weight_decay = 1e-4
    config.train.schedule = "steps"
    config.train.milestones = (75.0, 150.0, 200.0)
    config.train.warmup_epochs = 0.0
    return config
