"""The numbers that fix the architecture: they travel with the parameters."""

from dataclasses import dataclass

from dbdnet_jax.networks.blocks import Layers
from dbdnet_jax.ops.local_geometry import FEATURES, RADII


@dataclass(frozen=True)
class ModelConfig:
    """The released configuration of the paper's network, with our reading of the paper.

    ``released=True`` follows the authors' code where it departs from the paper, so that their
    weights give their numbers; each departure is marked at its line.
    """

    overlap_channels: int = 64  # encoder width at the finest level; its feature is 4 x as wide
    overlap_blocks: int = 4
    overlap_matching: bool = False  # whether the overlap head sees soft matches: not in the paper
    registration_channels: int = 32
    shared_blocks: int = 3
    rotation_blocks: int = 3
    translation_blocks: int = 3
    heads: int = 4
    dropout: float = 0.1  # of attention weights, in training only
    head_width: int = 512  # of the overlap decoder's first layer
    parameter_width: int = 1024  # of the parameter network's global feature
    neighbours: int = 20  # k of every neighbour search
    neighbour_space: str = "feature"  # or "coordinates": one search per level, shared
    overlap_passes: int = 1  # more: again over the clouds as the last one's answer aligns them
    overlap_points: int = 0  # that the overlap network sees, farthest first; 0: all
    registration_points: int = 0  # of the selected ones, that are matched; 0: all
    local_geometry: int = 0  # radii at which the encoders see the surface around a point
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
        for name in ("head_width", "parameter_width"):
            if getattr(self, name) < 128 or getattr(self, name) % 128:
                raise ValueError(
                    f"{name} must be a positive multiple of 128 (its layers halve it, and their "
                    f"group norms have up to 16 groups); got {getattr(self, name)}. Use 128."
                )
        if self.overlap_passes > 1 and not self.overlap_matching:
            raise ValueError(
                "overlap_passes must be 1 without overlap_matching, whose matches give the motion "
                "between passes while the overlap network is trained alone; got "
                f"{self.overlap_passes}. Set overlap_matching=True."
            )
        counts = ("overlap_passes", "iterations", "sinkhorn_iterations", "neighbours", "min_points")
        for name in (*counts, "heads"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} must be at least 1; got {getattr(self, name)}.")
        for name in ("overlap_points", "registration_points"):
            points = getattr(self, name)
            if points < 0 or (points and self.released):
                raise ValueError(
                    f"{name} must be 0 (all points) or positive, and 0 where released=True (the "
                    f"released network has no such limit); got {points}, released="
                    f"{self.released}. Use 0."
                )
        if not 0 <= self.local_geometry <= len(RADII) or (self.local_geometry and self.released):
            raise ValueError(
                f"local_geometry must be from 0 to {len(RADII)} radii, and 0 where released=True "
                f"(the released network has no such input); got {self.local_geometry}, released="
                f"{self.released}. Use 0."
            )
        if self.overlap_matching and self.released:
            raise ValueError(
                "overlap_matching must be False where released=True: the released network has no "
                "such part; got True. Set one of the two to False."
            )
        if not 0.0 <= self.dropout < 1.0:
            raise ValueError(f"dropout must be in [0, 1); got {self.dropout}.")

    @property
    def inputs(self) -> int:
        """What an encoder is given of each point: coordinates and local geometry."""
        return 3 + FEATURES * self.local_geometry

    @property
    def solves(self) -> int:
        """How often `register` solves for the motion."""
        return self.overlap_passes * self.iterations

    @property
    def head_layers(self) -> Layers:
        """The overlap decoder's layers."""
        width = self.head_width
        return (width, 8), (width // 2, 8), (width // 4, 4)

    @property
    def point_layers(self) -> Layers:
        """The parameter network's layers for every point, before its maximum."""
        return (64, 8), (64, 8), (64, 8), (128, 8), (self.parameter_width, 16)

    @property
    def global_layers(self) -> Layers:
        """The parameter network's layers after its maximum."""
        width = self.parameter_width
        return (width // 2, 16), (width // 4, 16), (width // 8, 8)
