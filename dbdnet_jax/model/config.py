"""The numbers that fix the architecture: they travel with the parameters."""

from dataclasses import dataclass


@dataclass(frozen=True)
class ModelConfig:
    """The released configuration of the paper's network, with our reading of the paper.

    ``released=True`` follows the authors' code where it departs from the paper, so that their
    weights give their numbers; each departure is marked at its line.
    """

    overlap_channels: int = 64  # encoder width at the finest level; its feature is 4 x as wide
    overlap_blocks: int = 4
    registration_channels: int = 32
    shared_blocks: int = 3
    rotation_blocks: int = 3
    translation_blocks: int = 3
    heads: int = 4
    dropout: float = 0.1  # of attention weights, in training only
    neighbours: int = 20  # k of every neighbour search
    neighbour_space: str = "feature"  # or "coordinates": one search per level, shared
    overlap_threshold: float = 0.5
    min_points: int = 160  # the most probable rows kept when fewer pass the threshold
    iterations: int = 1
    sinkhorn_iterations: int = 5
    released: bool = False

    def __post_init__(self):
        """Refuse what cannot be built."""
        if self.neighbour_space not in ("feature", "coordinates"):
            raise ValueError(
                "neighbour_space must be 'feature' or 'coordinates'; "
                f"got {self.neighbour_space!r}. Use one of the two."
            )
        for name in ("overlap_channels", "registration_channels"):
            channels = getattr(self, name)
            if channels < 4 or channels % 4:
                raise ValueError(
                    f"{name} must be a positive multiple of 4 (its group norms have 4 groups); "
                    f"got {channels}. Use {max(4, round(channels / 4) * 4)}."
                )
            if channels * 4 % self.heads:
                raise ValueError(
                    f"heads must divide 4 * {name} = {4 * channels}; got {self.heads}. "
                    "Change one of the two."
                )
        for name in ("neighbours", "min_points", "iterations", "sinkhorn_iterations", "heads"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} must be at least 1; got {getattr(self, name)}.")
        if not 0.0 <= self.dropout < 1.0:
            raise ValueError(f"dropout must be in [0, 1); got {self.dropout}.")
