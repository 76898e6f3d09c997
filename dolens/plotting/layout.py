"""A lens in section, as its designer draws it."""

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Polygon
from torch import Tensor

from dolens.errors import InputError
from dolens.optics.lens import Lens
from dolens.optics.paraxial import first_order
from dolens.optics.surfaces.b_spline import BSpline
from dolens.optics.surfaces.xy_polynomial import XYPolynomial
from dolens.optics.system import OpticalSystem
from dolens.plotting.section import (
    SAMPLES,
    Profile,
    axis_angle,
    element_edges,
    obscuration_profile,
    sag_of,
    surface_profile,
    trace_fan,
)
from dolens.plotting.style import SMALL, TITLE, colours, open_axes, spectral_colour

# Rays start this far in front of the lens, in units of the distance from lens to sensor.
_LEAD = 0.1
# A sag below this share of the height of the drawing cannot be seen.
_VISIBLE = 0.02
_GLASS = "#D9E8F2"
_EDGE = "#2B3A42"
_WIDTH = 9.0


@torch.no_grad()
def layout_figure(
    lens: Lens,
    wavelength: float | Sequence[float] = 587.5618,
    fields_deg: Sequence[float] = (0.0,),
    rays: int = 7,
    object_distance: float | None = None,
    title: str | None = None,
    values: Mapping[str, Tensor] | None = None,
) -> Figure:
    """The section of a lens in the y-z plane, with fans of rays, coloured by field or wavelength.

    Rays are aimed at the paraxial entrance pupil, spread evenly over the part of its plane whose
    rays reach the sensor, so that the outermost graze the apertures that limit the beam.  Rays
    that miss a surface, are reflected totally or clipped are not drawn.

    Elements with a pose are cut where they stand; rays that leave the plane x = 0 are seen along x.

    Artists carry gids: `ray`, `surface 3`, `glass 3` (the element behind surface 3), `edge`,
    `stop`, `stop tick`, `obscuration`, `sensor`, `axis`.

    XY polynomials whose sag is too small to be seen get axes of their own below, in µm.

    Args:
        lens: the lens.
        wavelength: nm; several colour the rays by wavelength, one alone by field.
        fields_deg: angles of the chief rays in object space, from the axis towards +y, degrees.
        rays: rays a field; one alone is the chief ray.
        object_distance: mm in front of the first vertex; None for an object at infinity.
        title: None for the lens's name and focal length.
        values: lens parameters to use instead of the stored ones, as `Lens.system` takes them.

    Returns:
        A figure of equal scale in y and z, in mm.

    Raises:
        InputError: there are no fields or rays, a field is not within ±90°, or the object is not
            in front of the entrance pupil and the first vertex.
    """
    lines = [wavelength] if isinstance(wavelength, int | float) else list(wavelength)
    _check(fields_deg, rays, lines)
    system = lens.system(values)
    profiles = [surface_profile(system, number) for number in range(1, len(system.surfaces) + 1)]
    sensor_z = float(system.vertices[-1])
    front = min((float(z.min()) for z, _ in profiles if len(z)), default=0.0)
    start = front - _LEAD * (sensor_z - min(front, 0.0))
    fans = [
        Fan(field, line, trace_fan(system, line, field, rays, object_distance, start))
        for field in fields_deg
        for line in lines
    ]
    height = max((float(np.abs(y).max()) for _, y in profiles if len(y)), default=1.0)
    height = max(height, 0.5 * (lens.sensor_diameter or 0.0))

    plates = [
        number
        for number, surface in enumerate(system.surfaces, 1)
        if issubclass(surface.shape, (XYPolynomial, BSpline))
        and _depth(system, number) < _VISIBLE * 2.0 * height
    ]
    reach = max(
        [height, *(float(np.abs(fan.paths[..., 1]).max()) for fan in fans if len(fan.paths))]
    )
    z_low, z_high = start - 0.04 * (sensor_z - start), sensor_z + 0.04 * (sensor_z - start)
    half_height = 1.06 * max(reach, _stop_bar(system.stop, profiles, height))
    # Inches that axes and legend take beside the drawing, so that equal scales leave no gaps.
    legend = 0.8 if len(fans) > 1 or not len(fans[0].paths) else 0.0
    drawn = (_WIDTH - 0.75 - legend) * 2.0 * half_height / (z_high - z_low)
    drawn = min(max(drawn, 1.0), 6.2) + 0.85
    figure = Figure(figsize=(_WIDTH, drawn + (1.9 if plates else 0.0)), layout="constrained")
    if plates:
        grid = figure.add_gridspec(2, 1, height_ratios=(drawn, 1.9))
        axes = figure.add_subplot(grid[0])
        below = grid[1].subgridspec(1, len(plates))
        for column, number in enumerate(plates):
            _draw_departure(figure.add_subplot(below[column]), system, number)
    else:
        axes = figure.add_subplot()

    _draw_axis(axes, z_low, z_high)
    _draw_glass(axes, system, profiles)
    _draw_rays(axes, fans)
    _draw_stop(axes, system, profiles, height)
    _draw_obscurations(axes, system)
    half = 0.5 * lens.sensor_diameter if lens.sensor_diameter else reach
    axes.plot(
        [sensor_z, sensor_z], [-half, half], color="black", linewidth=2.5, gid="sensor", zorder=4
    )
    axes.set(aspect="equal", xlim=(z_low, z_high), ylim=(-half_height, half_height))
    axes.set_xlabel("z (mm)", fontsize=SMALL + 1)
    axes.set_ylabel("y (mm)", fontsize=SMALL + 1)
    open_axes(axes)
    axes.set_title(_title(lens, system, lines[0]) if title is None else title, fontsize=TITLE)
    return figure


class Fan(NamedTuple):
    """Rays of one field (degrees) and wavelength (nm): (rays, points, 3) in mm."""

    field: float
    wavelength: float
    paths: np.ndarray


def _check(fields_deg: Sequence[float], rays: int, lines: Sequence[float]) -> None:
    if not lines:
        raise InputError("layout: at least one wavelength, not none")
    if rays < 1 or not fields_deg:
        raise InputError(f"layout: at least one field and one ray, not {len(fields_deg)}, {rays}")
    for field in fields_deg:
        if not abs(field) < 90.0:
            raise InputError(f"layout: fields must be within ±90 degrees, not {field:g}")


def _title(lens: Lens, system: OpticalSystem, wavelength: float) -> str:
    efl = float(first_order(system, wavelength).efl)
    optics = f"f = {efl:.4g} mm at {wavelength:.4g} nm" if math.isfinite(efl) else "afocal"
    return f"{lens.name}: {optics}" if lens.name else optics


def _draw_axis(axes: Axes, z_low: float, z_high: float) -> None:
    axes.plot(
        [z_low, z_high],
        [0.0, 0.0],
        color="0.55",
        linewidth=0.7,
        dashes=(12, 3, 2, 3),
        gid="axis",
        zorder=1,
    )


def _draw_glass(axes: Axes, system: OpticalSystem, profiles: Sequence[Profile]) -> None:
    """Fill and outline every element; surfaces that bound no glass (stops) have no curve."""
    bounding: set[int] = set()
    for number in range(1, len(profiles)):
        if _is_glass(system, number):
            bounding |= {number, number + 1}
            faces = profiles[number - 1], profiles[number]
            if not (len(faces[0][0]) and len(faces[1][0])):
                continue
            top, bottom = element_edges(system, number, *faces)
            front, back = (np.stack(p, -1) for p in profiles[number - 1 : number + 1])
            outline = np.concatenate([front, top[1:-1], back[::-1], bottom[1:-1][::-1]])
            gid = f"glass {number}"
            axes.add_patch(Polygon(outline, facecolor=_GLASS, edgecolor="none", gid=gid, zorder=0))
            for edge in (top, bottom):
                axes.plot(*edge.T, color=_EDGE, linewidth=0.9, gid="edge", zorder=2)
    for number, (z, y) in enumerate(profiles, 1):
        refracts = system.materials[number - 1] != system.materials[number]
        if number in bounding or (refracts and number != system.stop):
            axes.plot(z, y, color=_EDGE, linewidth=1.0, gid=f"surface {number}", zorder=2)


def _is_glass(system: OpticalSystem, number: int) -> bool:
    return system.materials[number].name not in ("air", "occluder")


def _draw_rays(axes: Axes, fans: Sequence[Fan]) -> None:
    lines = sorted({fan.wavelength for fan in fans})
    by_wavelength = len(lines) > 1
    keys = lines if by_wavelength else list(dict.fromkeys(fan.field for fan in fans))
    shades = [spectral_colour(line) for line in lines] if by_wavelength else colours(len(keys))
    colour_of = dict(zip(keys, shades, strict=True))
    passing = dict.fromkeys(keys, False)
    for fan in fans:
        key = fan.wavelength if by_wavelength else fan.field
        passing[key] |= len(fan.paths) > 0
        for path in fan.paths:
            axes.plot(
                path[:, 2], path[:, 1], color=colour_of[key], linewidth=0.7, gid="ray", zorder=3
            )
    if len(keys) == 1 and passing[keys[0]]:
        return
    unit = " nm" if by_wavelength else "°"
    handles = [
        Line2D(
            [],
            [],
            color=colour_of[key],
            linewidth=1.2,
            label=f"{key:g}{unit}" if passing[key] else f"{key:g}{unit} (no ray passes)",
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
    """How far from the axis the stop's bars end, mm."""
    y = profiles[stop - 1][1]
    return (float(np.abs(y).max()) if len(y) else 0.0) + 0.2 * height


def _draw_stop(
    axes: Axes, system: OpticalSystem, profiles: Sequence[Profile], height: float
) -> None:
    """Bars outside the stop's rim, in its own plane, with a tick along its axis at the rim."""
    z, y = profiles[system.stop - 1]
    if not len(z):
        return
    angle = axis_angle(system, system.stop)
    along = np.array([math.cos(angle), math.sin(angle)])
    outwards = np.array([-along[1], along[0]])
    tick = 0.025 * height * along
    length = _stop_bar(system.stop, profiles, height) - float(np.abs(y).max())
    for end, side in ((-1, 1.0), (0, -1.0)):
        rim = np.array([z[end], y[end]])
        bar = np.stack([rim, rim + side * length * outwards]).T
        axes.plot(*bar, color="black", linewidth=2.0, solid_capstyle="butt", gid="stop", zorder=4)
        ends = np.stack([rim - tick, rim + tick]).T
        axes.plot(*ends, color="black", linewidth=1.2, gid="stop tick", zorder=4)


def _draw_obscurations(axes: Axes, system: OpticalSystem) -> None:
    for number in range(1, len(system.surfaces) + 1):
        profile = obscuration_profile(system, number)
        if profile is not None and len(profile[0]):
            axes.plot(*profile, color="black", linewidth=2.5, gid="obscuration", zorder=4)


def _depth(system: OpticalSystem, number: int) -> float:
    """Largest difference of sag along y, mm, in the surface's own axes."""
    reach = system.surfaces[number - 1].semi_diameter
    y = torch.linspace(-reach, reach, SAMPLES, dtype=torch.float64)
    sag, _, _, exists = sag_of(system, number, torch.zeros_like(y), y)
    return float(np.ptp(sag[exists].numpy()))


def _draw_departure(axes: Axes, system: OpticalSystem, number: int) -> None:
    """h(x, 0) and h(0, y) of a surface, in µm."""
    semi_diameter = system.surfaces[number - 1].semi_diameter
    t = torch.linspace(-semi_diameter, semi_diameter, SAMPLES, dtype=torch.float64)
    zero = torch.zeros_like(t)
    # The curves of x³ + y³ coincide: a thin one is drawn over a thick one.
    for label, x, y, style in (
        ("h(x, 0)", t, zero, {"color": "#56B4E9", "linewidth": 3.0}),
        ("h(0, y)", zero, t, {"color": "#D55E00", "linewidth": 1.2, "linestyle": "--"}),
    ):
        sag, _, _, exists = sag_of(system, number, x, y)
        axes.plot(t[exists], 1e3 * sag[exists], label=label, **style)
    axes.set_xlabel("x, y (mm)", fontsize=SMALL + 1)
    axes.set_ylabel("sag (µm)", fontsize=SMALL + 1)
    axes.set_title(f"Sag of surface {number}", fontsize=SMALL + 1)
    axes.grid(True, color="0.9", linewidth=0.6)
    axes.legend(frameon=False, fontsize=SMALL)
    open_axes(axes)
