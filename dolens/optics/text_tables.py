"""Tables of text cells, printed for a terminal or written as HTML for a notebook."""

import math
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


def measured(value: float, error: float) -> str:
    """Return a value with the digits that its standard error allows: `12.67 ± 0.04`,
    `(1.304 ± 0.007)e-3`.

    Args:
        value: NaN is written as a dash.
        error: one significant digit of it is written; the value alone where it is zero, below the
            value's rounding, or unknown.
    """
    if math.isnan(value):
        return "–"
    known = math.isfinite(error) and math.isfinite(value)
    if not (known and error > 1e-9 * abs(value)):
        return f"{value:.4g}"
    size = max(abs(value), error)
    power = 0 if 1e-3 <= size < 1e5 else math.floor(math.log10(size))
    value, error = value / 10.0**power, error / 10.0**power
    decimals = max(-math.floor(math.log10(float(f"{error:.0e}"))), 0)
    # No negative zero.
    text = f"{round(value, decimals) + 0.0:.{decimals}f} ± {error:.{decimals}f}"
    return f"({text})e{power}" if power else text


def minus(number: str) -> str:
    """Return a number written with a minus sign in place of a hyphen; other text as it is."""
    try:
        float(number)
    except ValueError:
        return number
    return number.replace("-", "−")
