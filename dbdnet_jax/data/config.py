"""Which shapes or scans a configuration trains and tests on."""

import dataclasses

from dbdnet_jax.data.cad import HALVES
from dbdnet_jax.data.mixture import Mixture

DATA_SETS = ("cad", "modelnet40", "threedmatch")
CATEGORIES = ("all", *HALVES)


@dataclasses.dataclass(frozen=True)
class DataConfig:
    """Which shapes or scans: ``folder`` is where the downloaded sets stand ("" for "cad")."""

    name: str = "cad"
    folder: str = ""
    categories: str = "all"  # "all", or one half of the shape classes: "seen" or "unseen"
    procedural: int = 0  # generated shapes to train on beside those of "cad": 15 ms each
    stretch: float = 1.0  # most by which training shapes are stretched along axes of any direction
    augment: float = 0.0  # share of the training pairs under other conditions than the protocol's
    mixture: Mixture = Mixture()  # shares of pairs as the world is; ``augment`` is of the others

    def __post_init__(self) -> None:
        """Refuse unknown choices, and what a data set has not."""
        for name, choices in (("name", DATA_SETS), ("categories", CATEGORIES)):
            if getattr(self, name) not in choices:
                raise ValueError(
                    f"config.data.{name} must be one of {choices}; got {getattr(self, name)!r}. "
                    "Choose one."
                )
        if self.folder and self.name == "cad":
            raise ValueError(
                "config.data.folder must be '' for 'cad', which is in the package; got "
                f"{self.folder!r}. Leave it out, or set config.data.name."
            )
        if self.categories != "all" and self.name == "threedmatch":
            raise ValueError(
                "config.data.categories must be 'all' for 'threedmatch', whose scans have none; "
                f"got {self.categories!r}. Use 'all'."
            )
        if self.procedural < 0 or (self.procedural and self.name != "cad"):
            raise ValueError(
                "config.data.procedural must not be negative, and 0 for other data than 'cad'; got "
                f"{self.procedural} for {self.name!r}. Use 0."
            )
        if not 1 <= self.stretch <= 4 or (self.stretch > 1 and self.name == "threedmatch"):
            raise ValueError(
                "config.data.stretch must be in [1, 4], and 1 for 'threedmatch', whose pairs are "
                f"read; got {self.stretch} for {self.name!r}. Use 1."
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

    def require_folder(self) -> None:
        """Refuse a downloaded data set that is to be read, but from nowhere.

        Raises:
            ValueError: names the field.
        """
        if self.name != "cad" and not self.folder:
            raise ValueError(
                f"config.data.folder must be where {self.name} stands; it is not set. Give "
                "--config.data.folder=PATH."
            )
