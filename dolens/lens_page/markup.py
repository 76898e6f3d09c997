"""The HTML of a page: tables, figures as SVG, and the viewer; nothing is fetched."""

import base64
import io
import json
import re
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape
from importlib.resources import files

import numpy as np
from matplotlib import rc_context
from matplotlib.collections import Collection
from matplotlib.figure import Figure
from matplotlib.image import AxesImage
from matplotlib.lines import Line2D

from dolens.analysis.conditions import Conditions
from dolens.files import installed_version
from dolens.html import Markup, document, element, joined, table
from dolens.lens_page.solid import Mesh, Solid
from dolens.lens_page.tables import Table
from dolens.optics.fields import field_label
from dolens.plotting.style import ordered_colours

# Every page says by this what it is, so that only pages are overwritten unasked.
GENERATOR = "dolens show"

# Colours for a dark page: the complement turned by 180° in hue, so that dark becomes light and hues
# stay (the matrix of the W3C's Filter Effects), then lightened, so that no line is lost.
# `nightColour` in viewer.js does the same to rays.
_NIGHT = """<svg width="0" height="0" style="position:absolute" aria-hidden="true">
<filter id="night" color-interpolation-filters="sRGB">
<feColorMatrix values=".574 -1.43 -.144 0 1
 -.426 -.43 -.144 0 1  -.426 -1.43 .856 0 1  0 0 0 1 0"/>
<feComponentTransfer><feFuncR type="gamma" exponent=".6"/><feFuncG type="gamma" exponent=".6"/>
<feFuncB type="gamma" exponent=".6"/></feComponentTransfer>
</filter></svg>"""


@dataclass(frozen=True)
class Block:
    """A section of a page as elements.

    Attributes:
        name: in addresses within the page.
        title: its heading.
        body: its elements.
    """

    name: str
    title: str
    body: Markup


def page_html(
    title: str,
    facts: Sequence[tuple[str, str]],
    command: str,
    blocks: Sequence[Block],
    style: str = "",
    generator: str = GENERATOR,
) -> str:
    """Return a whole page.

    Args:
        title: the name of the lens.
        facts: what and how much, in the heading.
        command: what made the page.
        blocks: its sections.

    Rarely needed:
        style: rules of CSS besides those of every page.
        generator: by which a page says what it is.
    """
    version = installed_version("dolens") or ""
    css = (files("dolens.lens_page") / "page.css").read_text(encoding="utf-8") + style
    header = element(
        "header",
        element("h1", title),
        element(
            "ul",
            *(element("li", f"{what} ", element("b", value)) for what, value in facts),
            class_="facts",
        ),
        element(
            "p",
            *((element("code", command), " · ") if command else ()),
            f"dolens {version}",
            class_="made",
        ),
    )
    links = (element("li", element("a", block.title, href=f"#{block.name}")) for block in blocks)
    contents = element(
        "nav",
        element("details", element("summary", "Contents"), element("ol", *links), open=""),
        aria_label="Contents",
    )
    sections = (
        element("section", element("h2", block.title), block.body, id=block.name)
        for block in blocks
    )
    page = element("div", header, contents, element("main", *sections), class_="page")
    # A view in space is what a lens's own page has.
    viewer = generator == GENERATOR
    script = element("script", Markup(viewer_script())) if viewer else None
    return document(title, css, [Markup(_NIGHT), page, script], f"{generator} {version}")


def table_html(shown: Table) -> Markup:
    """Return a table as elements."""
    last = len(shown.rows) - 1
    found = table(
        shown.heads,
        shown.rows,
        column_kinds=dict.fromkeys(shown.words, "words"),
        row_kinds=({last: "total"} if shown.total else {}) | dict.fromkeys(shown.lit, "lit"),
    )
    caption = element("p", shown.caption, class_="caption") if shown.caption else None
    return joined(element("div", found, class_="scroll"), caption)


def figure_html(svg: Markup, picture: bool) -> Markup:
    """Return a figure as an element; the colours of a picture stay as they are."""
    return element("figure", svg, class_="picture" if picture else "drawn")


def note_html(text: str) -> Markup | None:
    """Return a sentence as an element; None where there is none."""
    return element("p", text) if text else None


def problem_html(text: str) -> Markup:
    """Return why something is missing, as an element."""
    return element("p", f"Not computed: {text}", class_="problem")


def viewer_html(found: Solid, where: Conditions) -> Markup:
    """Return the elements of a viewer; `viewer_script` brings it to life.

    Args:
        found: the lens in space.
        where: its fields, for the labels of rays.
    """
    shades = ordered_colours(len(found.rays))
    labels = [field_label(point, where.field_unit) for point in where.fields]
    boxes = (
        element(
            "label",
            element("input", type="checkbox", data_field=str(number), checked=""),
            element("span", class_="key", style=f"background:{shade}"),
            f"{label}{'' if rays else ' (no ray passes)'}",
        )
        for number, (label, shade, rays) in enumerate(zip(labels, shades, found.rays, strict=True))
    )
    buttons = (
        element("button", "turned", type="button", data_view="turned"),
        element("button", "from the side", type="button", data_view="side"),
        element("button", "from the front", type="button", data_view="front"),
        element("button", "+", type="button", data_zoom="1.25", aria_label="zoom in"),
        element("button", "−", type="button", data_zoom="0.8", aria_label="zoom out"),
        element("label", element("input", type="checkbox", data_cut=""), "cut in half"),
    )
    data = Markup(_data(found, shades))
    return element(
        "div",
        element("canvas", tabindex="0", aria_label="The lens in space; drag to turn it"),
        element("noscript", element("p", "The lens in space needs JavaScript.")),
        element("div", *buttons, class_="tools"),
        element("div", *boxes, class_="tools"),
        element("script", data, type="application/json", id="viewer-data"),
        id="viewer",
    )


def viewer_script() -> str:
    """Return the viewer's program."""
    return (files("dolens.lens_page") / "viewer.js").read_text(encoding="utf-8")


def _data(found: Solid, shades: list[str]) -> str:
    """Return the lens in space as JSON that no text can break out of."""
    points = [mesh.positions.reshape(-1, 3) for mesh in found.meshes]
    points += [path for field in found.rays for path in field]
    every = np.concatenate(points)
    low, high = every.min(0), every.max(0)
    centre = 0.5 * (low + high)
    half = np.maximum(0.5 * (high - low), 1e-9)
    text = json.dumps(
        {
            "centre": centre.tolist(),
            "half": half.tolist(),
            "reach": float(np.linalg.norm(every - centre, axis=-1).max()),
            "cut": False,
            "meshes": [_mesh(mesh) for mesh in found.meshes],
            "rims": [_encoded(rim.astype("<f4")) for rim in found.rims],
            "fields": [
                {"colour": shade, "rays": [_encoded(path) for path in rays]}
                for shade, rays in zip(shades, found.rays, strict=True)
            ],
        },
        separators=(",", ":"),
    )
    return text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")


def _mesh(mesh: Mesh) -> dict[str, object]:
    rings, around, _ = mesh.positions.shape
    return {
        "kind": mesh.kind,
        "rings": rings,
        "around": around,
        "closed": mesh.closed,
        "positions": _encoded(mesh.positions),
        "normals": _encoded(np.round(127.0 * mesh.normals).astype("i1")),
    }


def _encoded(values: np.ndarray) -> str:
    return base64.b64encode(np.ascontiguousarray(values).tobytes()).decode("ascii")


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
