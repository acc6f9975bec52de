"""The page about one alignment."""

from collections.abc import Iterator

import numpy as np
from jaxtyping import Float

from dbdnet_jax.alignment.align import Alignment
from dbdnet_jax.alignment.quality import written
from dbdnet_jax.drawing import figures
from dbdnet_jax.drawing.page import Markup, card, grid, page, plot, table, tag
from dbdnet_jax.drawing.selection import DrawnPair, select_points
from dbdnet_jax.drawing.style import SOURCE, TARGET

Points = Float[np.ndarray, "n 3"]
OtherPoints = Float[np.ndarray, "m 3"]


def alignment_page(
    alignment: Alignment,
    source: Points,
    target: OtherPoints,
    *,
    names: tuple[str, str] = ("source", "target"),
    command: str = "",
) -> bytes:
    """A self-contained HTML file: the verdict, the clouds before and after, and the numbers.

    ``names`` are the clouds' files, ``command`` what made the alignment; both may be any text.
    """
    drawn = select_points(alignment, source, target)
    return page(
        f"{names[0]} onto {names[1]}: {alignment.verdict}",
        tag(
            "header",
            tag("h1", alignment.verdict.capitalize()),
            tag("p", alignment.reason or f"{names[0]} was brought onto {names[1]}."),
            css="good" if alignment.valid else "bad",
        ),
        _tiles(alignment),
        *([card("Warnings", _list(alignment.warnings))] if alignment.warnings else []),
        grid(
            *_plots(alignment, drawn),
            tag(
                "div",
                card("Transform", *_transform(alignment)),
                card("Clouds", *_clouds(names, (source, target), drawn)),
                css="stack",
            ),
        ),
        card("Command", tag("pre", command, css="wrap")) if command else "",
    )


def _tiles(alignment: Alignment) -> Markup:
    """The few numbers to look at first."""
    within = f"of the source lies within {alignment.inlier_distance:.3g} of the target"
    tiles = (
        (f"{alignment.success_probability:.1%}", "probability that the rotation is right to 5°"),
        (f"{alignment.inlier_ratio:.1%}", within),
        (_number(alignment.rmse), "root mean square distance of these inliers"),
        _turn(alignment),
    )
    return tag(
        "div",
        *(tag("div", tag("b", n), tag("span", text), css="card tile") for n, text in tiles),
        css="tiles",
    )


def _turn(alignment: Alignment) -> tuple[str, str]:
    """Angle and axis of the rotation."""
    from scipy.spatial.transform import Rotation

    if not np.isfinite(alignment.rotation).all():
        return "none", "rotation: the pose is not finite"
    vector = Rotation.from_matrix(alignment.rotation).as_rotvec(degrees=True)
    angle = float(np.linalg.norm(vector))
    return f"{angle:.3g}°", f"rotation, about {written(vector / max(angle, 1e-12))}"


def _plots(alignment: Alignment, drawn: DrawnPair) -> Iterator[Markup]:
    """The figures, each in its card."""
    together = "The clouds as given."
    if drawn.apart:
        together = "The clouds lie too far apart for one picture: each is about its own middle."
    shown, held = len(drawn.match), len(alignment.matches.confidence)
    near = f"{alignment.inlier_distance:.3g}"
    yield plot("Before", together, figures.two_clouds(drawn.before, drawn.target))
    moved = "The source as moved by the transform."
    yield plot("After", moved, figures.two_clouds(drawn.after, drawn.target))
    dark = "After; the dark points are likely to have a counterpart in the other cloud."
    yield plot("Overlap", dark, figures.overlap(drawn))
    lines = (
        f"The {shown} most confident of the network's {held} matches, the aligned source moved "
        f"aside. Those agree whose ends the transform brings within {near}."
    )
    yield plot("Matches", lines if held else "There are none.", figures.matches(drawn))
    far = "Of the moved source from the target; what lies outside the overlap is far."
    yield plot("Residuals", far, figures.residuals(drawn, alignment.inlier_distance))


def _transform(alignment: Alignment) -> Iterator[Markup]:
    """The matrix, and where the time went."""
    rows = [" ".join(f"{x:13.7g}" for x in row) for row in alignment.transform]
    yield tag("p", "target ~ T source, in the clouds' own unit; T =")
    yield tag("pre", "\n".join(rows))
    laps = alignment.timings
    yield tag("p", f"Found in {sum(laps.values()):.2f} s:")
    yield table(laps, [[f"{lap:.2f}" for lap in laps.values()]])


def _clouds(
    names: tuple[str, str], clouds: tuple[Points, OtherPoints], drawn: DrawnPair
) -> Iterator[Markup]:
    """Files and sizes, and how many of the points are drawn."""
    sides = (("source", SOURCE, drawn.after), ("target", TARGET, drawn.target))
    body = [
        (
            Markup(f'<span class="swatch" style="background:{colour}"></span>{role}'),
            name,
            f"{len(points):,}",
            f"{len(drawn):,}",
            " × ".join(f"{x:.3g}" for x in np.ptp(points, axis=0)),
        )
        for (role, colour, drawn), name, points in zip(sides, names, clouds, strict=True)
    ]
    yield table(("cloud", "file", "points", "drawn", "extent in x, y, z"), body, css="names")
    origin = ", ".join(f"{x:.6g}" for x in drawn.origin)
    yield tag(
        "p",
        "Drawn are the points that the pose was judged on: all of a small cloud, an even choice "
        f"of a large one, and none far from the rest. The axes start at ({origin}).",
    )


def _list(lines: tuple[str, ...]) -> Markup:
    return tag("ul", *(tag("li", line) for line in lines))


def _number(value: float) -> str:
    return f"{value:.3g}" if np.isfinite(value) else "none"
