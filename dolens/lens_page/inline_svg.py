"""Figures become SVG that stands in a page: no addresses, no ids that meet those of another."""

import io
import re
from html import escape

import numpy as np
from matplotlib import rc_context
from matplotlib.collections import Collection
from matplotlib.figure import Figure
from matplotlib.image import AxesImage
from matplotlib.lines import Line2D

from dolens.html import Markup

# More markers than this in one artist become a picture: as vectors they would take megabytes.
_MANY = 120
_DOTS_PER_INCH = 200
_IDS = re.compile(r"""(\bid="|url\(#|href="#)""")


def inline_svg(figure: Figure, name: str, label: str) -> Markup:
    """Return a figure as an SVG element.

    Text is drawn as outlines, so that it looks the same everywhere.

    Args:
        figure: its dense scatters are rasterised; nothing else of it changes.
        name: letters and digits, of this figure alone in its page; its ids begin with it.
        label: what the figure shows, for readers who do not see it.
    """
    rasterise(figure)
    buffer = io.StringIO()
    with rc_context({"svg.hashsalt": name, "svg.fonttype": "path", "svg.image_inline": True}):
        figure.savefig(buffer, format="svg", dpi=_DOTS_PER_INCH, transparent=True)
    text = buffer.getvalue()
    text = text[text.index("<svg") :]
    text = re.sub(r"<metadata>.*?</metadata>", "", text, flags=re.DOTALL)
    text = re.sub(r"<!--.*?-->", "", text, flags=re.DOTALL)
    text = re.sub(r'\s+xmlns(:\w+)?="[^"]*"', "", text)
    text = text.replace("xlink:href=", "href=")
    used = set(re.findall(r"""(?:url\(#|href="#)([^")]+)""", text))
    # Names of artists lead nowhere in a page, and may stand there twice.
    text = re.sub(r' id="([^"]*)"', lambda found: found[0] if found[1] in used else "", text)
    text = _IDS.sub(lambda found: f"{found[1]}{name}-", text)
    opening, _, rest = text.partition(">")
    box = re.search(r'viewBox="[^"]*"', opening)
    # The width in points that the figure has, at most; a narrow screen shrinks it.
    width = figure.get_size_inches()[0] * 96.0
    return Markup(
        f'<svg {box[0] if box else ""} role="img" aria-label="{escape(label)}" '
        f'style="max-width:{width:.0f}px">{rest.strip()}'
    )


def rasterise(figure: Figure) -> None:
    """Mark artists with very many markers, so that vector formats hold them as pictures."""
    for axes in figure.get_axes():
        for artist in axes.get_children():
            if isinstance(artist, Line2D):
                marked = artist.get_marker() not in (None, "None", "", " ")
                dense = marked and np.size(artist.get_xdata(orig=False)) > _MANY
            else:
                dense = (
                    isinstance(artist, Collection) and len(np.asarray(artist.get_offsets())) > _MANY
                )
            if dense:
                artist.set_rasterized(True)


def holds_pictures(figure: Figure) -> bool:
    """Return whether a figure shows images, whose colours must stay as they are."""
    return any(
        isinstance(artist, AxesImage)
        for axes in figure.get_axes()
        for artist in axes.get_children()
    )
