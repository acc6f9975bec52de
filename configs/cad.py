"""A network that a CPU can train, on the CAD shapes inside the package.

    python train.py --config=configs/cad.py

50 + 50 epochs of 642 shapes, 32,100 pairs for each network at about 55 ms of one core
(`benchmarks.step`): three quarters of an hour on two cores. The weights in the package were
trained longer and on more kinds of pairs (configs/cad_long.py). From fresh weights this schedule
has not been run to its end. Then `--stage=joint` trains both together, 8 epochs at two to three
times that a pair.
"""

from ml_collections import ConfigDict

from configs import modelnet


def get_config() -> ConfigDict:
    """The differences from the paper's ModelNet40 settings."""
    config = modelnet.get_config()
    config.model.overlap_channels = 16
    config.model.overlap_blocks = 2
    config.model.overlap_matching = True
    config.model.overlap_passes = 3
    config.model.overlap_points = 256
    config.model.registration_channels = 16
    config.model.registration_points = 256
    config.model.shared_blocks = 1
    config.model.rotation_blocks = 1
    config.model.translation_blocks = 1
    config.model.heads = 2
    config.model.head_width = 128  # twice the feature, as in the paper
    config.model.parameter_width = 256
    config.model.neighbours = 16
    config.model.neighbour_space = "coordinates"  # one search per level instead of ten
    config.model.dropout = 0.0  # too small to overfit pairs that never repeat
    config.model.min_points = 64
    config.model.local_geometry = 5  # all radii: each point knows the surface around it

    config.data.name = "cad"
    config.train.batch_size = 2  # learns more from as many pairs than 8
    config.train.learning_rate = 1e-3
    config.train.clip_norm = 1.0
    config.train.ema_decay = 0.998
    config.train.warmup_epochs = 1.0
    config.train.log_every = 100
    config.train.validate_every = 1000
    config.train.checkpoint_every = 1000
    config.train.validation_pairs = 97
    config.overlap.epochs = 50.0
    config.overlap.gamma = 0.0
    config.registration.epochs = 50.0
    config.registration.masks = "perturbed"
    config.joint.epochs = 8.0
    config.joint.learning_rate = 3e-4  # both are near the end of what they can learn apart
    return config
