"""The paper's settings on 3DMatch: indoor scans in metres, read from Predator's folder.

    python train.py --config=configs/threedmatch.py --config.data.folder=/path/indoor

A GPU's task: 150 + 50 epochs of 20,642 pairs. The paper reports, on 2048 points, a mean rotation
error of 8.894 degrees and a mean translation error of 0.570.
"""

from ml_collections import ConfigDict

from configs import modelnet


def get_config() -> ConfigDict:
    """The differences from ModelNet40; of the protocol only points and radius are of use here."""
    config = modelnet.get_config()
    config.data.name = "threedmatch"
    config.protocol.points = 2048
    config.protocol.overlap_radius = 0.0375  # metres
    config.overlap.epochs = 150.0
    config.overlap.batch_size = 2
    config.registration.epochs = 50.0
    config.registration.batch_size = 1
    config.registration.weights.rotation = 5.0
    config.joint.epochs = 10.0  # not of the paper
    config.joint.batch_size = 1
    return config
