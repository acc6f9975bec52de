"""A first look: the CAD configuration trained for a few minutes on two cores.

    python train.py --config=configs/cad_short.py

About 20 minutes of CPU time with compilation and the table. The overlap network has not learned
more than "all points overlap" by then, and the table says so.
"""

from ml_collections import ConfigDict

from configs import cad


def get_config() -> ConfigDict:
    """The differences from the full CAD training."""
    config = cad.get_config()
    config.train.ema_decay = 0.99  # a memory of a hundred steps, of the few thousand there are
    config.train.warmup_epochs = 0.25
    config.train.log_every = 50
    config.train.validate_every = 500
    config.train.checkpoint_every = 500
    config.overlap.epochs = 2.0
    config.registration.epochs = 4.0
    return config
