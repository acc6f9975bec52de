"""The page about one alignment."""

from typing import NamedTuple

import numpy as np

from dbdnet_jax.alignment.align import Alignment
from dbdnet_jax.alignment.quality import written
from dbdnet_jax.drawing import figures
from dbdnet_jax.drawing.page import Plot, render
from dbdnet_jax.drawing.selection import DrawnPair, select_points
from dbdnet_jax.drawing.style import SOURCE, TARGET
from dbdnet_jax.types import OtherPoints, Points


class CloudRow(NamedTuple):
    """A cloud's line in the table of clouds, as text."""

    role: str
    file: str
    colour: str
    points: str
    drawn: str
    extent: str


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
    return render(
        "alignment.html.jinja",
        alignment=alignment,
        tiles=_tiles(alignment),
        plots=_plots(alignment, drawn),
        matrix="\n".join(" ".join(f"{x:13.7g}" for x in row) for row in alignment.transform),
        laps=[f"{lap:.2f}" for lap in alignment.timings.values()],
        clouds=[
            _row("source", names[0], SOURCE, source, len(drawn.after)),
            _row("target", names[1], TARGET, target, len(drawn.target)),
        ],
        origin=", ".join(f"{x:.6g}" for x in drawn.origin),
        command=command,
    )


def _tiles(alignment: Alignment) -> list[tuple[str, str]]:
    """The few numbers to look at first, each with its words."""
    within = f"of the source lies within {alignment.inlier_distance:.3g} of the target"
    rmse = f"{alignment.rmse:.3g}" if np.isfinite(alignment.rmse) else "none"
    return [
        (f"{alignment.success_probability:.1%}", "probability of being right to 5° and 5 %"),
        (f"{alignment.inlier_ratio:.1%}", within),
        (rmse, "root mean square distance of these inliers"),
        _turn(alignment),
    ]


def _turn(alignment: Alignment) -> tuple[str, str]:
    """Angle and axis of the rotation."""
    from scipy.spatial.transform import Rotation

    if not np.isfinite(alignment.rotation).all():
        return "none", "rotation: the pose is not finite"
    vector = Rotation.from_matrix(alignment.rotation).as_rotvec(degrees=True)
    angle = float(np.linalg.norm(vector))
    return f"{angle:.3g}°", f"rotation, about {written(vector / max(angle, 1e-12))}"


def _plots(alignment: Alignment, drawn: DrawnPair) -> list[Plot]:
    """The figures, with what there is to see."""
    together = "The clouds as given."
    if drawn.apart:
        together = "The clouds lie too far apart for one picture: each is about its own middle."
    shown, held = len(drawn.match), len(alignment.matches.confidence)
    near = f"{alignment.inlier_distance:.3g}"
    moved = "The source as moved by the transform."
    dark = "After; the dark points are likely to have a counterpart in the other cloud."
    lines = (
        f"The {shown} most confident of the network's {held} matches, the aligned source moved "
        f"aside. Those agree whose ends the transform brings within {near}."
    )
    far = "Of the moved source from the target; what lies outside the overlap is far."
    return [
        Plot("Before", together, figures.two_clouds(drawn.before, drawn.target)),
        Plot("After", moved, figures.two_clouds(drawn.after, drawn.target)),
        Plot("Overlap", dark, figures.overlap(drawn)),
        Plot("Matches", lines if held else "There are none.", figures.matches(drawn)),
        Plot("Residuals", far, figures.residuals(drawn, alignment.inlier_distance)),
    ]


def _row(role: str, file: str, colour: str, points: Points, drawn: int) -> CloudRow:
    extent = " × ".join(f"{x:.3g}" for x in np.ptp(points, axis=0))
    return CloudRow(role, file, colour, f"{len(points):,}", f"{drawn:,}", extent)
