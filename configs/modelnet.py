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


def get_config() -> ConfigDict:
    """Everything a run needs; the other configurations state their differences from this one."""
    config = ConfigDict()
    config.model = _model()
    config.data = ConfigDict(
        {
            "name": "modelnet40",
            "folder": "",
            "categories": "all",
            "procedural": 0,
            "varied": 0.0,
            "mixture": {
                "low_overlap": 0.0,
                "views": 0.0,
                "standing": 0.0,
                "cluttered": 0.0,
                "rooms": 0.0,
                "turned": 0.0,
            },
        }
    )
    config.protocol = ConfigDict(
        {
            "points": 1024,
            "keep": 0.7,
            "max_angle_deg": 45.0,
            "max_translation": 1.0,
            "noise_sigma": 0.01,
            "noise_clip": 0.05,
            "disjoint": False,
            "overlap_radius": 0.1,
        }
    )
    train = config.train = _train()
    config.overlap = ConfigDict(
        {
            "epochs": 300.0,
            "batch_size": train.get_oneway_ref("batch_size"),
            "learning_rate": train.get_oneway_ref("learning_rate"),
            "gamma": 4.0,
        }
    )
    config.registration = ConfigDict(
        {
            "epochs": 300.0,
            "batch_size": train.get_oneway_ref("batch_size"),
            "learning_rate": train.get_oneway_ref("learning_rate"),
            "masks": "predicted",
            "weights": {
                "correspondence": 5.0,
                "rotation": 1.0,
                "translation": 1.0,
                "distance": 1.0,
            },
        }
    )
    config.joint = ConfigDict(
        {
            "epochs": 30.0,
            "batch_size": train.get_oneway_ref("batch_size"),
            "learning_rate": train.get_oneway_ref("learning_rate"),
        }
    )
    return config.lock()


def _model() -> ConfigDict:
    """The released architecture."""
    return ConfigDict(
        {
            "overlap_channels": 64,
            "overlap_blocks": 4,
            "overlap_matching": False,
            "registration_channels": 32,
            "shared_blocks": 3,
            "rotation_blocks": 3,
            "translation_blocks": 3,
            "heads": 4,
            "dropout": 0.1,
            "head_width": 512,
            "parameter_width": 1024,
            "neighbours": 20,
            "neighbour_space": "feature",
            "overlap_passes": 1,
            "overlap_points": 0,  # 0: all
            "registration_points": 0,
            "local_geometry": 0,  # radii at which the surface around a point is seen
            "overlap_threshold": 0.5,
            "min_points": 160,
            "iterations": 1,
            "sinkhorn_iterations": 5,
            "released": False,
        }
    )


def _train() -> ConfigDict:
    """What all stages share."""
    return ConfigDict(
        {
            "seed": 0,
            "start": "",  # a file of weights to go on from
            "batch_size": 8,
            "learning_rate": 1e-4,
            "weight_decay": 1e-4,
            "warmup_epochs": 5.0,
            "clip_norm": 0.0,  # 0: none
            "ema_decay": 0.0,  # 0: none
            "log_every": 20,
            "validate_every": 1000,
            "checkpoint_every": 200,
            "validation_pairs": 200,
            "devices": 0,  # on a CPU; 0: one for each core
            "decay_epochs": 0.0,  # 0: a cosine over all epochs
        }
    )
