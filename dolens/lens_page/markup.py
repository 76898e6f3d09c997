"""The parts of a page, and the page that is made of them; nothing is fetched."""

from collections.abc import Sequence
from dataclasses import dataclass
from importlib.resources import files

from dolens.html import Markup, document, element, joined, table
from dolens.lens_page.tables import Table
from dolens.lens_page.viewer import viewer_script
from dolens.packaged import installed_version

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
