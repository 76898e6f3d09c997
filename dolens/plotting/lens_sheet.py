"""A sheet shows small sections of many lenses, each at a scale of its own."""

import math
from collections.abc import Mapping

import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from dolens.analysis.conditions import conditions
from dolens.optics.lens import Lens
from dolens.plotting.number_text import number_text
from dolens.plotting.small_section import draw_small_section, small_section
from dolens.plotting.style import PAGE

_COLUMNS = 5
# Inches: a cell of the sheet, and the text in it.
_HEIGHT, _TEXT = 1.02, 5.2
# Heights on the stop, over its semi-diameter, of the rays of the axis and of the edge of the field:
# there lenses vignette, and prescriptions seldom say how much.
_AXIS, _EDGE = (-0.999, 0.0, 0.999), (-0.5, 0.0, 0.5)
# Half height over half width of the drawing's part of a cell.
_SHARE = 0.32


@torch.no_grad()
def lens_sheet_figure(lenses: Mapping[str, Lens], columns: int = _COLUMNS) -> Figure:
    """Draw sections of many lenses on a sheet, with rays of the axis and of the edge of the field.

    Rays of the edge fill the inner half of the stop, and surfaces that clip nothing are drawn as
    far as these rays go.  Each section has a scale of its own; its caption is the lens's name in
    the mapping, its focal length (mm), F-number and half field.

    Args:
        lenses: name → lens, in the order that they are drawn, row by row.
        columns: how many lie side by side.
    """
    rows = -(-len(lenses) // columns)
    figure = Figure(figsize=(PAGE, _HEIGHT * rows))
    grid = figure.subplots(rows, columns, squeeze=False)
    figure.subplots_adjust(0.004, 0.0, 0.996, 1.0, 0.03, 0.0)
    for axes in grid.flat:
        axes.set_axis_off()
    for axes, (name, lens) in zip(grid.flat, lenses.items(), strict=False):
        _draw(axes, name, lens)
    return figure


def _draw(axes: Axes, name: str, lens: Lens) -> None:
    where = conditions(lens)
    edge = max((y for x, y in where.fields.tolist() if x == 0.0), key=abs, default=0.0)
    section = small_section(lens, {0.0: _AXIS} | ({edge: _EDGE} if edge else {}))
    draw_small_section(axes, section)
    # The cell's upper part is the drawing, its lower part two lines of text.
    z, y = section.z_limits, section.half_height
    half = max(y, 0.5 * _SHARE * (z[1] - z[0]))
    axes.set(ylim=(-1.75 * half, 1.05 * half))
    axes.set_aspect("equal", adjustable="datalim")
    for height, text, grey in ((0.13, name, "0.0"), (0.02, _numbers(lens), "0.35")):
        axes.text(
            *(0.5, height, text),
            transform=axes.transAxes,
            fontsize=_TEXT,
            color=grey,
            ha="center",
            va="bottom",
        )


def _numbers(lens: Lens) -> str:
    where = conditions(lens)
    first = lens.first_order(where.reference_wavelength, where.object_distance)
    efl, f_number = abs(float(first.efl)), abs(float(first.working_f_number))
    field = float(where.fields.norm(dim=-1).max())
    parts = []
    if not math.isnan(efl):  # A cone has none.
        parts.append(f"f = {number_text(efl, 4)} mm" if efl < 1e9 else "afocal")
    if math.isfinite(f_number) and f_number < 1e6:
        parts.append(f"f/{number_text(f_number, 3)}")
    if field:
        unit = "°" if where.field_unit == "°" else " mm"
        parts.append(f"±{number_text(field, 3)}{unit}")
    return ", ".join(parts)
