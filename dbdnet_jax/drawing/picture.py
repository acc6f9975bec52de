"""One alignment as a picture: drawn without a display, and without touching pyplot's state."""

import io
from typing import Any

import numpy as np
from jaxtyping import Float

from dbdnet_jax.alignment.align import Alignment
from dbdnet_jax.drawing.selection import box, select_points
from dbdnet_jax.drawing.style import BAD, GOOD, OVERLAP, SOURCE, TARGET
from dbdnet_jax.types import OtherPoints, Points

INCHES, DOTS = (15.0, 5.6), 100  # 1500 x 560 pixels


def alignment_picture(
    alignment: Alignment,
    source: Points,
    target: OtherPoints,
    *,
    names: tuple[str, str] = ("source", "target"),
) -> bytes:
    """A PNG of 1500 x 560: the clouds before and after, and their overlap, under the verdict."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.colors import LinearSegmentedColormap, to_rgba_array
    from matplotlib.figure import Figure

    drawn = select_points(alignment, source, target)
    figure = Figure(figsize=INCHES, dpi=DOTS, facecolor="white")
    canvas = FigureCanvasAgg(figure)
    sides = len(drawn.after), len(drawn.target)
    sided = np.repeat(to_rgba_array([SOURCE, TARGET]), sides, axis=0)
    scale = LinearSegmentedColormap.from_list("overlap", OVERLAP)
    likely = scale(np.concatenate([drawn.source_overlap, drawn.target_overlap]))
    before = "before, each about its own middle" if drawn.apart else "before"
    _panel(figure, 0, before, np.concatenate([drawn.before, drawn.target]), sided)
    _panel(figure, 1, "after", np.concatenate([drawn.after, drawn.target]), sided)
    _panel(figure, 2, "overlap", np.concatenate([drawn.after, drawn.target]), likely)
    _words(figure, alignment, names)
    _keys(figure, scale)
    buffer = io.BytesIO()
    canvas.print_png(buffer)
    return buffer.getvalue()


def _panel(
    figure: Any, place: int, heading: str, points: Points, colours: Float[np.ndarray, "n 4"]
) -> None:
    """One view of both clouds, drawn together so that nearer points hide farther ones."""
    axes = figure.add_axes((0.005 + 0.31 * place, 0.02, 0.305, 0.78), projection="3d")
    axes.set_title(heading, fontsize=13, y=1.0)
    finite = np.isfinite(points).all(axis=1)
    size = np.clip(20_000 / len(points), 1.5, 9.0)
    axes.scatter(*points[finite].T, c=colours[finite], s=size, depthshade=False, linewidths=0)
    low, high = box(points)
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), zlim=(low[2], high[2]))
    axes.set_box_aspect(high - low, zoom=0.95)
    axes.tick_params(labelsize=7, pad=-2)
    axes.locator_params(nbins=4)
    for axis in (axes.xaxis, axes.yaxis, axes.zaxis):
        axis.set_pane_color("white")


def _words(figure: Any, alignment: Alignment, names: tuple[str, str]) -> None:
    """Verdict, files and the numbers to look at first; nothing in a name is a formula."""
    words: dict[str, Any] = {"x": 0.02, "parse_math": False}
    colour = GOOD if alignment.valid else BAD
    verdict = alignment.verdict.capitalize()
    figure.text(y=0.93, s=verdict, size=18, weight="bold", color=colour, **words)
    numbers = (
        " onto ".join(_shortened(name) for name in names),
        f"probability {alignment.success_probability:.1%}",
        f"inliers {alignment.inlier_ratio:.1%} within {alignment.inlier_distance:.3g}",
    )
    lines = filter(None, (alignment.reason, "    ".join(numbers)))
    figure.text(y=0.9, s="\n".join(lines), size=11, va="top", linespacing=1.5, **words)


def _keys(figure: Any, scale: Any) -> None:
    """What the colours mean."""
    from matplotlib.cm import ScalarMappable
    from matplotlib.lines import Line2D

    dots = [
        Line2D([], [], marker="o", linestyle="", color=colour, label=label)
        for label, colour in (("source", SOURCE), ("target", TARGET))
    ]
    figure.legend(
        handles=dots, loc="lower center", bbox_to_anchor=(0.33, 0.0), ncols=2, frameon=False
    )
    bar = figure.add_axes((0.945, 0.2, 0.008, 0.45))
    figure.colorbar(ScalarMappable(cmap=scale), cax=bar, label="probability")


def _shortened(name: str) -> str:
    """A file's name, its middle left out if long, as valid text."""
    name = name.encode(errors="backslashreplace").decode()
    return name if len(name) <= 50 else f"{name[:24]}…{name[-24:]}"
