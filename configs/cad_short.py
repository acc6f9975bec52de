"""A first look: the CAD configuration trained for a few minutes on two cores.

    python train.py --config=configs/cad_short.py

Seven minutes on two cores, compilation and the table included. Expected on the noisy test pairs:
Error R 23.2 degrees, Error t 0.391 (untrained 43.8 and 0.701); refined 11.2 and 0.222. The overlap
network has hardly learned more than "all points overlap" by then (accuracy 0.786, F1 0.872), and
the table says so.
"""

from ml_collections import ConfigDict

from configs import cad


def get_config() -> ConfigDict:
    """The differences from the full CAD training."""
    config = cad.get_config()
    config.model.local_geometry = 0  # coordinates only: it is the step that costs here
    config.train.ema_decay = 0.99  # a memory of a hundred steps, of the few thousand there are
    config.train.warmup_epochs = 0.25
    config.train.log_every = 50
    config.train.validate_every = 500
    config.train.checkpoint_every = 500
    config.overlap.epochs = 2.0
    config.registration.epochs = 4.0
    config.joint.epochs = 1.0
    return config
