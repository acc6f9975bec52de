"""Which shapes or scans a configuration trains and tests on."""

import dataclasses

from dbdnet_jax.data.mixture import Mixture

DATA_SETS = ("cad", "modelnet40", "threedmatch")


@dataclasses.dataclass(frozen=True)
class DataConfig:
    """Which shapes or scans: ``folder`` is where the downloaded sets stand ("" for "cad")."""

    name: str = "cad"
    folder: str = ""
    categories: str = "all"  # "all", or one half of the shape classes: "seen" or "unseen"
    procedural: int = 0  # generated shapes to train on beside those of "cad": 15 ms each
    augment: float = 0.0  # share of the training pairs under other conditions than the protocol's
    mixture: Mixture = Mixture()  # shares of pairs as the world is; ``augment`` is of the others

    def __post_init__(self) -> None:
        """Refuse an unknown data set."""
        if self.name not in DATA_SETS:
            raise ValueError(
                f"config.data.name must be one of {DATA_SETS}; got {self.name!r}. Choose one."
            )
        if self.procedural < 0 or (self.procedural and self.name != "cad"):
            raise ValueError(
                "config.data.procedural must not be negative, and 0 for other data than 'cad'; got "
                f"{self.procedural} for {self.name!r}. Use 0."
            )
        if not 0 <= self.augment <= 1 or (self.augment and self.name == "threedmatch"):
            raise ValueError(
                "config.data.augment must be in [0, 1], and 0 for 'threedmatch', whose pairs are "
                f"read; got {self.augment} for {self.name!r}. Use 0."
            )
        if self.mixture.total and self.name == "threedmatch":
            raise ValueError(
                "config.data.mixture must be 0 for 'threedmatch', whose pairs are read; got "
                f"{self.mixture}. Set its shares to 0."
            )
