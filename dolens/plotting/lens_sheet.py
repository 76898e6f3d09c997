"""A sheet shows small sections of many lenses, each at a scale of its own."""

import copy
import math
from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from dolens.analysis.conditions import conditions
from dolens.optics.elements import to_lens_axes
from dolens.optics.lens import Lens
from dolens.optics.rays import Rays
from dolens.optics.surfaces.clear_aperture import Unlimited
from dolens.plotting.drawing import Fan, LayoutDrawing, draw_layout, layout_drawing
from dolens.plotting.number_text import number_text
from dolens.plotting.style import PAGE

_COLUMNS = 5
# Inches: a cell of the sheet, and the text in it.
_HEIGHT, _TEXT = 1.02, 5.2
# Heights on the stop, over its semi-diameter, of the rays of the axis and of the edge of the field:
# there lenses vignette, and prescriptions seldom say how much.
_AXIS, _EDGE = (-0.999, 0.0, 0.999), (-0.5, 0.0, 0.5)
# Half height over half width of the drawing's part of a cell.
_SHARE = 0.32
# Of the line widths of a large drawing.
_LINES = 0.5
# Surfaces without an edge of their own are drawn so much farther than the rays go.
_MARGIN = 1.06


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
    wave, distance = where.reference_wavelength, where.object_distance
    edge = max((y for x, y in where.fields.tolist() if x == 0.0), key=abs, default=0.0)
    beams = {0.0: _AXIS} | ({edge: _EDGE} if edge else {})
    paths = {field: _paths(lens, field, heights) for field, heights in beams.items()}
    drawing = layout_drawing(_fitted(lens, list(paths.values())), wave, (0.0,), 1, distance)
    start = drawing.z_limits[0]
    fans = [Fan(field, wave, _led(rays, start, drawing.height)) for field, rays in paths.items()]
    z, y = _extent(drawing, fans)
    draw_layout(axes, drawing._replace(fans=fans), z, y, legend=False)
    for line in axes.lines:
        line.set_linewidth(_LINES * line.get_linewidth())
    # The cell's upper part is the drawing, its lower part two lines of text.
    half = max(y, 0.5 * _SHARE * (z[1] - z[0]))
    axes.set(ylim=(-1.75 * half, 1.05 * half), xlabel="", ylabel="")
    axes.set_aspect("equal", adjustable="datalim")
    axes.set_axis_off()
    for height, text, grey in ((0.13, name, "0.0"), (0.02, _numbers(lens), "0.35")):
        axes.text(
            *(0.5, height, text),
            transform=axes.transAxes,
            fontsize=_TEXT,
            color=grey,
            ha="center",
            va="bottom",
        )


def _paths(lens: Lens, field: float, heights: tuple[float, ...]) -> np.ndarray:
    """Return points (rays, points, 3), mm, of real rays that cross the stop at these heights.

    They are in the lens's axes, and on surfaces alone, not on coordinate breaks.  The first point
    lies on the first surface's side of the object, 1 mm in front of it.
    """
    where = conditions(lens)
    wave, distance = where.reference_wavelength, where.object_distance
    pupil = torch.tensor([(0.0, height) for height in heights], dtype=lens.dtype)
    aimed = lens.aim((0.0, field), pupil, wave, distance)
    rays = Rays(aimed.position, aimed.direction, wave)
    traced = lens.trace(rays, record=True)
    assert traced.points is not None  # they were recorded
    ok = aimed.converged & traced.valid
    system = lens.system()
    surfaces = [traced.points[number - 1] for number in system.met]
    # A traced ray is in the sensor's axes, with the z of an unfolded lens.
    end = traced.components()
    end = to_lens_axes(end._replace(z=end.z - system.vertices[-1]), system.all_axes[-1])
    sensor = torch.stack(end[:3], -1)
    points = torch.stack([surfaces[0] - rays.direction, *surfaces, sensor], -2)
    return points[ok].double().cpu().numpy()


def _led(paths: np.ndarray, start: float, longest: float) -> np.ndarray:
    """Return paths whose first point is where the drawing starts, or so far in front of the lens:
    rays of wide fields would leave the drawing.
    """
    paths = paths.copy()
    first, towards = paths[:, 1], paths[:, 1] - paths[:, 0]
    length = np.minimum((first[:, 2:] - start) / towards[:, 2:], longest)
    paths[:, 0] = first - length * towards
    return paths


def _fitted(lens: Lens, paths: list[np.ndarray]) -> Lens:
    """Return the lens with surfaces that clip nothing drawn as far as these rays go.

    Their own sizes hold whole beams of the edge of the field, which a real lens vignettes.
    """
    lit = [rays for rays in paths if len(rays)]
    if not lit or not lens.system().rotationally_symmetric:
        return lens
    fitted = copy.deepcopy(lens)
    heights = np.max([np.abs(rays[:, 1:-1, 1]).max(0) for rays in lit], 0)
    for height, surface in zip(heights, fitted.surfaces.values(), strict=True):
        if not surface.aperture.clips and height > 0.0:
            size = min(_MARGIN * float(height), surface.semi_diameter)
            surface.aperture = replace(surface.aperture, edge=Unlimited(size))
    return fitted


def _extent(drawing: LayoutDrawing, fans: list[Fan]) -> tuple[tuple[float, float], float]:
    """Return limits in z and the half height, mm, that hold the lens and its rays."""
    lit = [fan.paths for fan in fans if len(fan.paths)]
    reach = [drawing.half_height, *(float(np.abs(paths[..., 1]).max()) for paths in lit)]
    return drawing.z_limits, max(value for value in reach if math.isfinite(value))


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
