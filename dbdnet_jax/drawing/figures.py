"""Interactive figures: clouds in space, a histogram, and curves.

A figure's text may hold simple HTML, so words from outside are escaped on their way into it.
"""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from jaxtyping import Float

from dbdnet_jax.drawing.selection import Corner, DrawnPair, box
from dbdnet_jax.drawing.style import BAD, CURVES, DASHES, GOOD, NEUTRAL, OVERLAP, SOURCE, TARGET

if TYPE_CHECKING:
    from plotly.graph_objects import Figure

FONT = {"family": "system-ui, sans-serif", "size": 13, "color": "#1f2933"}
# Above a figure are the buttons of the library.
LEGEND = {"orientation": "h", "x": 0, "y": 0, "yanchor": "top", "itemsizing": "constant"}
BELOW = {"orientation": "h", "x": 0, "y": 0, "yref": "container", "yanchor": "bottom"}
ABOVE = {"orientation": "h", "x": 0, "y": 1, "yanchor": "bottom"}
CAMERA = {
    "eye": {"x": 1.0, "y": -1.75, "z": 0.95},
    "center": {"x": 0, "y": 0, "z": -0.1},
}  # from the right and above, as in the picture
BOX = 1.95  # diagonal of the box around the points, as far as that camera sees it whole
BINS_WITHIN, BINS = 8, 40  # bars below the inlier distance, and in all


class Curve(NamedTuple):
    """One method's line of a chart; ``place`` is its number, which decides its look.

    A ``learned`` method's line is thick.
    """

    name: str
    place: int
    x: Sequence[float]
    y: Sequence[float]
    learned: bool = False


def two_clouds(source: Float[np.ndarray, "n 3"], target: Float[np.ndarray, "m 3"]) -> "Figure":
    """Source and target in their colours."""
    return _space([_cloud("source", source, SOURCE), _cloud("target", target, TARGET)])


def overlap(drawn: DrawnPair) -> "Figure":
    """Both clouds as aligned, coloured by the probability of lying in the other one."""
    scale = [[i / (len(OVERLAP) - 1), colour] for i, colour in enumerate(OVERLAP)]
    shared = {"cmin": 0, "cmax": 1, "colorscale": scale}
    place = {"orientation": "h", "x": 1, "xanchor": "right", "y": 0, "yanchor": "top", "len": 0.45}
    title = {"text": "probability", "side": "top", "font": {"size": 12}}
    bar = place | {"title": title, "thickness": 10, "outlinewidth": 0, "nticks": 3}
    return _space(
        [
            _cloud("source", drawn.after, drawn.source_overlap, colorbar=bar, **shared),
            _cloud("target", drawn.target, drawn.target_overlap, symbol="diamond", **shared),
        ]
    )


def matches(drawn: DrawnPair) -> "Figure":
    """The aligned source moved aside: lines of matches that agree with the pose are parallel."""
    step = _sidestep(drawn)
    ends = drawn.match + np.stack([step, np.zeros(3)])
    return _space(
        [
            _cloud("source", drawn.after + step, SOURCE, size=1.2),
            _cloud("target", drawn.target, TARGET, size=1.2),
            _lines("agrees with the pose", ends[drawn.agrees], GOOD),
            _lines("does not", ends[~drawn.agrees], BAD),
        ]
    )


def residuals(drawn: DrawnPair, inlier_distance: float) -> "Figure":
    """How many source points lie how far from the target; the last bar holds all that is farther.

    Distances are in the clouds' unit.
    """
    from plotly.graph_objects import Bar, Figure

    width = inlier_distance / BINS_WITHIN
    bars = np.minimum(drawn.distance / width, BINS - 1).astype(int)
    counts = np.bincount(bars, minlength=BINS)
    middles = (np.arange(BINS) + 0.5) * width
    inner, outer = slice(BINS_WITHIN), slice(BINS_WITHIN, None)
    figure = Figure(
        [
            Bar(x=middles[part], y=counts[part], name=name, marker_color=colour, width=width)
            for part, name, colour in ((inner, "inliers", GOOD), (outer, "farther", NEUTRAL))
        ]
    )
    ticks = np.arange(0, BINS, BINS_WITHIN) * width
    figure.update_xaxes(
        title_text="distance to the nearest target point",
        tickvals=[*ticks, middles[-1]],
        ticktext=[*(f"{x:.3g}" for x in ticks), "farther"],
        ticklabeloverflow="allow",
    )
    figure.update_yaxes(title_text="source points")
    return _flat(figure, bargap=0, legend=ABOVE)


def curves(lines: Sequence[Curve], x: str, y: str, mode: str, **axis: Any) -> "Figure":
    """Lines over a common axis; ``mode`` is "lines" or "lines+markers", ``axis`` of the x axis."""
    from markupsafe import escape
    from plotly.graph_objects import Figure, Scatter

    def look(line: Curve) -> dict[str, Any]:
        colour = CURVES[line.place % len(CURVES)]
        if line.learned:
            return {"color": colour, "width": 3}
        return {"color": colour, "width": 1.5, "dash": DASHES[line.place % len(DASHES)]}

    figure = Figure(
        [
            Scatter(x=line.x, y=line.y, name=str(escape(line.name)), mode=mode, line=look(line))
            for line in lines
        ]
    )
    figure.update_xaxes(title_text=str(escape(x)), **axis)
    figure.update_yaxes(title_text=str(escape(y)), rangemode="tozero")
    return _flat(figure, legend=BELOW)


def _space(traces: list) -> "Figure":
    """A scene with equal axes that holds every point; what is not finite is left out."""
    from plotly.graph_objects import Figure

    low, high = box(np.concatenate([np.stack([t.x, t.y, t.z], axis=1) for t in traces]))
    sides = high - low
    scene: dict[str, Any] = {
        "camera": CAMERA,
        "aspectmode": "manual",
        "aspectratio": dict(zip("xyz", BOX * sides / np.linalg.norm(sides), strict=True)),
    }
    for i, axis in enumerate("xyz"):
        scene[f"{axis}axis"] = {
            "range": [low[i], high[i]],
            "title": {"text": axis},
            "nticks": 5,
            "tickfont": {"size": 10},
            "showbackground": False,
            "gridcolor": "#dde3e8",
            "zerolinecolor": "#dde3e8",
            "showspikes": False,
        }
    margin = {"l": 0, "r": 0, "t": 30, "b": 50}
    return Figure(
        traces,
        {"template": "none", "font": FONT, "legend": LEGEND, "margin": margin, "scene": scene},
    )


def _flat(figure: "Figure", **layout: Any) -> "Figure":
    """The look of a chart in the plane."""
    axis = {"gridcolor": "#e4e8ec", "zeroline": False, "linecolor": "#9aa5ae", "automargin": True}
    figure.update_xaxes(**axis)
    figure.update_yaxes(**axis)
    return figure.update_layout(
        template="none",
        font=FONT,
        margin={"l": 60, "r": 30, "t": 55, "b": 50},
        **layout,
    )


def _cloud(name: str, points: Float[np.ndarray, "n 3"], colour: Any, **marker: Any) -> Any:
    from plotly.graph_objects import Scatter3d

    x, y, z = points.T
    look = {"size": 2.0 if len(points) < 2000 else 1.2, "color": colour} | marker
    return Scatter3d(x=x, y=y, z=z, name=name, mode="markers", marker=look, hoverinfo="skip")


def _lines(name: str, ends: Float[np.ndarray, "k 2 3"], colour: str) -> Any:
    """Separate lines as one trace: a gap follows each."""
    from plotly.graph_objects import Scatter3d

    gaps = np.full((len(ends), 1, 3), np.nan)
    x, y, z = np.concatenate([ends, gaps], axis=1).reshape(-1, 3).T
    line = {"color": colour, "width": 3}
    return Scatter3d(x=x, y=y, z=z, name=name, mode="lines", line=line, hoverinfo="skip")


def _sidestep(drawn: DrawnPair) -> Corner:
    """Far enough to the side or up, whichever is the shorter way, to see between the clouds."""
    low, high = box(np.concatenate([drawn.after, drawn.target]))
    sides = high - low
    step = np.zeros(3)
    axis = 0 if sides[0] < sides[2] else 2
    step[axis] = sides[axis] + 0.4 * sides.max()
    return step
