"""A layout shows a lens in section with its rays."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from torch import Tensor

from dolens.optics.lens import Lens
from dolens.optics.paraxial import first_order
from dolens.optics.system import OpticalSystem
from dolens.plotting.captions import plain_text
from dolens.plotting.drawing import draw_layout, layout_drawing
from dolens.plotting.number_text import number_text, with_minus
from dolens.plotting.style import PAGE, SMALL, open_axes
from dolens.plotting.surface_cut import SAMPLES, sag_of
from dolens.plotting.titles import draw_axes_title

# A sag below this share of the height of the drawing cannot be seen.
_VISIBLE = 0.02
# Inches.
WIDTH = PAGE


@torch.no_grad()
def layout_figure(
    lens: Lens,
    wavelength: float | Sequence[float] = 587.5618,
    fields_deg: Sequence[float] = (0.0,),
    rays: int = 7,
    object_distance: float | None = None,
    title: str | None = None,
    values: Mapping[str, Tensor] | None = None,
    sensor: float | None = None,
) -> Figure:
    """Draw the section of a lens in the y-z plane, with ray fans coloured by field or wavelength.

    Rays are aimed at the paraxial entrance pupil, spread evenly over the part of its plane whose
    rays reach the sensor, so that the outermost graze the apertures that limit the beam.  Rays
    that miss a surface, are reflected totally or clipped are not drawn.

    Elements with a pose are cut where they stand; rays that leave the plane x = 0 are seen along x.

    Artists carry gids: `ray`, `surface 3`, `glass 3` (the element behind surface 3), `edge`,
    `stop`, `stop tick`, `obscuration`, `sensor`, `axis`.

    Freeform plates whose sag is too small to be seen get axes of their own below, in µm; flat ones
    do not.

    Args:
        lens: the lens.
        wavelength: nm; several colour the rays by wavelength, one alone by field.
        fields_deg: angles of the chief rays in object space, from the axis towards +y, degrees.
        rays: rays a field; one alone is the chief ray.
        object_distance: mm in front of the first vertex; None for an object at infinity.
        title: None for the lens's name, focal length and F-number.
        values: lens parameters to use instead of the stored ones, as `Lens.system` takes them.
        sensor: mm, the sensor's extent in this section; None: that of the prescription.

    Returns:
        A figure of equal scale in y and z, in mm.

    Raises:
        InputError: there are no fields or rays, a field is not within ±90° (±180° of a lens with
            fields from the side), or the object is not in front of the entrance pupil and the first
            vertex.
    """
    drawing = layout_drawing(lens, wavelength, fields_deg, rays, object_distance, values, sensor)
    system = drawing.system
    plates = [
        number
        for number, surface in enumerate(system.surfaces, 1)
        if not surface.shape.rotational
        and 0.0 < _depth(system, number) < _VISIBLE * 2.0 * drawing.height
    ]
    drawn = drawn_height(drawing.z_limits, drawing.half_height, drawing.needs_legend)
    figure = Figure(figsize=(WIDTH, drawn + (1.9 if plates else 0.0)), layout="constrained")
    if plates:
        grid = figure.add_gridspec(2, 1, height_ratios=(drawn, 1.9))
        axes = figure.add_subplot(grid[0])
        below = grid[1].subgridspec(1, len(plates))
        for column, number in enumerate(plates):
            _draw_departure(figure.add_subplot(below[column]), system, number)
    else:
        axes = figure.add_subplot()
    draw_layout(axes, drawing, drawing.z_limits, drawing.half_height)
    line = drawing.fans[0].wavelength
    if title is None:
        title = layout_title(lens, system, line, object_distance)
    draw_axes_title(axes, title)
    return figure


def drawn_height(z_limits: tuple[float, float], half_height: float, legend: bool) -> float:
    """Return the height (inches) of a layout of the usual width at equal scales of both axes."""
    # What axes and legend take beside the drawing.
    beside = 0.95 + (0.9 if legend else 0.0)
    drawn = (WIDTH - beside) * 2.0 * half_height / (z_limits[1] - z_limits[0])
    return min(max(drawn, 1.0), 6.2) + 0.85


@torch.no_grad()
def lens_title(lens: Lens, object_distance: float | None = None) -> str:
    """Return the lens's name, focal length and F-number at its primary wavelength, for a title."""
    return layout_title(lens, lens.system(), lens.primary_wavelength, object_distance)


def layout_title(
    lens: Lens,
    system: OpticalSystem,
    wavelength: float,
    object_distance: float | None = None,
    stage: str | None = None,
) -> str:
    """Return the lens's name, its focal length at a wavelength in nm, and its working F-number.

    A stage, as `final`, stands behind the name.
    """
    optics = optics_text(system, wavelength, object_distance)
    name = ", ".join(part for part in (shown_name(lens), stage) if part)
    return f"{name}: {optics}" if name else optics


def shown_name(lens: Lens) -> str:
    """Return the lens's name without the `, initial` of a prescription where a search begins.

    A figure says itself whether it shows the lens before or after.
    """
    return plain_text(lens.name.removesuffix(", initial"))


def optics_text(
    system: OpticalSystem, wavelength: float, object_distance: float | None = None
) -> str:
    """Return focal length and working F-number, `f = 50.02 mm, F/4.91 at 587.6 nm`."""
    found = first_order(system, wavelength, object_distance)
    efl, f_number = float(found.efl), abs(float(found.working_f_number))
    if not math.isfinite(efl):
        return "afocal"
    aperture = f", F/{number_text(f_number)}" if math.isfinite(f_number) else ""
    return with_minus(f"f = {efl:.4g} mm{aperture} at {wavelength:.4g} nm")


def _depth(system: OpticalSystem, number: int) -> float:
    """Return the largest difference of sag along y, mm, in the surface's own axes."""
    reach = system.surfaces[number - 1].semi_diameter
    y = torch.linspace(-reach, reach, SAMPLES, dtype=torch.float64)
    sag, _, _, exists = sag_of(system, number, torch.zeros_like(y), y)
    return float(np.ptp(sag[exists].numpy()))


def _draw_departure(axes: Axes, system: OpticalSystem, number: int) -> None:
    """Draw h(x, 0) and h(0, y) of a surface, in µm."""
    semi_diameter = system.surfaces[number - 1].semi_diameter
    t = torch.linspace(-semi_diameter, semi_diameter, SAMPLES, dtype=torch.float64)
    zero = torch.zeros_like(t)
    # The curves of x³ + y³ coincide: a thin one is drawn over a thick one.
    thick: dict[str, Any] = {"color": "#56B4E9", "linewidth": 3.0}
    thin: dict[str, Any] = {"color": "#D55E00", "linewidth": 1.2, "linestyle": "--"}
    for label, x, y, style in (
        ("along x, h(x, 0)", t, zero, thick),
        ("along y, h(0, y)", zero, t, thin),
    ):
        sag, _, _, exists = sag_of(system, number, x, y)
        axes.plot(t[exists], 1e3 * sag[exists], label=label, **style)
    axes.set_xlabel("x or y (mm)", fontsize=SMALL + 1)
    axes.set_ylabel(f"sag h of surface {number} (µm)", fontsize=SMALL + 1)
    axes.grid(True, color="0.9", linewidth=0.6)
    axes.legend(frameon=False, fontsize=SMALL, loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=2)
    open_axes(axes)
