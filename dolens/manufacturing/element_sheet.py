"""The sheet of one element: its section with dimensions, its surfaces and its glass."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Polygon

from dolens.manufacturing.drawing_numbers import (
    AGREE,
    ShopTolerances,
    clear_aperture_text,
    equation,
    is_aspheric,
    length,
    material_rows,
    number,
    sag_grid,
    sag_rows,
    surface_rows,
)
from dolens.manufacturing.drawing_sheet import (
    INK,
    TEXT,
    THICK,
    TitleBlock,
    dimension,
    draw_formula,
    drawing_axes,
    grid_table,
    new_sheet,
    per_paper_mm,
    table,
)
from dolens.manufacturing.glass_elements import Face, GlassElement

_SAMPLES = 201
# Paper (mm) around the section that dimensions take: left and right, above and below.
_ROOM = (78.0, 36.0)
_DRAWING = (0.03, 0.53, 0.60, 0.43)
_TABLE = (0.03, 0.125, 0.94, 0.395)


def element_sheet(
    element: GlassElement, tolerances: ShopTolerances, block: TitleBlock, place: int
) -> Figure:
    """Draw the sheet of one element.

    Args:
        element: any that has no fault.
        tolerances: what is known of them.
        block: the title block of the lens.
        place: number of the sheet.
    """
    outline = section(element)
    size = outline.max(0) - outline.min(0)
    # The scale is chosen on a sheet that is thrown away: the title block must name it.
    paper = [_DRAWING[2] * 297.0, _DRAWING[3] * 210.0]
    share = [1.0 - room / side for room, side in zip(_ROOM, paper, strict=True)]
    needs = (float(size[0]) / share[0], float(size[1]) / share[1])
    _, scale = drawing_axes(Figure(figsize=(11.69, 8.27)), _DRAWING, *needs)
    figure = new_sheet(block, place, f"{element.title}, {element.material.name}", scale)
    axes, _ = drawing_axes(figure, _DRAWING, *needs)
    _draw_section(axes, element, outline, tolerances)
    columns = (
        (f"Left surface S{element.front.number}", surface_rows(element, True, tolerances)),
        ("Material", material_rows(element, tolerances)),
        (f"Right surface S{element.back.number}", surface_rows(element, False, tolerances)),
    )
    table(figure, _TABLE, columns, (0.36, 0.28, 0.36))
    _side_panel(figure, element, tolerances)
    return figure


def section(element: GlassElement) -> np.ndarray:
    """Return the outline of the element's section in the plane x = 0 of its front, (N, 2): z, y."""
    sides = element.half_widths
    edge = element.semi_diameter if sides is None else sides[1]
    y = np.linspace(-edge, edge, _SAMPLES)
    front = element.front.height(np.zeros_like(y), y)
    thick = element.thickness(np.zeros_like(y), y)
    back = front + thick
    if element.conical_edge:
        inside = [np.abs(y) <= face.semi_diameter for face in (element.front, element.back)]
        front, back = (z[keep] for z, keep in zip((front, back), inside, strict=True))
        ys = [y[keep] for keep in inside]
    else:
        ys = [y, y]
    return np.concatenate([np.stack([front, ys[0]], -1), np.stack([back[::-1], ys[1][::-1]], -1)])


def _draw_section(
    axes: Axes, element: GlassElement, outline: np.ndarray, tolerances: ShopTolerances
) -> None:
    unit = per_paper_mm(axes)
    low, high = outline.min(0), outline.max(0)
    # The drawing stands a little left and low: most dimensions are right of it and above.
    middle = 0.5 * (low + high)
    points = outline - middle
    low, high = low - middle, high - middle
    axes.add_patch(
        Polygon(points, facecolor="#EAF2F7", edgecolor="0.75", hatch="///", lw=0.0, zorder=1)
    )
    axes.add_patch(Polygon(points, facecolor="none", edgecolor=INK, lw=THICK, zorder=2))
    axis = [low[0] - 6.0 * unit, high[0] + 6.0 * unit]
    axes.plot(axis, [-middle[1]] * 2, color="0.4", lw=0.5, dashes=(14, 3, 2, 3), zorder=2)
    edge = high[1]
    z, zero = element.centre_thickness - middle[0], -middle[1]
    for face, vertex, side in ((element.front, -middle[0], -1.0), (element.back, z, 1.0)):
        reach = face.aperture.edge.extent[1]
        rim = vertex + float(face.sag(np.array(0.0), np.array(reach)))
        level = (low[0] - 14.0 * unit) if side < 0.0 else (high[0] + 12.0 * unit)
        text = clear_aperture_text(face).split(",")[0].replace("Ø", "Øe")
        dimension(axes, (rim, zero - reach), (rim, zero + reach), level, text, True, side > 0.0)
        place = (vertex + side * 6.5 * unit, zero + 0.45 * edge)
        at = vertex + float(face.height(np.array(0.0), np.array(0.45 * edge)))
        arrow = {"arrowstyle": "-", "lw": 0.5, "color": "0.4"}
        axes.annotate(
            f"S{face.number}",
            (at, place[1]),
            (
                min(place[0], low[0] - 5.0 * unit)
                if side < 0
                else max(place[0], high[0] + 4.0 * unit),
                place[1],
            ),
            fontsize=TEXT,
            ha="center",
            va="center",
            arrowprops=arrow,
            zorder=4,
        )
    sides = element.half_widths
    whole = f"Ø {length(2.0 * element.semi_diameter)}"
    if sides is not None:
        whole = f"{length(2.0 * sides[0])} × {length(2.0 * sides[1])}"
    corners = [points[0], points[_SAMPLES - 1 if not element.conical_edge else -1]]
    right = points[points[:, 1] == points[:, 1].max()][:, 0].max()
    tolerance = tolerances.said("diameter")
    dimension(
        axes,
        (right, corners[0][1]),
        (right, edge),
        high[0] + 24.0 * unit,
        f"{whole}  ({tolerance})" if tolerance == AGREE else f"{whole} {tolerance}",
        True,
        True,
    )
    name = f"thicknesses.{element.front.number}"
    said = tolerances.of(name)
    centre = (
        f"{length(element.centre_thickness)}  ({said})"
        if said == AGREE
        else (f"{length(element.centre_thickness)} {said}")
    )
    dimension(axes, (-middle[0], zero), (z, zero), low[1] - 6.0 * unit, centre, False, False)
    top = points[np.abs(points[:, 1] - edge) < 1e-9 * (1.0 + abs(edge))]
    if not element.conical_edge and len(top) > 1:
        first, last = (float(top[:, 0].min()), edge), (float(top[:, 0].max()), edge)
        text = f"({length(element.edge_thickness, 3, 3)})"
        dimension(axes, first, last, high[1] + 6.0 * unit, text, False, True)


def _side_panel(figure: Figure, element: GlassElement, tolerances: ShopTolerances) -> None:
    """Put equations, sag tables and notes right of the section."""
    left, width, top = 0.655, 0.315, 0.95
    aspheric = [face for face in (element.front, element.back) if is_aspheric(face)]
    formulas = {face.number: equation(face) for face in aspheric}
    for formula in dict.fromkeys(filter(None, formulas.values())):
        names = ", ".join(f"S{number}" for number, text in formulas.items() if text == formula)
        figure.text(left, top - 0.018, f"{names}:", fontsize=TEXT, va="center")
        draw_formula(figure, (left + 0.05, top - 0.018), formula, TEXT + 1.0)
        top -= 0.048
    if len(aspheric) == 2 and all(face.shape.rotational for face in aspheric):
        half, height = 0.5 * width - 0.005, 0.23
        for face, at in zip(aspheric, (left, left + width - half), strict=True):
            _sag_table(figure, face, (at, top - height, half, height), False)
        top -= height + 0.012
    else:
        height = 0.24 / len(aspheric) if aspheric else 0.0
        for face in aspheric:
            _sag_table(figure, face, (left, top - height, width, height), len(aspheric) == 2)
            top -= height + 0.012
    notes = [
        "CX convex, CC concave. Øe is the clear aperture that the design uses.",
        "Thickness in brackets: for reference.",
    ]
    if element.conical_edge:
        notes.append("The edge is a cone between the two rims.")
    elif element.rotational and element.front.semi_diameter != element.back.semi_diameter:
        notes.append("The smaller surface ends in a flat ring, out to the edge.")
    if not element.aligned:
        notes.append("The two surfaces have axes of their own: see the assembly's poses.")
    if any(element.cemented):
        which = [n for n, is_cemented in zip("12", element.cemented, strict=True) if is_cemented]
        numbers = {"1": element.front.number, "2": element.back.number}
        notes.append("Cemented at " + " and ".join(f"S{numbers[n]}" for n in which) + ".")
    if any(face.aperture.obscuration for face in (element.front, element.back)):
        notes.append("The obscuration is a stop and no hole in the glass.")
    if not tolerances.complete:
        notes.append(f"In italics: {AGREE} with the workshop before anything is made.")
    step = min(0.018, (top - 0.54) / len(notes))
    for row, note in enumerate(notes[::-1]):
        figure.text(left, 0.538 + step * row, note, fontsize=TEXT - 0.5, color="0.25", va="center")


def _sag_table(
    figure: Figure, face: Face, box: tuple[float, float, float, float], small: bool
) -> None:
    if face.shape.rotational:
        radial = sag_rows(face, 9 if small else 13)
        heading = ("r (mm)", "sag z (mm)", "slope (°)")
        grid_table(figure, box, f"Sag of S{face.number}, z towards the right", [heading, *radial])
        return
    x, y, sag = sag_grid(face, 5 if small else 7)
    rows: list[tuple[str, ...]] = [("y \\ x", *(number(value, 3) for value in x))]
    for value, line in zip(y[::-1], sag[::-1], strict=True):
        numbers = ("" if np.isnan(z) else number(z, 6) for z in line)
        rows.append((number(value, 3), *numbers))
    grid_table(figure, box, f"Sag of S{face.number} (mm), z to the right, at x, y (mm)", rows)
