"""A table on the page of a search says which formats hold each form."""

import os
import re
from collections.abc import Sequence
from pathlib import Path
from urllib.parse import quote

from dolens.html import Child, Markup, element, joined, table
from dolens.lens_search.form_report import FormReport

_MISSING = "✗ not written"
# A number in a sentence.
_NUMBER = re.compile(r"-?\d+\.\d+(e[-+]?\d+)?")


def address(path: Path, folder: Path) -> str:
    """Return where a file lies, seen from a page in a folder."""
    return quote(Path(os.path.relpath(path, folder)).as_posix())


def file_table(reports: Sequence[FormReport], folder: Path) -> Markup:
    """Return which formats hold each form, and what those say otherwise that cannot hold all."""
    suffixes = [file.path.suffix for file in reports[0].files]
    rows: list[list[Child]] = []
    # A change that only differs in its number is one.
    notes: dict[str, dict[int, str]] = {}
    for report in reports:
        row: list[Child] = [report.name]
        for file in report.files:
            if not file.written:
                row.append(element("span", _MISSING, class_="bad"))
            else:
                mark = "" if file.exact else " ≈"
                name = f"{file.path.suffix}{mark}"
                row.append(element("a", name, href=address(file.path, folder)))
            for change in file.changes:
                note = f"{file.path.suffix}: {change}"
                notes.setdefault(_NUMBER.sub("…", note), {})[report.number] = note
        rows.append(row)
    kinds = dict.fromkeys(range(len(suffixes) + 1), "words")
    said = []
    for general, of in notes.items():
        alike = set(of.values())
        where = "" if len(of) == len(reports) else f" (form {', '.join(map(str, of))})"
        said.append(element("li", (alike.pop() if len(alike) == 1 else general) + where))
    caption = "Every file was read again: it gives the same numbers to the last bit, but for ≈."
    return joined(
        element("div", table(("form", *suffixes), rows, column_kinds=kinds), class_="scroll"),
        element("p", caption, class_="caption"),
        element("ul", *said, class_="notes") if said else None,
    )
