"""The network's multiply-adds in their cheapest equal form, counted from a configuration.

Counted are the products that no formulation of the same network avoids: dense layers (once for
each point where they commute with what follows), second layers of EdgeConv on every edge,
attention, distances between all points, interpolation. Not counted: farthest-point sampling, the
choice of neighbours, norms, exponentials, Sinkhorn's sums. A multiply-add is two operations.
"""

from itertools import pairwise

from dbdnet_jax.networks.dbdnet.config import ModelConfig
from dbdnet_jax.networks.dbdnet.dgcnn import WIDTHS
from dbdnet_jax.networks.dbdnet.matching import FIT_FEATURES
from dbdnet_jax.ops.pyramid import LEVELS

Layers = tuple[tuple[int, int], ...]


def register(config: ModelConfig, points: int) -> dict[str, int]:
    """Multiply-adds of `dbdnet.register` on two clouds of ``points``, by part.

    Every selected point is taken to enter the registration, as in the program's static shapes.
    """
    parts = overlap(config, points) if config.overlap == "prior" else {}
    for name, count in registration(config, points).items():
        parts[name] = parts.get(name, 0) + config.iterations * count
    return {name: config.overlap_passes * count for name, count in parts.items()}


def overlap(config: ModelConfig, points: int) -> dict[str, int]:
    """One pass of the overlap network on two clouds."""
    n, width = min(points, config.overlap_points or points), 4 * config.overlap_channels
    fan_in, matching = width, 0
    if config.overlap_matching:
        fan_in += FIT_FEATURES
        # Distances of features, those of points, and the soft targets: once for the motion and
        # once for each cloud's features.
        matching = n * n * width + n * n * 3 * 4
    return {
        "encoder": 2 * encoder(config.overlap_channels, n, config),
        "attention": config.overlap_blocks * attention_block(width, n),
        "matching": matching,
        "head": head(config, fan_in, width, n),
    }


def head(config: ModelConfig, fan_in: int, width: int, rows: int) -> int:
    """The overlap decoder on two clouds; what is pooled of the other one is the same for all."""
    (first, _), *_ = config.head_layers
    return 2 * (width * first + rows * (dense(fan_in, config.head_layers) + config.head_width // 4))


def registration(config: ModelConfig, points: int) -> dict[str, int]:
    """One iteration of the registration network on two clouds."""
    n, width = min(points, config.registration_points or points), 4 * config.registration_channels
    blocks = config.shared_blocks + config.rotation_blocks
    blocks += config.translation_blocks if config.branches == 2 else 0
    last = config.global_layers[-1][0]
    return {
        "encoder": 2 * encoder(config.registration_channels, n, config),
        "attention": blocks * attention_block(width, n),
        "matching": config.branches * n * n * (width + 3),
        "head": head(config, width, width, n) if config.overlap == "joint" else 0,
        "parameters": 2 * n * dense(4, config.point_layers)
        + dense(config.parameter_width, config.global_layers)
        + 2 * config.branches * last,
    }


def encoder(channels: int, points: int, config: ModelConfig) -> int:
    """The encoder of one cloud."""
    if config.encoder == "dgcnn":
        return dgcnn(channels, points, config)
    widths = [channels << level for level in range(LEVELS)]
    rows = [points >> level for level in range(LEVELS)]
    total = 0
    for stage in range(1, LEVELS + 1):
        for level in range(stage):
            fan_in = widths[level] if stage > 1 else 3
            total += edge_conv(fan_in, widths[level], rows[level], config.neighbours)
            if config.neighbour_space == "feature":
                total += rows[level] ** 2 * fan_in
        for level in range(min(stage + 1, LEVELS)):
            for other in (i for i in range(stage) if i != level):
                # Transition-down takes its maximum over all points of the finer level.
                down = rows[other] if (other, level) == (stage - 1, stage) else rows[level]
                total += min(down, rows[other]) * widths[other] * widths[level]
                if other > level:
                    total += 3 * rows[level] * widths[level]  # interpolation
    for level in range(LEVELS):
        total += rows[level] * (LEVELS + 1 - level) * widths[level] ** 2  # what is fused
        total += 3 * rows[level] ** 2  # distances of coordinates
        total += sum(3 * rows[level] * coarse for coarse in rows[level + 1 :])
        if level:  # onto the finest level
            total += rows[level] * widths[level] * channels + 3 * rows[0] * channels
    return total


def dgcnn(channels: int, points: int, config: ModelConfig) -> int:
    """The ablation's encoder of one cloud."""
    total, fan_in = 3 * points**2, 3
    for width in (channels * part for part in WIDTHS):
        total += edge_conv(fan_in, width, points, config.neighbours)
        total += points**2 * fan_in if config.neighbour_space == "feature" else 0
        fan_in = width
    return total + points * sum(WIDTHS) * 4 * channels**2


def edge_conv(fan_in: int, width: int, rows: int, neighbours: int) -> int:
    """Two layers, the first once for each point and once for its own part."""
    return rows * (2 * fan_in * width + neighbours * width**2)


def attention_block(width: int, rows: int) -> int:
    """Self- and cross-attention of two clouds."""
    return 4 * (4 * rows * width**2 + 2 * rows**2 * width)


def dense(fan_in: int, layers: Layers) -> int:
    """Dense layers on one row."""
    widths = [fan_in, *(features for features, _ in layers)]
    return sum(a * b for a, b in pairwise(widths))
