"""A layout shows a lens in section with its rays: what is drawn, and the figure."""

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Polygon

from dolens.errors import InputError
from dolens.optics.lens import Lens
from dolens.optics.paraxial import first_order
from dolens.optics.system import OpticalSystem
from dolens.plotting.section import (
    SAMPLES,
    Profile,
    axis_angle,
    broken_axis,
    drawn_surfaces,
    glass_sections,
    obscuration_profiles,
    sensor_curve,
    sensor_line,
    stop_bars,
    surface_profile,
    trace_fan,
)
from dolens.plotting.style import (
    PAGE,
    SMALL,
    draw_axes_title,
    number_text,
    open_axes,
    ordered_colours,
    plain_text,
    spectral_colour,
    with_minus,
)

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
        sensor: mm, the sensor's extent in this section; None: that of the prescription.

    Returns:
        A figure of equal scale in y and z, in mm.

    Raises:
        InputError: there are no fields or rays, a field is not within ±90° (±180° of a lens with
            fields from the side), or the object is not in front of the entrance pupil and the first
            vertex.
    """
    drawing = layout_drawing(lens, wavelength, fields_deg, rays, object_distance, sensor)
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
    """Return focal length and working F-number, `f = 50.02 mm, F/4.91 at 587.6 nm`.

    That of an object at a finite distance is `working F/5.43`: it differs from the one that pages
    give of an object at infinity.
    """
    found = first_order(system, wavelength, object_distance)
    efl, f_number = float(found.efl), abs(float(found.working_f_number))
    if not math.isfinite(efl):
        return "afocal"
    working = "" if object_distance is None else "working "
    aperture = f", {working}F/{number_text(f_number)}" if math.isfinite(f_number) else ""
    return with_minus(f"f = {efl:.4g} mm{aperture} at {wavelength:.4g} nm")


def _depth(system: OpticalSystem, number: int) -> float:
    """Return the largest difference of sag along y, mm, in the surface's own axes."""
    surface = system.surfaces[number - 1]
    reach = surface.semi_diameter
    y = torch.linspace(-reach, reach, SAMPLES, dtype=torch.float64)
    sag, _, _, exists = surface.sag_and_slopes(torch.zeros_like(y), y)
    return float(np.ptp(sag[exists].numpy()))


def _draw_departure(axes: Axes, system: OpticalSystem, number: int) -> None:
    """Draw h(x, 0) and h(0, y) of a surface, in µm."""
    surface = system.surfaces[number - 1]
    t = torch.linspace(-surface.semi_diameter, surface.semi_diameter, SAMPLES, dtype=torch.float64)
    zero = torch.zeros_like(t)
    # The curves of x³ + y³ coincide: a thin one is drawn over a thick one.
    thick: dict[str, Any] = {"color": "#56B4E9", "linewidth": 3.0}
    thin: dict[str, Any] = {"color": "#D55E00", "linewidth": 1.2, "linestyle": "--"}
    for label, x, y, style in (
        ("along x, h(x, 0)", t, zero, thick),
        ("along y, h(0, y)", zero, t, thin),
    ):
        sag, _, _, exists = surface.sag_and_slopes(x, y)
        axes.plot(t[exists], 1e3 * sag[exists], label=label, **style)
    axes.set_xlabel("x or y (mm)", fontsize=SMALL + 1)
    axes.set_ylabel(f"sag h of surface {number} (µm)", fontsize=SMALL + 1)
    axes.grid(True, color="0.9", linewidth=0.6)
    axes.legend(frameon=False, fontsize=SMALL, loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=2)
    open_axes(axes)


# Rays start this far in front of the lens, in units of the distance from lens to sensor.
_LEAD = 0.1
_GLASS = "#D9E8F2"
_EDGE = "#2B3A42"


class Fan(NamedTuple):
    """A `Fan` holds rays of one field (degrees) and wavelength (nm): (rays, points, 3) in mm."""

    field: float
    wavelength: float
    paths: np.ndarray


class LayoutDrawing(NamedTuple):
    """A `LayoutDrawing` holds a section of a lens with its rays, mm.

    Attributes:
        system: the lens.
        profiles: of every surface, in the plane x = 0.
        fans: of every field and wavelength.
        height: the largest of the surfaces and of the sensor, from the axis.
        sensor: half of the sensor.
        z_limits: of axes that hold everything.
        half_height: of axes that hold everything.
    """

    system: OpticalSystem
    profiles: Sequence[Profile]
    fans: Sequence[Fan]
    height: float
    sensor: float
    z_limits: tuple[float, float]
    half_height: float

    @property
    def needs_legend(self) -> bool:
        """Return whether colours must be told apart, or a field has no rays."""
        return len(self.fans) > 1 or not len(self.fans[0].paths)


def layout_drawing(
    lens: Lens,
    wavelength: float | Sequence[float],
    fields_deg: Sequence[float],
    rays: int,
    object_distance: float | None = None,
    sensor: float | None = None,
) -> LayoutDrawing:
    """Section a lens and trace its rays; arguments and errors are those of `layout_figure`."""
    sensor = sensor or lens.sensor_diameter
    lines = [wavelength] if isinstance(wavelength, int | float) else list(wavelength)
    system = lens.system()
    _check(fields_deg, rays, lines, 180.0 if system.from_the_side else 90.0)
    profiles = [surface_profile(system, number) for number in range(1, len(system.surfaces) + 1)]
    # The sensor's middle, and the sections of all surfaces.
    back = float(np.concatenate([sensor_line(system, 0.0)[:, 0], *(z for z, _ in profiles)]).max())
    front = min((float(z.min()) for z, _ in profiles if len(z)), default=0.0)
    start = front - _LEAD * (back - min(front, 0.0))
    fans = [
        Fan(field, line, trace_fan(system, line, field, rays, object_distance, start))
        for field in fields_deg
        for line in lines
    ]
    height = max((float(np.abs(y).max()) for _, y in profiles if len(y)), default=1.0)
    height = max(height, 0.5 * (sensor or 0.0))
    reach = max(
        [height, *(float(np.abs(fan.paths[..., 1]).max()) for fan in fans if len(fan.paths))]
    )
    lit = [fan.paths for fan in fans if len(fan.paths)]
    if sensor:
        half = 0.5 * sensor
    elif system.breaks or system.mirrors:
        # What the rays need, seen along the sensor.
        middle, end = sensor_line(system, 0.0)[0], sensor_line(system, 1.0)[1]
        landed = [(paths[:, -1, [2, 1]] - middle) @ (end - middle) for paths in lit]
        half = 1.1 * max((float(np.abs(y).max()) for y in landed), default=0.1 * height)
        half = max(half, 0.05 * height)
    else:
        half = reach
    ends = sensor_curve(system, half)
    front = min([start, *(float(paths[..., 2].min()) for paths in lit), ends[:, 0].min()])
    back = max([back, *(float(paths[..., 2].max()) for paths in lit), ends[:, 0].max()])
    margin = 0.04 * (back - front)
    return LayoutDrawing(
        system,
        profiles,
        fans,
        height,
        half,
        (front - margin, back + margin),
        1.06 * max(reach, _stop_bar(system.stop, profiles, height), np.abs(ends[:, 1]).max()),
    )


def draw_layout(
    axes: Axes,
    drawing: LayoutDrawing,
    z_limits: tuple[float, float],
    half_height: float,
    legend: bool = True,
) -> None:
    """Draw into axes of the given limits (mm), at equal scales."""
    system, profiles = drawing.system, drawing.profiles
    if system.breaks:
        _draw_axis(axes, np.concatenate([[[z_limits[0], 0.0]], broken_axis(system)]))
    else:
        _draw_axis(axes, np.array([[z_limits[0], 0.0], [z_limits[1], 0.0]]))
    _draw_glass(axes, system, profiles)
    _draw_rays(axes, drawing.fans, legend)
    _draw_stop(axes, system, profiles, drawing.height)
    _draw_obscurations(axes, system)
    ends = sensor_curve(system, drawing.sensor)
    axes.plot(*ends.T, color="black", linewidth=2.5, gid="sensor", zorder=4)
    axes.set(aspect="equal", xlim=z_limits, ylim=(-half_height, half_height))
    axes.set_xlabel("z (mm)", fontsize=SMALL + 1)
    axes.set_ylabel("y (mm)", fontsize=SMALL + 1)
    open_axes(axes)


def _check(fields_deg: Sequence[float], rays: int, lines: Sequence[float], limit: float) -> None:
    if not lines:
        raise InputError("layout: at least one wavelength, not none")
    if rays < 1 or not fields_deg:
        raise InputError(f"layout: at least one field and one ray, not {len(fields_deg)}, {rays}")
    for field in fields_deg:
        if not abs(field) < limit:
            raise InputError(f"layout: fields must be within ±{limit:g} degrees, not {field:g}")


def _draw_axis(axes: Axes, points: np.ndarray) -> None:
    axes.plot(
        *points.T,
        color="0.55",
        linewidth=0.7,
        dashes=(12, 3, 2, 3),
        gid="axis",
        zorder=1,
    )


def _draw_glass(axes: Axes, system: OpticalSystem, profiles: Sequence[Profile]) -> None:
    """Fill and outline every element; surfaces that bound no glass (stops) have no curve."""
    for number, outline, edges in glass_sections(system, profiles):
        gid = f"glass {number}"
        axes.add_patch(Polygon(outline, facecolor=_GLASS, edgecolor="none", gid=gid, zorder=0))
        for edge in edges:
            axes.plot(*edge.T, color=_EDGE, linewidth=0.9, gid="edge", zorder=2)
    for number in drawn_surfaces(system, profiles):
        width = 2.2 if number in system.mirrors else 1.0
        gid = f"surface {number}"
        axes.plot(*profiles[number - 1], color=_EDGE, linewidth=width, gid=gid, zorder=2)


def _draw_rays(axes: Axes, fans: Sequence[Fan], legend: bool) -> None:
    if not fans:
        return
    lines = sorted({fan.wavelength for fan in fans})
    by_wavelength = len(lines) > 1
    keys = lines if by_wavelength else list(dict.fromkeys(fan.field for fan in fans))
    shades = [spectral_colour(line) for line in lines]
    shades = shades if by_wavelength else ordered_colours(len(keys))
    colour_of = dict(zip(keys, shades, strict=True))
    passing = dict.fromkeys(keys, False)
    for fan in fans:
        key = fan.wavelength if by_wavelength else fan.field
        passing[key] |= len(fan.paths) > 0
        for path in fan.paths:
            axes.plot(
                path[:, 2], path[:, 1], color=colour_of[key], linewidth=0.7, gid="ray", zorder=3
            )
    if not legend or (len(keys) == 1 and passing[keys[0]]):
        return
    unit = " nm" if by_wavelength else "°"
    handles = [
        Line2D(
            [],
            [],
            color=colour_of[key],
            linewidth=1.2,
            label=with_minus(f"{key:g}{unit}") + ("" if passing[key] else " (no ray passes)"),
        )
        for key in keys
    ]
    axes.legend(
        handles=handles,
        loc="center left",
        bbox_to_anchor=(1.0, 0.5),
        frameon=False,
        fontsize=SMALL,
        title="wavelength" if by_wavelength else "field",
        title_fontsize=SMALL,
    )


def _stop_bar(stop: int, profiles: Sequence[Profile], height: float) -> float:
    """Return the distance from the axis at which the stop's bars end, mm."""
    y = profiles[stop - 1][1]
    return (float(np.abs(y).max()) if len(y) else 0.0) + 0.2 * height


def _draw_stop(
    axes: Axes, system: OpticalSystem, profiles: Sequence[Profile], height: float
) -> None:
    """Draw bars outside the stop's edge, in its plane, with a tick along its axis at the edge."""
    profile = profiles[system.stop - 1]
    length = _stop_bar(system.stop, profiles, height)
    length -= float(np.abs(profile[1]).max(initial=0.0))
    angle = axis_angle(system, system.stop)
    tick = 0.025 * height * np.array([math.cos(angle), math.sin(angle)])
    for bar in stop_bars(system, profile, length):
        axes.plot(*bar.T, color="black", linewidth=2.0, solid_capstyle="butt", gid="stop", zorder=4)
        ends = np.stack([bar[0] - tick, bar[0] + tick]).T
        axes.plot(*ends, color="black", linewidth=1.2, gid="stop tick", zorder=4)


def _draw_obscurations(axes: Axes, system: OpticalSystem) -> None:
    for number in system.met:
        for profile in obscuration_profiles(system, number):
            axes.plot(*profile, color="black", linewidth=2.5, gid="obscuration", zorder=4)
