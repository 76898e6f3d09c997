"""The drawings of a lens: the assembly's sheets, one sheet an element, as PDF and SVG."""

import datetime
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_pdf import PdfPages
from matplotlib.figure import Figure
from matplotlib.patches import Polygon
from matplotlib.text import Text

from dolens.manufacturing.drawing_numbers import (
    AGREE,
    EQUATIONS,
    ShopTolerances,
    clear_aperture_text,
    length,
    signed_radius,
)
from dolens.manufacturing.drawing_sheet import (
    INK,
    TEXT,
    TitleBlock,
    dimension,
    drawing_axes,
    grid_table,
    new_sheet,
    per_paper_mm,
)
from dolens.manufacturing.element_sheet import element_sheet, section
from dolens.manufacturing.glass_elements import GlassElement, face_of, glass_elements
from dolens.optics.elements import DISPLACEMENTS, TILTS
from dolens.optics.lens import Lens
from dolens.optics.text_tables import printable
from dolens.plotting.section import sensor_curve


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


# Surfaces in one table.
ROWS = 26
_DRAWING = (0.03, 0.53, 0.94, 0.42)
_TABLE = (0.03, 0.13, 0.62, 0.39)
_NOTES = (0.67, 0.505)


def assembly_sheets(
    lens: Lens,
    elements: Sequence[GlassElement],
    tolerances: ShopTolerances,
    block: TitleBlock,
) -> list[Figure]:
    """Draw the assembly, and further sheets where the table of surfaces is long."""
    rows = surface_table(lens, elements, tolerances)
    outlines = [_in_lens(element) for element in elements]
    z, half = _sensor(lens, outlines)
    everything = np.concatenate([*outlines, [[z, half], [z, -half]]])
    low, high = everything.min(0), everything.max(0)
    paper = [_DRAWING[2] * 297.0, _DRAWING[3] * 210.0]
    needs = (
        (high[0] - low[0]) / (1.0 - 24.0 / paper[0]),
        (high[1] - low[1]) / (1.0 - 34.0 / paper[1]),
    )
    _, scale = drawing_axes(Figure(figsize=(11.69, 8.27)), _DRAWING, *needs)
    figure = new_sheet(block, 1, "Assembly", scale)
    axes, _ = drawing_axes(figure, _DRAWING, *needs)
    middle = 0.5 * (low + high)
    _draw(axes, lens, elements, [o - middle for o in outlines], (z, half), middle)
    grid_table(figure, _TABLE, "Surfaces and spacings", [_HEADING, *rows[:ROWS]], _WIDTHS)
    _notes(figure, lens, tolerances, len(rows) > ROWS)
    sheets = [figure]
    for start in range(ROWS, len(rows), 2 * ROWS):
        more = new_sheet(block, 1 + len(sheets), "Assembly, further surfaces", "–")
        part = [_HEADING, *rows[start : start + 2 * ROWS]]
        grid_table(more, (0.03, 0.13, 0.94, 0.82), "Surfaces and spacings", part, _WIDTHS)
        sheets.append(more)
    return sheets


def sheet_count(lens: Lens) -> int:
    """Return how many sheets the assembly takes."""
    beyond = max(0, len(lens.surfaces) - ROWS)
    return 1 + math.ceil(beyond / (2 * ROWS))


_HEADING = ("S", "of", "R, signed (mm)", "clear aperture", "to next (mm)", "tolerance", "medium")
_WIDTHS = (0.09, 0.09, 0.18, 0.19, 0.19, 0.14, 0.12)


def surface_table(
    lens: Lens, elements: Sequence[GlassElement], tolerances: ShopTolerances
) -> list[tuple[str, ...]]:
    """Return a row of text for every surface: number, element, radius, aperture, gap, medium."""
    system = lens.system().double()
    rows: list[tuple[str, ...]] = []
    count = len(lens.surfaces)
    for number in range(1, count + 1):
        face = face_of(system, number)
        of = [e.name for e in elements if number in (e.front.number, e.back.number)]
        name = f"thicknesses.{number}" if number < count else "sensor_distance"
        gap = lens.thicknesses[str(number)] if number < count else lens.sensor_distance
        medium = lens.materials[number].name
        stop = " stop" if number == lens.stop else ""
        rows.append(
            (
                f"{number}{stop}",
                "+".join(of) or "–",
                signed_radius(face) if of else "–",
                clear_aperture_text(face).split(",")[0],
                length(float(gap.detach())) + ("" if number < count else " to sensor"),
                tolerances.of(name),
                "air" if medium == "occluder" else medium,
            )
        )
    return rows


def _in_lens(element: GlassElement) -> np.ndarray:
    """Return the section's outline in the lens's axes, (N, 2): z, y."""
    z, y = section(element).T
    return element.front.to_lens(np.stack([np.zeros_like(z), y, z], -1))[:, [2, 1]]


def _sensor(lens: Lens, outlines: Sequence[np.ndarray]) -> tuple[float, float]:
    z = float(lens.system().vertices[-1].detach())
    if lens.sensor_diameter:
        return z, 0.5 * lens.sensor_diameter
    return z, 0.5 * max(float(np.abs(o[:, 1]).max()) for o in outlines)


def _draw(
    axes: Axes,
    lens: Lens,
    elements: Sequence[GlassElement],
    outlines: Sequence[np.ndarray],
    sensor: tuple[float, float],
    middle: np.ndarray,
) -> None:
    unit = per_paper_mm(axes)
    z, half = sensor[0] - middle[0], sensor[1]
    zero = -middle[1]
    tops = [float(o[:, 1].max()) for o in outlines]
    bottom = min(min(float(o[:, 1].min()) for o in outlines), zero - half)
    first = min(float(o[:, 0].min()) for o in outlines)
    ends = [first - 5.0 * unit, z + 5.0 * unit]
    axes.plot(ends, [zero, zero], color="0.4", lw=0.5, dashes=(14, 3, 2, 3), zorder=2)
    last = -math.inf
    highest = max(*tops, _draw_stop(axes, lens, middle, unit))
    for element, outline, top in zip(elements, outlines, tops, strict=True):
        axes.add_patch(Polygon(outline, facecolor="#EAF2F7", edgecolor=INK, lw=0.8, zorder=1))
        # Labels of neighbours that are close go up in steps, so that none covers another.
        centre = float(outline[:, 0].mean())
        raised = centre - last < 7.0 * unit
        level = highest + (9.0 if raised else 5.0) * unit
        last = -math.inf if raised else centre
        axes.plot([centre, centre], [top - 1.0 * unit, level - 1.2 * unit], color="0.5", lw=0.4)
        axes.text(centre, level, element.name, fontsize=TEXT, ha="center", va="center")
    curve = sensor_curve(lens.system(), half)
    axes.plot(curve[:, 0] - middle[0], curve[:, 1] + zero, color=INK, lw=2.0, zorder=3)
    # Above the axis, whatever the sensor's size.
    label = zero + max(0.6 * half, 2.5 * unit)
    axes.text(z + 2.0 * unit, label, "sensor", fontsize=TEXT, va="center")
    system = lens.system().double()
    vertices = [float(v.detach()) - middle[0] for v in system.vertices]
    level = bottom - 6.0 * unit
    gap = f"{length(float(lens.sensor_distance.detach()))} to the sensor"
    total = f"{length(vertices[-1] - vertices[0])} from S1 to the sensor"
    wide = vertices[-1] - vertices[-2] > 40.0 * unit
    if wide:
        dimension(axes, (vertices[-2], zero), (z, zero - half), level, gap, False, False)
    dimension(
        axes,
        (vertices[0], zero),
        (z, zero - half),
        level - (6.5 if wide else 0.0) * unit,
        total,
        False,
        False,
    )


def _draw_stop(axes: Axes, lens: Lens, middle: np.ndarray, unit: float) -> float:
    """Draw the stop's edge above and below the axis; return the greatest height of the marks."""
    highest = -math.inf
    face = face_of(lens.system().double(), lens.stop)
    reach = face.aperture.edge.extent[1]
    for side in (1.0, -1.0):
        y = np.array([side * reach, side * (reach + 4.0 * unit)])
        z = np.full(2, float(face.height(np.array(0.0), np.array(reach))))
        points = face.to_lens(np.stack([np.zeros(2), y, z], -1)) - [0.0, middle[1], middle[0]]
        axes.plot(
            points[:, 2], points[:, 1], color="#B00020", lw=2.0, solid_capstyle="butt", zorder=4
        )
        highest = max(highest, float(points[:, 1].max()))
    return highest


def _notes(figure: Figure, lens: Lens, tolerances: ShopTolerances, continues: bool) -> None:
    line = lens.primary_wavelength
    order = lens.first_order(line, lens.object_distance)
    distance = lens.object_distance
    where = "at infinity"
    if distance is not None and math.isfinite(distance):
        where = f"{length(distance)} mm before S1"
    lines = [
        ("At the design wavelength", f"{line:g} nm"),
        ("Focal length", f"{length(float(order.efl.detach()), 3, 3)} mm"),
        ("Back focal distance", f"{length(float(order.bfd.detach()), 3, 3)} mm"),
        ("F-number", f"{float(order.f_number.detach()):.3f}"),
        ("Object", where),
        ("Sensor behind last surface", f"{length(float(lens.sensor_distance.detach()))} mm"),
    ]
    curvature = 0.0 if lens.sensor_curvature is None else float(lens.sensor_curvature.detach())
    if curvature != 0.0:
        radius = 1.0 / curvature
        lines.append(("Radius of the sensor", f"{length(radius)} mm"))
    if lens.sensor_diameter:
        lines.append(("Image circle", f"Ø {length(lens.sensor_diameter)} mm"))
    lines.append(("Stop", f"surface {lens.stop}, drawn in red"))
    lines += _poses(lens, tolerances)
    if continues:
        lines.append(("Surfaces", "go on on the next sheet"))
    if not tolerances.complete:
        lines.append(("Tolerances not given", AGREE))
    left, top = _NOTES
    step = min(0.022, 0.37 / len(lines))
    for row, (name, text) in enumerate(lines):
        y = top - step * row
        figure.text(left, y, name, fontsize=TEXT, color="0.3", va="center")
        figure.text(left + 0.125, y, text, fontsize=TEXT, va="center")


def _poses(lens: Lens, tolerances: ShopTolerances) -> list[tuple[str, str]]:
    """Return poses and their tolerances of the lens's elements, which are mounted as wholes."""
    rows = []
    for name, element in lens.elements.items():
        pose = []
        for key, value in element.named_parameters():
            number = float(value.detach())
            if number != 0.0:
                unit = "°" if key in TILTS else " mm"
                shown = math.degrees(number) if key in TILTS else number
                pose.append(f"{key} {shown:.4g}{unit}".replace("-", "−").replace("_", " "))
        surfaces = f"S{element.first}-S{element.last}"
        rows.append((f"{name} ({surfaces})", "; ".join(pose) or "centred"))
        groups = (("tilt", TILTS), ("decentre", DISPLACEMENTS[:2]), ("shift", DISPLACEMENTS[2:]))
        said = {}
        for word, keys in groups:
            found = [tolerances.labels.get(f"elements.{name}.{key}") for key in keys]
            known = [entry for entry in found if entry is not None]
            size, unit = max(known, default=(0.0, ""))
            said[word] = f"± {size:.3g}{unit if unit == '°' else ' ' + unit}" if known else AGREE
        if set(said.values()) == {AGREE}:
            rows.append(("", f"tilt, decentre, shift {AGREE}"))
        else:
            rows.append(("", f"tilt {said['tilt']}, shift {said['shift']}"))
            rows.append(("", f"decentre {said['decentre']}"))
    return rows
