"""What the DBDNet paper reports (Li, Zhu & Xie 2024), as far as it is known here.

RMSE and MAE over Euler angles in degrees and over translation components, then mean Error R and
Error t, on ModelNet40 at 70 % of each cloud; None where a figure is not known here.
"""

from collections.abc import Mapping, Sequence

Figures = Sequence[float | None]

UNSEEN_SHAPES = "Unseen shapes"
UNSEEN_CATEGORIES = "Unseen categories"
UNSEEN_SHAPES_NOISE = "Unseen shapes, noise"
UNSEEN_CATEGORIES_NOISE = "Unseen categories, noise"
SCANS = "3DMatch"

POSES: Mapping[str, Mapping[str, Figures]] = {
    UNSEEN_SHAPES: {"DBDNet": (None, None, None, None, 4.203, 0.080)},
    UNSEEN_CATEGORIES: {"DBDNet": (None, None, None, None, 4.541, 0.084)},
    UNSEEN_SHAPES_NOISE: {"DBDNet": (None, None, None, None, 4.612, 0.085)},
    UNSEEN_CATEGORIES_NOISE: {
        "ICP": (27.849, 0.383, 16.341, 0.234, 32.175, 0.484),
        "FGR, true normals": (38.140, 0.302, 12.739, 0.102, 20.569, 0.218),
        "DCP": (16.532, 0.249, 12.022, 0.181, 23.184, 0.366),
        "OMNet": (10.500, 0.163, 4.661, 0.078, 9.472, 0.162),
        "RIENet": (71.543, 0.691, 52.410, 0.505, 89.260, 1.016),
        "FINet": (9.001, 0.120, 3.827, 0.055, 7.748, 0.117),
        "DBDNet": (6.934, 0.093, 2.368, 0.042, 4.905, 0.088),
    },
    SCANS: {
        "ICP": (None, None, None, None, 37.1, 1.07),
        "FGR, estimated normals": (None, None, None, None, 43.0, 1.14),
        "DBDNet": (None, None, None, None, 8.894, 0.570),
    },
}
# Accuracy, precision, recall and F1 on unseen shapes with noise.
OVERLAP: Mapping[str, Figures] = {
    "MaskNet": (None, None, None, 0.8786),
    "INENet": (None, None, None, 0.9001),
    "DBDNet": (0.9698, 0.9784, 0.9833, 0.9808),
}
# Error R and Error t on unseen shapes with noise, by the ablation's step.
ABLATION: Mapping[str, Figures] = {
    "1 DGCNN encoder": (6.716, 0.181),
    "2 multi-resolution encoder": (6.249, 0.180),
    "3 joint overlap": (6.350, 0.134),
    "4 prior overlap": (5.138, 0.100),
    "5 dual branches": (4.612, 0.085),
}
