"""Pages as single HTML files: templates that escape every text, and the figures in them."""

from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from dbdnet_jax.drawing.style import BAD, GOOD, NEUTRAL

if TYPE_CHECKING:
    from plotly.graph_objects import Figure

TEMPLATES = Path(__file__).parent / "templates"
COLOURS = {"good": GOOD, "bad": BAD, "neutral": NEUTRAL}


class Plot(NamedTuple):
    """A figure under a heading and a sentence; without ``figure`` they stand alone."""

    heading: str
    text: str
    figure: "Figure | None" = None

    @property
    def html(self) -> str:
        """The figure as HTML, which its own library has escaped."""
        from markupsafe import Markup

        if self.figure is None:
            return Markup("")
        # The mark tells whoever waits for a drawn page that this figure is there.
        mark = "document.getElementById('{plot_id}').dataset.drawn = 'yes';"
        return Markup(
            self.figure.to_html(
                config={"responsive": True, "displaylogo": False},
                include_plotlyjs=False,
                full_html=False,
                post_script=mark,
            )
        )


def render(template: str, **context: Any) -> bytes:
    """A template of this room, filled in; names that are no valid text get backslashes."""
    from jinja2 import Environment, FileSystemLoader, StrictUndefined
    from markupsafe import Markup
    from plotly.offline import get_plotlyjs

    environment = Environment(
        loader=FileSystemLoader(TEMPLATES),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    library = Markup(get_plotlyjs())
    page = environment.get_template(template).render(plotly=library, colours=COLOURS, **context)
    return page.encode(errors="backslashreplace")
