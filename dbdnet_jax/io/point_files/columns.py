"""Which of some named columns are coordinates: one answer for text, arrays and PCD fields."""

import re
from collections.abc import Sequence

# Words that may stand beside the letter of an axis and say nothing else.
PLAIN = set(
    """m mm cm dm km um ft in inch inches feet foot meter meters metre metres us coord coords
    coordinate coordinates pos position positions point points p pt pts loc location xyz vertex
    vertices utm local global world map lidar cartesian scan axis value""".split()
)
OTHER = set(
    """n norm normal normals v vel velocity acc accel std sigma sd err error errors accuracy
    precision color colour rot rotation q quat dir direction size gradient flow disp displacement
    gyro force residual variance cov eigen view viewpoint sensor origin tangent""".split()
)
ANGLES = {"lat", "latitude", "lon", "long", "lng", "longitude", "theta", "phi", "azimuth"}
AXES = {
    **dict(zip("xyz", range(3), strict=True)),
    **dict.fromkeys(("easting", "east", "eastings", "rechtswert", "ostwert"), 0),
    **dict.fromkeys(("northing", "north", "northings", "hochwert", "nordwert"), 1),
    **dict.fromkeys(("elevation", "elev", "height", "altitude", "alt", "höhe", "hoehe"), 2),
}
SHORT = {"e": 0, "n": 1, "h": 2}
COUNTED = set(
    """points point position positions pos coord coords xyz coordinate coordinates
    vertex vertices""".split()
)


def find_xyz(names: Sequence[str]) -> tuple[int, int, int] | None:
    """Positions of x, y and z among column names; None where no three are.

    Raises:
      ValueError: several threes, or angles where lengths are wanted; ends in a fix.
    """
    words = [_words(name) for name in names]
    families: dict[str, dict[int, list[int]]] = {}
    for i, (name, parts) in enumerate(zip(names, words, strict=True)):
        for family, axis in _roles(name, parts):
            families.setdefault(family, {}).setdefault(axis, []).append(i)
    whole = {f: axes for f, axes in families.items() if set(axes) == {0, 1, 2}}
    for kind in ("exact", "plain", "other", "level"):  # level: x, y and a height
        chosen = [axes for family, axes in whole.items() if family.startswith(kind)]
        if not chosen:
            continue
        if len(chosen) > 1 or any(len(where) > 1 for where in chosen[0].values()):
            raise ValueError(
                f"several of its columns may be x, y, z: {_shown(names)}. Name the three to use "
                "x, y, z, or keep only these."
            )
        x, y, z = (chosen[0][axis][0] for axis in range(3))
        return x, y, z
    if len(ANGLES.intersection(part for parts in words for part in parts)) > 1:
        raise ValueError(
            f"its columns are angles, not lengths: {_shown(names)}. Convert them to x, y, z."
        )
    return None


def _shown(names: Sequence[str]) -> str:
    return repr(", ".join(names))[:200]


def _words(name: str) -> list[str]:
    """``X(mm)``, ``Points:0`` and ``posX`` as lower-case words and numbers."""
    name = re.sub(r"([a-z])([XYZ])(?![A-Za-z])", r"\1 \2", name.strip())
    name = re.sub(r"(?<![A-Za-z])([XYZxyz])(?=[Cc]oord|[Pp]os)", r"\1 ", name)
    name = re.sub(r"(coord|pos)([xyz])(?![a-z])", r"\1 \2", name.lower())
    return re.findall(r"[^\W\d_]+|\d+", name)


def _roles(name: str, words: list[str]) -> list[tuple[str, int]]:
    """Families of three that a column may belong to, and its axis in them."""
    bare = name.strip(" \"'").lower()
    if bare in ("x", "y", "z"):
        mixed = [("plain surveyed", 2), ("plain short", 2)]
        return [("exact", AXES[bare]), *(mixed if bare == "z" else [("level", AXES[bare])])]
    places = [i for i, word in enumerate(words) if word in AXES]
    if len(places) == 1:
        word, rest = words[places[0]], [*words[: places[0]], *words[places[0] + 1 :]]
        if OTHER.intersection(rest):
            return []
        surveyed = [] if word in "xy" else [("plain surveyed", AXES[word])]
        if word not in "xyz":
            return [*surveyed, *([("level", 2)] if AXES[word] == 2 else [])]
        kind = "other" if set(rest) - PLAIN else "plain"
        level = [("level", AXES[word])] if kind == "plain" and word != "z" else []
        return [(f"{kind} {' '.join(rest)}", AXES[word]), *surveyed, *level]
    if len(words) == 1 and words[0] in SHORT:
        level = [("level", 2)] if words[0] == "h" else []
        return [("plain short", SHORT[words[0]]), *level]
    if len(words) == 2 and words[0] in COUNTED and words[1] in "0123":
        number = int(words[1])
        return [
            (f"plain {words[0]} from {first}", number - first)
            for first in (0, 1)
            if 0 <= number - first < 3
        ]
    return []
