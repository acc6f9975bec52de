"""The numbers that fix the architecture: they travel with the parameters."""

from dataclasses import dataclass, fields

from dbdnet_jax.networks.blocks import Layers
from dbdnet_jax.ops.local_geometry import FEATURES, RADII

# What a field may be, both ends included. The upper ends are far above what has been of use and
# below what takes a machine: a file's header may ask for anything.
_BOUNDS: dict[str, tuple[float, float]] = {
    "overlap_channels": (4, 1024),  # 16 times the paper's: weights of ten gigabytes
    "overlap_blocks": (0, 64),  # the paper's is 4; every block is traced and compiled on its own
    "registration_channels": (4, 1024),
    "branches": (1, 2),
    "shared_blocks": (0, 64),
    "rotation_blocks": (0, 64),
    "translation_blocks": (0, 64),
    "heads": (1, 4096),  # one for each channel of the widest feature
    "dropout": (0.0, 0.99),  # at 1 nothing would be left to learn from
    "head_width": (128, 8192),
    "parameter_width": (128, 8192),
    "neighbours": (1, 1024),  # every point keeps an array of so many
    "overlap_passes": (1, 64),  # each takes as long as the first
    "overlap_points": (0, 2**20),  # the matches of so many are a matrix of 4 terabytes
    "registration_points": (0, 2**20),
    "local_geometry": (0, len(RADII)),
    "overlap_threshold": (0.0, 1.0),
    "min_points": (1, 2**20),
    "iterations": (1, 64),
    "sinkhorn_iterations": (1, 1024),
}
# What a field of text may be; the first is the paper's network.
_CHOICES = {
    "encoder": ("multiresolution", "dgcnn"),
    "overlap": ("prior", "joint", "none"),
    "neighbour_space": ("feature", "coordinates"),
}


@dataclass(frozen=True)
class ModelConfig:
    """The released configuration of the paper's network, with our reading of the paper.

    ``released=True`` follows the authors' code where it departs from the paper, so that their
    weights give their numbers; each departure is marked at its line.

    The first three fields take the paper's network apart, as its ablations do. A "prior" overlap
    is predicted by the overlap network before anything is matched; a "joint" one by the
    registration network, from the features that it matches all points by; with "none" all points
    are matched. A single branch, of the shared and the rotation blocks, gives rotation and
    translation in one solve.
    """

    encoder: str = "multiresolution"  # or "dgcnn": four layers on all points, of both networks
    branches: int = 2
    overlap: str = "prior"  # or "joint" or "none": then there is no overlap network
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
    iterations: int = 1  # of the registration network; more only where released
    sinkhorn_iterations: int = 5
    released: bool = False

    def __post_init__(self) -> None:
        """Refuse what cannot be built: types and bounds first, then what must fit together.

        Raises:
          ValueError: names the field, the rule and the value.
        """
        for field in fields(self):
            check_field(field.name, getattr(self, field.name), type(field.default))
        for name, choices in _CHOICES.items():
            if getattr(self, name) not in choices:
                raise ValueError(
                    f"{name} must be one of {choices}; got {getattr(self, name)!r}. Choose one."
                )
        self._check_widths()
        self._check_combinations()

    def _check_widths(self) -> None:
        for name in ("overlap_channels", "registration_channels"):
            channels = getattr(self, name)
            if channels % 4:
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
            if getattr(self, name) % 128:
                raise ValueError(
                    f"{name} must be a positive multiple of 128 (its layers halve it, and their "
                    f"group norms have up to 16 groups); got {getattr(self, name)}. Use 128."
                )

    def _check_combinations(self) -> None:
        if self.iterations > 1 and not self.released:
            raise ValueError(
                "iterations must be 1 unless released=True: outside the released network, "
                f"overlap_passes repeats both networks; got {self.iterations}. Use 1."
            )
        if self.overlap_passes > 1 and not self.overlap_matching:
            raise ValueError(
                "overlap_passes must be 1 without overlap_matching, whose matches give the motion "
                "between passes while the overlap network is trained alone; got "
                f"{self.overlap_passes}. Set overlap_matching=True."
            )
        for name in ("encoder", "branches", "overlap"):
            value, whole = getattr(self, name), getattr(ModelConfig, name)
            if self.released and value != whole:
                raise ValueError(
                    f"{name} must be {whole!r} where released=True: the released network is the "
                    f"paper's whole one; got {value!r}. Set one of the two otherwise."
                )
        for name in ("overlap_points", "registration_points", "local_geometry"):
            if getattr(self, name) and self.released:
                raise ValueError(
                    f"{name} must be 0 where released=True: the released network is given all "
                    f"points, by their coordinates alone; got {getattr(self, name)}. Use 0."
                )
        if self.overlap_matching and self.overlap != "prior":
            raise ValueError(
                "overlap_matching must be False unless overlap='prior': it is a part of the "
                f"overlap network; got True for {self.overlap!r}. Set it to False."
            )
        if self.overlap_matching and self.released:
            raise ValueError(
                "overlap_matching must be False where released=True: the released network has no "
                "such part; got True. Set one of the two to False."
            )

    @property
    def inputs(self) -> int:
        """What an encoder is given of each point: coordinates and local geometry."""
        return 3 + FEATURES * self.local_geometry

    @property
    def solves(self) -> int:
        """How often `register` solves for the motion."""
        return max(self.overlap_passes, self.iterations)

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


def check_field(name: str, value: object, kind: type) -> None:
    """Refuse a value of another type than its field's, and a number out of bounds, NaN included."""
    accepted = (int, float) if kind is float else kind
    if not isinstance(value, accepted) or (isinstance(value, bool) and kind is not bool):
        raise ValueError(
            f"{name} must be of type {kind.__name__}; got {value!r:.60} "
            f"({type(value).__name__}). Use {getattr(ModelConfig, name)!r}."
        )
    if name in _BOUNDS:
        low, high = _BOUNDS[name]
        if not low <= value <= high:  # type: ignore[operator]  # a number, by its type
            raise ValueError(
                f"{name} must be from {low} to {high}; got {value!r:.60}. Use "
                f"{getattr(ModelConfig, name)}."
            )
