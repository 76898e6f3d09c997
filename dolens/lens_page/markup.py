"""A page is assembled: text is escaped, figures stand in it, and nothing is fetched."""

from collections.abc import Sequence
from dataclasses import dataclass
from html import escape
from importlib.resources import files

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
        body: its elements, escaped.
    """

    name: str
    title: str
    body: str


def page_html(
    title: str, facts: Sequence[tuple[str, str]], command: str, blocks: Sequence[Block]
) -> str:
    """Return a whole page.

    Args:
        title: the name of the lens.
        facts: what and how much, in the heading.
        command: what made the page.
        blocks: its sections.
    """
    version = installed_version("dolens") or ""
    css = (files("dolens.lens_page") / "page.css").read_text(encoding="utf-8")
    contents = "".join(
        f'<li><a href="#{escape(block.name)}">{escape(block.title)}</a></li>' for block in blocks
    )
    sections = "\n".join(
        f'<section id="{escape(block.name)}"><h2>{escape(block.title)}</h2>\n{block.body}</section>'
        for block in blocks
    )
    listed = "".join(f"<li>{escape(what)} <b>{escape(value)}</b></li>" for what, value in facts)
    made = f"<code>{escape(command)}</code> · " if command else ""
    return f"""<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<meta name="generator" content="{GENERATOR} {escape(version)}">
<title>{escape(title)}</title>
<style>
{css}</style>
</head>
<body>
{_NIGHT}
<div class="page">
<header>
<h1>{escape(title)}</h1>
<ul class="facts">{listed}</ul>
<p class="made">{made}dolens {escape(version)}</p>
</header>
<nav aria-label="Contents"><details open><summary>Contents</summary><ol>{contents}</ol></details>
</nav>
<main>
{sections}
</main>
</div>
<script>
{viewer_script()}</script>
</body>
</html>
"""


def table_html(table: Table) -> str:
    """Return a table as elements."""
    heads = "".join(
        f'<th scope="col"{_words(table, column)}>{escape(head)}</th>'
        for column, head in enumerate(table.heads)
    )
    rows = []
    for at, row in enumerate(table.rows):
        kind = "total" if table.total and at == len(table.rows) - 1 else ""
        kind = "lit" if at in table.lit else kind
        cells = "".join(
            f"<td{_words(table, column)}>{escape(cell)}</td>" for column, cell in enumerate(row)
        )
        rows.append(f"<tr{f' class={chr(34)}{kind}{chr(34)}' if kind else ''}>{cells}</tr>")
    caption = f'<p class="caption">{escape(table.caption)}</p>' if table.caption else ""
    return (
        f'<div class="scroll"><table><thead><tr>{heads}</tr></thead><tbody>{"".join(rows)}</tbody>'
        f"</table></div>{caption}\n"
    )


def figure_html(svg: str, picture: bool) -> str:
    """Return a figure as an element; the colours of a picture stay as they are."""
    return f'<figure class="{"picture" if picture else "drawn"}">{svg}</figure>\n'


def note_html(text: str) -> str:
    """Return a sentence as an element."""
    return f"<p>{escape(text)}</p>\n" if text else ""


def problem_html(text: str) -> str:
    """Return why something is missing, as an element."""
    return f'<p class="problem">Not computed: {escape(text)}</p>\n'


def _words(table: Table, column: int) -> str:
    return ' class="words"' if column in table.words else ""
