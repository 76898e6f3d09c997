"""Forms of a lens are drawn side by side, to one scale."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from dolens.analysis.conditions import conditions
from dolens.errors import InputError
from dolens.optics.fields import field_label
from dolens.optics.lens import Lens
from dolens.optics.rays import Rays
from dolens.plotting.drawing import Fan
from dolens.plotting.number_text import number_text
from dolens.plotting.scale_bar import round_length
from dolens.plotting.small_section import SmallSection, draw_small_section, small_section
from dolens.plotting.style import PAGE, PALETTE, SMALL, TITLE, ordered_colours

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
            _draw(section, axes, width, half)
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
    _draw(section, figure.add_axes((0.0, 0.0, 1.0, 1.0)), width, half_height)
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


def _draw(section: SmallSection, axes: Axes, width: float, half_height: float) -> None:
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
    begin = title.get_window_extent().width / figure.bbox.width
    figure.text(left + begin + 0.012, top, form.words, fontsize=SMALL, va="top", color="0.25")
    if not form.problem:
        return
    y = top - _LINE / whole
    text = figure.text(left, y, form.problem, fontsize=SMALL - 1, va="top", color=PALETTE[1])
    words = form.problem.split(" ")
    while len(words) > 1 and text.get_window_extent().width > width * figure.bbox.width:
        words.pop()
        text.set_text(f"{' '.join(words).rstrip(',')} …")


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
