"""The drawings of a lens: one PDF of all sheets, and each sheet as SVG."""

import datetime
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import matplotlib
from matplotlib.backends.backend_pdf import PdfPages
from matplotlib.figure import Figure
from matplotlib.text import Text

from dolens.manufacturing.assembly_sheet import assembly_sheets, sheet_count
from dolens.manufacturing.drawing_numbers import EQUATIONS
from dolens.manufacturing.drawing_sheet import TitleBlock
from dolens.manufacturing.element_sheet import element_sheet
from dolens.manufacturing.glass_elements import glass_elements
from dolens.manufacturing.shop_tolerances import ShopTolerances
from dolens.optics.lens import Lens
from dolens.optics.tables import printable


@dataclass(frozen=True)
class DrawingResult:
    """The files of a set of drawings.

    Attributes:
        pdf: all sheets.
        sheets: each sheet as SVG.
        left_out: a sentence for each element that has no sheet.
    """

    pdf: Path
    sheets: Sequence[Path]
    left_out: Sequence[str]


def drawing_figures(
    lens: Lens,
    tolerances: ShopTolerances,
    design: str,
    program: str,
    date: str | None = None,
) -> tuple[dict[str, Figure], list[str]]:
    """Return the sheets by name, the assembly first, and why elements have none.

    Args:
        lens: any with glass.
        tolerances: what is known of them; the rest is marked as to be agreed.
        design: the hash of the design, for the title block.
        program: name and version, for the title block.
        date: for the title block; None: today.
    """
    elements = glass_elements(lens)
    faults = {element.name: element.fault() for element in elements}
    whole = [element for element in elements if faults[element.name] is None]
    first = sheet_count(lens)
    block = TitleBlock(
        lens.name or "lens",
        design[:16],
        date or datetime.date.today().isoformat(),
        program,
        lens.primary_wavelength,
        first + len(whole),
    )
    sheets = assembly_sheets(lens, elements, tolerances, block)
    named = {f"assembly_{n}" if n > 1 else "assembly": s for n, s in enumerate(sheets, 1)}
    for number, element in enumerate(whole, first + 1):
        named[element.name] = element_sheet(element, tolerances, block, number)
    for sheet in named.values():
        for text in sheet.findobj(Text):
            # A name is no formula, whatever signs it has.
            if isinstance(text, Text) and text.get_text() not in EQUATIONS.values():
                text.set_parse_math(False)
                text.set_text("\n".join(map(printable, text.get_text().split("\n"))))
    return named, [fault for fault in faults.values() if fault is not None]


def export_drawings(
    lens: Lens,
    folder: str | Path,
    tolerances: ShopTolerances,
    design: str,
    program: str,
    date: str | None = None,
) -> DrawingResult:
    """Write the drawings of a lens: `drawing.pdf`, and `drawing/*.svg`; see `drawing_figures`."""
    figures, left_out = drawing_figures(lens, tolerances, design, program, date)
    folder = Path(folder)
    (folder / "drawing").mkdir(parents=True, exist_ok=True)
    paths = []
    # Text stays text, so that a reader can search and copy the numbers.
    with matplotlib.rc_context({"svg.fonttype": "none", "pdf.fonttype": 42}):
        with PdfPages(folder / "drawing.pdf") as pdf:
            for figure in figures.values():
                pdf.savefig(figure)
        for number, (name, figure) in enumerate(figures.items(), 1):
            paths.append(folder / "drawing" / f"{number:02d}_{name}.svg")
            figure.savefig(paths[-1])
    return DrawingResult(folder / "drawing.pdf", paths, left_out)
