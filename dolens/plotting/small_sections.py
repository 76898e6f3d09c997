"""Small sections of many lenses are drawn side by side: forms of a lens, sheets of lenses."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from dolens.analysis.conditions import conditions
from dolens.errors import InputError
from dolens.optics.elements import to_lens_axes
from dolens.optics.fields import field_label
from dolens.optics.lens import Lens
from dolens.optics.rays import Rays
from dolens.optics.surfaces.clear_aperture import Unlimited
from dolens.plotting.layout import Fan, LayoutDrawing, draw_layout, layout_drawing
from dolens.plotting.style import (
    PAGE,
    PALETTE,
    SMALL,
    TITLE,
    number_text,
    ordered_colours,
    round_length,
)

# Of the line widths of a large drawing.
_LINES = 0.5
# Surfaces without an edge of their own are drawn so much farther than the rays go.
_MARGIN = 1.06


class SmallSection(NamedTuple):
    """A `SmallSection` holds a section of a lens with real rays, mm.

    Attributes:
        drawing: the section.
        z_limits: of axes that hold everything.
        half_height: of axes that hold everything.
    """

    drawing: LayoutDrawing
    z_limits: tuple[float, float]
    half_height: float


@torch.no_grad()
def small_section(lens: Lens, beams: Mapping[float, Sequence[float]]) -> SmallSection:
    """Section a lens, at its reference wavelength and object distance.

    Surfaces that clip nothing are drawn as far as the rays go.

    Args:
        lens: the lens.
        beams: field along y (degrees or mm) → heights on the stop, over its semi-diameter, of the
            rays that are drawn.
    """
    where = conditions(lens)
    wave, distance = where.reference_wavelength, where.object_distance
    paths = {field: _paths(lens, field, heights) for field, heights in beams.items()}
    drawing = layout_drawing(_fitted(lens, list(paths.values())), wave, (0.0,), 1, distance)
    start = drawing.z_limits[0]
    fans = [Fan(field, wave, _led(rays, start, drawing.height)) for field, rays in paths.items()]
    return SmallSection(drawing._replace(fans=fans), *_extent(drawing, fans))


def draw_small_section(axes: Axes, section: SmallSection) -> None:
    """Draw a section with thin lines into axes without ticks, at equal scales."""
    draw_layout(axes, section.drawing, section.z_limits, section.half_height, legend=False)
    for line in axes.lines:
        line.set_linewidth(_LINES * line.get_linewidth())
    axes.set(xlabel="", ylabel="", xticks=[], yticks=[])
    axes.set_axis_off()


def _paths(lens: Lens, field: float, heights: Sequence[float]) -> np.ndarray:
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
    fitted = lens.storing_its_values()
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


# The edge of the stop, over its semi-diameter, and heights at which rays are tried.
_RIM, _TRIALS = 0.999, 31
# Inches: between cells, and of the text above a section, of the strip below all, and of the title.
_GAP, _WORDS, _STRIP, _TITLE = 0.14, 0.34, 0.3, 0.32
# Inches that a section should be high, where there is more than one column.
_LOW = 0.62
_MOST_COLUMNS = 4
# Room about what is drawn, of its height; a share of a cell that the scale's bar may take.
_ROOM, _BAR = 1.04, 0.4
# Inches between the two lines above a section, and room behind a sensor, of a cell's width.
_LINE, _BEHIND = 0.15, 0.02
# Inches of a section that stands alone.
ALONE = 4.4


class FormPicture(NamedTuple):
    """A `FormPicture` is one form with the words above it.

    Attributes:
        section: of the form, from `form_section`.
        title: in bold, as `1`.
        words: behind the title.
        problem: in another colour, below; may be empty.
    """

    section: SmallSection
    title: str
    words: str = ""
    problem: str = ""


def forms_figure(
    forms: Sequence[FormPicture],
    columns: int | None = None,
    title: str | None = None,
    field_unit: str = "°",
) -> Figure:
    """Draw sections of forms in rows, all to one scale, with their sensors at the right.

    Args:
        forms: in the order that they are drawn, row by row.
        columns: how many lie side by side; None: as many as leave sections that can be read.
        title: above all.
        field_unit: of the fields.

    Raises:
        InputError: there are no forms.
    """
    if not forms:
        raise InputError("forms: there is no lens to draw")
    sections = [form.section for form in forms]
    width, tallest = common_size(sections)
    if columns is None:
        shape = 2.0 * tallest / width
        fits = [n for n in range(1, _MOST_COLUMNS + 1) if shape * _cell(n) >= _LOW]
        columns = min(max(fits, default=1), len(forms))
        columns = max(columns, min(2, len(forms)))
    cell = _cell(columns)
    rows = [sections[n : n + columns] for n in range(0, len(sections), columns)]
    halves = [max(section.half_height for section in row) for row in rows]
    heights = [_WORDS + cell * 2.0 * half / width for half in halves]
    above = _TITLE if title else 0.06
    whole = above + sum(heights) + _GAP * (len(rows) - 1) + _STRIP
    figure = Figure(figsize=(PAGE, whole))
    if title:
        figure.text(0.5, 1.0 - 0.07 / whole, title, fontsize=TITLE, ha="center", va="top")
    top = whole - above
    for number, (row, half, height) in enumerate(zip(rows, halves, heights, strict=True)):
        for place, section in enumerate(row):
            left, bottom = _GAP / 2 + place * (cell + _GAP), top - height
            axes = figure.add_axes(
                (left / PAGE, bottom / whole, cell / PAGE, (height - _WORDS) / whole)
            )
            _draw_form(section, axes, width, half)
            words = forms[number * columns + place]
            _write(figure, words, left / PAGE, top / whole, whole, cell / PAGE)
        top -= height + _GAP
    _scale(figure, cell / width, cell, whole)
    _fields(figure, sections[0], field_unit, whole)
    return figure


def form_figure(section: SmallSection, width: float, half_height: float) -> Figure:
    """Draw one section alone, its sensor at the right, to the scale that a width (mm) gives.

    Args:
        section: of the form.
        width: mm, from the left edge to the right one.
        half_height: mm.
    """
    figure = Figure(figsize=(ALONE, ALONE * 2.0 * half_height / width))
    _draw_form(section, figure.add_axes((0.0, 0.0, 1.0, 1.0)), width, half_height)
    return figure


def common_size(sections: Sequence[SmallSection]) -> tuple[float, float]:
    """Return the width and the half height, mm, of axes that hold any of the sections."""
    width = max(section.z_limits[1] - section.z_limits[0] for section in sections)
    return width, max(section.half_height for section in sections)


@torch.no_grad()
def form_section(lens: Lens) -> SmallSection:
    """Return the section of a form, with rays of all its fields along y.

    Three rays of a field bound its beam: through the edges of the stop, or, where apertures clip
    them, through the outermost points of the stop whose rays pass; and one between.
    """
    where = conditions(lens)
    fields = list(dict.fromkeys(y for x, y in where.fields.tolist() if x == 0.0)) or [0.0]
    section = small_section(lens, {field: _stop_heights(lens, field) for field in fields})
    # As high as lenses and rays are; the stop's bars may be higher, and are cut.
    drawn = [float(abs(y).max()) for _, y in section.drawing.profiles if len(y)]
    drawn += [
        float(abs(fan.paths[:, 1:, 1]).max()) for fan in section.drawing.fans if len(fan.paths)
    ]
    reach = _ROOM * max(drawn)
    sensor = min(section.drawing.sensor, reach)
    fans = [Fan(fan.field, fan.wavelength, _cut(fan.paths, reach)) for fan in section.drawing.fans]
    drawing = section.drawing._replace(sensor=sensor, fans=fans)
    return section._replace(drawing=drawing, half_height=reach)


def _stop_heights(lens: Lens, field: float) -> list[float]:
    """Return where the rays of a field that are drawn cross the stop, over its semi-diameter."""
    where = conditions(lens)
    tried = torch.linspace(-_RIM, _RIM, _TRIALS, dtype=lens.dtype)
    pupil = torch.stack((torch.zeros_like(tried), tried), -1)
    wave = where.reference_wavelength
    aimed = lens.aim((0.0, field), pupil, wave, where.object_distance)
    passing = tried[aimed.converged & lens.trace(Rays(aimed.position, aimed.direction, wave)).valid]
    if not len(passing):
        return []
    low, high = float(passing[0]), float(passing[-1])
    return [low, 0.5 * (low + high), high]


def _cut(paths: np.ndarray, reach: float) -> np.ndarray:
    """Return paths whose first point is no higher than the drawing."""
    paths = paths.copy()
    first, second = paths[:, 0], paths[:, 1]
    climb = abs(first[:, 1]) - abs(second[:, 1])
    share = ((reach - abs(second[:, 1])) / climb.clip(min=1e-12)).clip(0.0, 1.0)
    paths[:, 0] = second + (first - second) * share[:, None]
    return paths


def _cell(columns: int) -> float:
    """Return the width of a cell, inches."""
    return (PAGE - columns * _GAP) / columns


def _draw_form(section: SmallSection, axes: Axes, width: float, half_height: float) -> None:
    draw_small_section(axes, section)
    # Sensors of a column stand above one another, where no lens reaches beyond its own.
    margin = _BEHIND * width
    behind = max(float(z.max()) for z, _ in section.drawing.profiles if len(z))
    right = max(float(section.drawing.system.vertices[-1]), behind) + margin
    axes.set(xlim=(right - width, right), ylim=(-half_height, half_height))


def _write(
    figure: Figure, form: FormPicture, left: float, top: float, whole: float, width: float
) -> None:
    """Write two lines above a section: title and words, and what is not kept."""
    title = figure.text(left, top, form.title, fontsize=SMALL + 1, fontweight="bold", va="top")
    begin = title.get_window_extent().width / figure.bbox.width + 0.012
    words = figure.text(left + begin, top, form.words, fontsize=SMALL, va="top", color="0.25")
    taken = words.get_window_extent().width / figure.bbox.width
    if taken > width - begin:
        words.set_fontsize(SMALL * (width - begin) / taken)
    if not form.problem:
        return
    y = top - _LINE / whole
    text = figure.text(left, y, form.problem, fontsize=SMALL - 1, va="top", color=PALETTE[1])
    parts = form.problem.split(" ")
    while len(parts) > 1 and text.get_window_extent().width > width * figure.bbox.width:
        parts.pop()
        text.set_text(f"{' '.join(parts).rstrip(',')} …")


def _scale(figure: Figure, inches_a_mm: float, cell: float, whole: float) -> None:
    """Draw a bar of a round length at the lower left."""
    length = round_length(_BAR * cell / inches_a_mm)
    left, y = _GAP / 2 / PAGE, 0.12 / whole
    right = left + length * inches_a_mm / PAGE
    figure.add_artist(Line2D([left, right], [y, y], color="black", linewidth=2.0))
    text = f"{number_text(length)} mm"
    figure.text(right + 0.01, y, text, fontsize=SMALL, va="center")


def _fields(figure: Figure, section: SmallSection, unit: str, whole: float) -> None:
    """Name the colours of the fields at the lower right."""
    heights = list(dict.fromkeys(fan.field for fan in section.drawing.fans))
    handles = [
        Line2D([], [], color=shade, linewidth=1.2, label=field_label((0.0, height), unit))
        for shade, height in zip(ordered_colours(len(heights)), heights, strict=True)
    ]
    figure.legend(
        handles=handles,
        loc="center right",
        bbox_to_anchor=(1.0 - _GAP / 2 / PAGE, 0.12 / whole),
        ncols=len(handles),
        frameon=False,
        fontsize=SMALL,
        borderpad=0.0,
        borderaxespad=0.0,
        handlelength=1.4,
        columnspacing=1.2,
    )


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
        _draw_lens(axes, name, lens)
    return figure


def _draw_lens(axes: Axes, name: str, lens: Lens) -> None:
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
