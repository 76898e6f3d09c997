"""Layouts of a lens at its own fields, before and after a change, and in each of its states."""

import math
from collections.abc import Mapping, Sequence

import torch
from matplotlib.figure import Figure

from dolens.analysis.conditions import Conditions
from dolens.errors import InputError
from dolens.optics.fields import field_label
from dolens.optics.lens import Lens
from dolens.optics.paraxial import entrance_pupil
from dolens.plotting.layout import (
    WIDTH,
    draw_layout,
    drawn_height,
    layout_drawing,
    layout_figure,
    layout_title,
    optics_text,
)
from dolens.plotting.style import (
    SMALL,
    caption,
    draw_axes_title,
    draw_title,
)


@torch.no_grad()
def lens_section_figure(
    lens: Lens, where: Conditions, rays: int = 7, title: str | None = None
) -> Figure:
    """Draw the section of a lens in the y-z plane with the rays of its fields in that plane.

    Args:
        lens: the lens.
        where: fields, of which those beside the y-z plane are left out; wavelengths, of which rays
            of the reference or nearest one are drawn; and object distance.
        rays: of each field.
        title: None for the lens, its aperture and the wavelength.

    Raises:
        InputError: see `layout_figure`.
    """
    nearest = (where.wavelengths - where.reference_wavelength).abs().argmin()
    wave = float(where.wavelengths[int(nearest)])
    heights = list(dict.fromkeys(y for x, y in where.fields.tolist() if x == 0.0)) or [0.0]
    angles = section_angles(lens, heights, wave, where.object_distance)
    if title is None:
        title = caption("Section", lens, where.at(wavelengths=wave))
    figure = layout_figure(lens, wave, angles, rays, where.object_distance, title)
    legend = figure.axes[0].get_legend()
    if legend is not None:
        for text, height in zip(legend.get_texts(), heights, strict=True):
            dark = " (no ray passes)" if "no ray" in text.get_text() else ""
            text.set_text(field_label((0.0, height), where.field_unit) + dark)
    return figure


def section_angles(
    lens: Lens, heights: Sequence[float], wavelength: float, object_distance: float | None
) -> list[float]:
    """Return the angles (degrees) of the chief rays of fields along y, as `layout_figure` takes
    them.

    Args:
        lens: the lens.
        heights: degrees, or mm on a near object.
        wavelength: nm.
        object_distance: mm in front of the first vertex; None for an object at infinity.
    """
    if object_distance is None:
        return list(heights)
    away = object_distance + float(entrance_pupil(lens.system().double(), wavelength).z)
    # Chief rays of a near object come down from a point above the axis.
    return [-math.degrees(math.atan(height / away)) + 0.0 for height in heights]


@torch.no_grad()
def before_after_figure(
    before: Lens,
    after: Lens,
    wavelength: float | Sequence[float] = 587.5618,
    fields_deg: Sequence[float] = (0.0,),
    rays: int = 7,
    object_distance: float | None = None,
    titles: tuple[str, str] | None = None,
) -> Figure:
    """Draw two layouts one above the other, at one scale and with their first vertices aligned.

    Args:
        before: drawn above.
        after: drawn below.
        wavelength: nm, as for `layout_figure`.
        fields_deg: degrees, as for `layout_figure`.
        rays: a field.
        object_distance: mm in front of the first vertex; None for an object at infinity.
        titles: of the two; None for `initial` and `final` with names, focal lengths and F-numbers.

    Raises:
        InputError: as `layout_figure` does.
    """
    lenses = (before, after)
    drawings = [
        layout_drawing(lens, wavelength, fields_deg, rays, object_distance) for lens in lenses
    ]
    z_limits = (
        min(drawing.z_limits[0] for drawing in drawings),
        max(drawing.z_limits[1] for drawing in drawings),
    )
    half_height = max(drawing.half_height for drawing in drawings)
    legend = any(drawing.needs_legend for drawing in drawings)
    height = min(drawn_height(z_limits, half_height, legend), 3.6)
    # The upper drawing has no numbers below.  Were there height to spare, constrained layout would
    # widen axes of equal scales until their labels leave the figure.
    figure = Figure(figsize=(WIDTH, 2.0 * height - 0.5), layout="constrained")
    grid = figure.subplots(2, 1, sharex=True, sharey=True)
    for number, (axes, lens, drawing) in enumerate(zip(grid, lenses, drawings, strict=True)):
        draw_layout(axes, drawing, z_limits, half_height, legend=number == 0)
        if titles is None:
            line = drawing.fans[0].wavelength
            stage = ("initial", "final")[number]
            name = layout_title(lens, drawing.system, line, object_distance, stage)
            title = f"({'ab'[number]}) {name}"
        else:
            title = titles[number]
        draw_axes_title(axes, title)
    grid[0].set_xlabel("")
    return figure


# Inches: of a section at the least, and of what stands beside it.
_LOWEST, _BESIDE, _HEADING = 0.9, 0.95, 0.45


@torch.no_grad()
def states_layout_figure(
    states: Mapping[str, Lens], rays: int = 5, title: str | None = None
) -> Figure:
    """Draw the sections of a lens in its states, one below the other at one scale.

    The sensors stand below each other, so that what moves between two drawings is a group of
    surfaces.  Each state has the rays of its own fields and object distance.

    Args:
        states: name → the lens in that state (`Lens.in_state`).
        rays: of each field.
        title: above all.

    Raises:
        InputError: there are no states, or one cannot be drawn; see `layout_figure`.
    """
    if not states:
        raise InputError("states_layout_figure needs one state or more")
    drawings, ends = {}, {}
    for name, lens in states.items():
        points = [(0.0, 0.0)] if lens.fields is None else lens.fields.points
        heights = list(dict.fromkeys(y for x, y in points if x == 0.0)) or [0.0]
        distance = lens.object_distance
        wave = lens.primary_wavelength
        angles = section_angles(lens, heights, wave, distance)
        drawings[name] = layout_drawing(lens, wave, angles, rays, distance)
        ends[name] = float(lens.system().vertices[-1])
    before = max(ends[name] - d.z_limits[0] for name, d in drawings.items())
    behind = max(d.z_limits[1] - ends[name] for name, d in drawings.items())
    half_height = max(drawing.half_height for drawing in drawings.values())
    drawn = (WIDTH - _BESIDE) * 2.0 * half_height / (before + behind)
    height = min(max(drawn, _LOWEST), 2.0) + _HEADING
    figure = Figure(figsize=(WIDTH, height * len(states) + 0.6), layout="constrained")
    grid = figure.subplots(len(states), 1, squeeze=False)[:, 0]
    for axes, (name, drawing) in zip(grid, drawings.items(), strict=True):
        limits = (ends[name] - before, ends[name] + behind)
        draw_layout(axes, drawing, limits, half_height, legend=False)
        lens = states[name]
        optics = optics_text(drawing.system, lens.primary_wavelength, lens.object_distance)
        if lens.object_distance is not None:
            optics += f", object at {lens.object_distance:.4g} mm"
        axes.set_title(f"{name}: {optics}", fontsize=SMALL + 1)
    for axes in grid[:-1]:
        axes.set_xlabel("")
    draw_title(figure, title)
    return figure
