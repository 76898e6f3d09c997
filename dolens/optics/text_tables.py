"""Tables of text cells, printed for a terminal or written as HTML for a notebook."""

from collections.abc import Collection, Sequence
from pathlib import Path

Cells = Sequence[Sequence[str]]


def text_table(headings: Sequence[str], rows: Cells, left: Collection[int] = (0,)) -> str:
    """Return a table as lines of text, columns two spaces apart.

    Args:
        headings: of the columns.
        rows: as many cells each.
        left: numbers of the columns that are flush left; the others are flush right.
    """
    every = [[printable(cell) for cell in row] for row in (headings, *rows)]
    widths = [max(map(len, column)) for column in zip(*every, strict=True)]
    lines = []
    for row in every:
        cells = [
            cell.ljust(width) if number in left else cell.rjust(width)
            for number, (cell, width) in enumerate(zip(row, widths, strict=True))
        ]
        lines.append("  ".join(cells).rstrip())
    return "\n".join(lines)


def html_table(
    headings: Sequence[str],
    rows: Cells,
    caption: str = "",
    left: Collection[int] = (0,),
    note: str = "",
) -> str:
    """Return a table as HTML; all text is escaped.

    Args:
        headings: of the columns.
        rows: as many cells each.
        caption: above the table.
        left: numbers of the columns that are flush left; the others are flush right.
        note: a sentence below the table.
    """
    from dolens.html import rendered  # loads jinja2, which only notebooks need

    return rendered(
        Path(__file__).with_name("table.html"),
        headings=list(map(printable, headings)),
        rows=[[printable(minus(cell)) for cell in row] for row in rows],
        caption=printable(caption),
        sides=["left" if n in left else "right" for n in range(len(headings))],
        note=note,
    )


def printable(text: str) -> str:
    """Return text whose control characters are question marks, so that no file writes to a
    terminal what it likes.
    """
    return "".join(letter if letter.isprintable() else "?" for letter in text)


def minus(number: str) -> str:
    """Return a number written with a minus sign in place of a hyphen; other text as it is."""
    try:
        float(number)
    except ValueError:
        return number
    return number.replace("-", "−")
