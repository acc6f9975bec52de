"""A first look: the CAD configuration trained for a few minutes on two cores.

    python train.py --config=configs/cad_short.py

Seven minutes on two cores, compilation and the table included. Expected on the noisy test pairs:
Error R 24.0 degrees, Error t 0.398 (untrained 39.6 and 0.622); polished 14.1 and 0.261. The overlap
network has hardly learned more than "all points overlap" by then (accuracy 0.784, F1 0.871), and
the table says so.
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
