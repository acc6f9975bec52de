"""One HTML file that needs nothing else: figures, their library, and text that is escaped."""

import html
from collections.abc import Iterable
from typing import TYPE_CHECKING

from dbdnet_jax.drawing.style import BAD, GOOD, NEUTRAL

if TYPE_CHECKING:
    from plotly.graph_objects import Figure

# The browser itself is told to load nothing from anywhere.
POLICY = (
    "default-src 'none'; script-src 'unsafe-inline'; style-src 'unsafe-inline'; img-src data: blob:"
)
COLOURS = f":root {{ --good: {GOOD}; --bad: {BAD}; --neutral: {NEUTRAL}; }}"
STYLE = """
html { color-scheme: light; overflow-y: scroll; }
* { box-sizing: border-box; }
body { margin: 0; background: #f5f7f9; color: #1f2933; font: 16px/1.5 system-ui, sans-serif; }
main { max-width: 1240px; margin: 0 auto; padding: 24px 16px 48px; }
h1 { margin: 0; font-size: 1.7rem; line-height: 1.25; overflow-wrap: anywhere; }
h2 { margin: 0 0 4px; font-size: 1.1rem; }
p { margin: 0 0 8px; overflow-wrap: anywhere; }
.good { border-left: 6px solid var(--good); padding-left: 14px; }
.bad { border-left: 6px solid var(--bad); padding-left: 14px; }
.tiles, .grid { display: grid; gap: 16px; margin: 16px 0; }
.tiles { grid-template-columns: repeat(auto-fit, minmax(min(100%, 170px), 1fr)); }
.grid { grid-template-columns: repeat(auto-fill, minmax(min(100%, 480px), 1fr)); }
.card { background: #fff; border: 1px solid #dde3e8; border-radius: 8px; padding: 14px 16px;
  min-width: 0; }
main > .card { margin: 16px 0; }
.card > p { color: #52606d; font-size: .875rem; }
.tile b { display: block; font-size: 1.5rem; line-height: 1.2; color: #1f2933; }
pre + p, .scroll + p { margin-top: 8px; }
.stack { display: grid; gap: 16px; align-content: start; min-width: 0; }
.plot { height: 420px; }
pre { margin: 0; overflow-x: auto; font: .875rem/1.5 ui-monospace, monospace; }
pre.wrap { white-space: pre-wrap; overflow-wrap: anywhere; }
.scroll { overflow-x: auto; }
table { border-collapse: collapse; font-size: .875rem; font-variant-numeric: tabular-nums; }
th, td { padding: 4px 14px 4px 0; text-align: right; vertical-align: bottom; white-space: nowrap; }
th { font-weight: 600; white-space: pre; border-bottom: 1px solid var(--neutral); }
th:first-child, td:first-child { text-align: left; }
table.names :is(th, td) { text-align: left; vertical-align: top; }
.names td:nth-child(2) { overflow-wrap: anywhere; white-space: normal; min-width: 9em; }
.swatch { display: inline-block; width: .8em; height: .8em; border-radius: 50%;
  margin-right: .4em; }
"""


class Markup(str):
    """Text that is HTML already; all other text is escaped on its way into a page."""


def escape(text: str) -> Markup:
    """The text itself on a page, whatever is in it."""
    return text if isinstance(text, Markup) else Markup(html.escape(text))


def tag(name: str, *inner: str, css: str = "") -> Markup:
    """An element around texts and elements."""
    css = f' class="{css}"' if css else ""
    return Markup(f"<{name}{css}>{''.join(map(escape, inner))}</{name}>")


def table(head: Iterable[str], body: Iterable[Iterable[str]], css: str = "") -> Markup:
    """A table; as wide as it must be, and scrolled where the page is narrower."""
    rows = [tag("tr", *(tag("th", cell) for cell in head))]
    rows += [tag("tr", *(tag("td", cell) for cell in line)) for line in body]
    return tag("div", tag("table", *rows, css=css), css="scroll")


def grid(*cards: str) -> Markup:
    """Cards beside one another where there is room."""
    return tag("div", *cards, css="grid")


def card(heading: str, *inner: str) -> Markup:
    """A framed part of the page with a heading."""
    return tag("section", tag("h2", heading), *inner, css="card")


def plot(heading: str, text: str, figure: "Figure") -> Markup:
    """A figure in a card, under a heading and a sentence."""
    # The mark tells whoever waits for a drawn page that this figure is there.
    mark = "document.getElementById('{plot_id}').dataset.drawn = 'yes';"
    script = figure.to_html(
        config={"responsive": True, "displaylogo": False},
        include_plotlyjs=False,
        full_html=False,
        post_script=mark,
    )
    return card(heading, tag("p", text), tag("div", Markup(script), css="plot"))


def page(title: str, *parts: str) -> bytes:
    """The whole file. Names that are no valid text are written with backslashes."""
    from plotly.offline import get_plotlyjs

    text = "\n".join(
        [
            '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">',
            f'<meta http-equiv="Content-Security-Policy" content="{POLICY}">',
            '<meta name="viewport" content="width=device-width, initial-scale=1">',
            tag("title", title),
            f"<style>{COLOURS}{STYLE}</style>\n<script>{get_plotlyjs()}</script>\n</head>\n<body>",
            tag("main", *parts),
            "</body>\n</html>\n",
        ]
    )
    return text.encode(errors="backslashreplace")
