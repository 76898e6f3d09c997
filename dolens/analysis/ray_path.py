"""One ray is followed from surface to surface, with the reason why it ends where it does."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from dolens.errors import InputError
from dolens.optics.elements import LENS_AXES, change_axes
from dolens.optics.field_and_aperture import in_double_precision
from dolens.optics.lens import Lens
from dolens.optics.rays import Components, Rays, Status
from dolens.optics.surfaces.refraction import PlaneRay, tolerance_scale
from dolens.optics.surfaces.state import SurfaceState
from dolens.optics.text_tables import html_table, printable, text_table
from dolens.optics.trace import Crossing as SurfaceCrossing
from dolens.optics.trace import (
    Trace,
    distance_to_plane,
    enter_lens,
    first_failure,
    trace_surfaces,
    trace_to_sensor,
    transfer,
)

HEADINGS = (
    *("surface", "x (mm)", "y (mm)", "z (mm)", "L", "M", "N"),
    *("incidence (°)", "height (mm)", "semi-diameter (mm)"),
)


@dataclass(frozen=True)
class Crossing:
    """A ray crosses a surface, or the sensor.

    Attributes:
        surface: its number and kind, or `sensor`.
        point: mm, in the lens's axes; on the sensor in its own, as `Lens.trace` gives it.
        direction: cosines behind it, in the same axes.
        incidence: degrees between the ray in front of it and the normal; NaN on the sensor.
        height: mm, distance from the surface's own vertex, across its axis.
        semi_diameter: mm, of the clear aperture; NaN on the sensor.
    """

    surface: str
    point: tuple[float, float, float]
    direction: tuple[float, float, float]
    incidence: float
    height: float
    semi_diameter: float

    def cells(self) -> list[str]:
        """Return a row of text below `HEADINGS`."""
        lengths = [f"{value:.6f}" for value in self.point]
        cosines = [f"{value:.8f}" for value in self.direction]
        own = (f"{self.incidence:.3f}", f"{self.height:.4f}", f"{self.semi_diameter:.4f}")
        return [self.surface, *lengths, *cosines, *("" if v == "nan" else v for v in own)]


@dataclass(frozen=True)
class RayPath:
    """The way of a ray through a lens; it shows itself as text or HTML.

    Attributes:
        heading: name of the lens, and the wavelength.
        crossings: of the surfaces and the sensor, as far as the ray goes.
        status: how it ends.
        ending: the same in words, with the numbers that decide.
    """

    heading: str
    crossings: tuple[Crossing, ...]
    status: Status
    ending: str

    def __repr__(self) -> str:
        """Return the table and the ending as text."""
        table = text_table(HEADINGS, [crossing.cells() for crossing in self.crossings])
        return f"{self.heading}\n{table}\n{self.ending}"

    def _repr_html_(self) -> str:
        """Return the table and the ending as HTML, all text escaped."""
        rows = [crossing.cells() for crossing in self.crossings]
        return html_table(HEADINGS, rows, self.heading, note=self.ending)


@torch.no_grad()
def ray_path(lens: Lens, rays: Rays) -> RayPath:
    """Follow one ray by the reference in double precision; see `Lens.trace` for what ends a ray.

    Args:
        lens: the lens.
        rays: one ray, from the object towards the sensor.

    Raises:
        InputError: more or fewer than one ray.
    """
    components = rays.components()
    if components.x.numel() != 1:
        raise InputError(f"a path is that of one ray, not of {components.x.numel()}")
    exact = in_double_precision(lens)
    system, wavelength = exact.system(), rays.wavelength
    if isinstance(wavelength, Tensor):
        wavelength = wavelength.reshape(())
    entering, _ = enter_lens(system, rays, 1, 1.0)
    ray = Components(*(c.reshape(()) for c in entering))
    landed = trace_to_sensor(system, trace_surfaces(system, ray, wavelength), wavelength)
    status, last = (int(value) for value in first_failure(landed))
    crossings: list[Crossing] = []
    ending = "sensor: the ray does not travel to it" if status else "the ray reaches the sensor"
    for number, surface in enumerate(system.surfaces, 1):
        if surface.shape.changes_axes:
            continue
        here, _ = change_axes(ray, LENS_AXES, system.axes[number - 1])
        sense, is_last = system.senses[number - 1], number == last
        if is_last and status == Status.MISSED:
            reason = _why_missed(surface, here, sense)
            if number - 1 in system.gradients:
                reason = "missed: the ray bends away from it, or leaves the gradient's medium"
            ending = f"surface {number}: {reason}"
            break
        met: list[SurfaceCrossing] = []
        step = trace_surfaces(
            *(system, ray, wavelength),
            record=True,
            first=number,
            last=number,
            crossings=met,
        )
        ray = step.ray
        crossings.append(_crossing(number, surface, met[0], step))
        if is_last and status == Status.TIR:
            indices = (
                met[0].indices if system.gradients else system.indices(wavelength)[number - 1 :]
            )
            reason = _why_reflected(indices, surface, crossings[-1])
            ending = f"surface {number}: {reason}"
            break
        if is_last:
            ending = (
                f"surface {number}: vignetted: {crossings[-1].height:.4f} mm from the axis, and "
                f"the clear aperture reaches {surface.semi_diameter:.4f} mm at most"
            )
    else:
        if status != Status.MISSED:
            x, y, z, l, m, n = (float(c) for c in landed.ray)  # noqa: E741
            height = math.hypot(x, y)
            crossings.append(Crossing("sensor", (x, y, z), (l, m, n), math.nan, height, math.nan))
    heading = f"{printable(exact.name) or 'Lens'}: a ray of {float(wavelength):g} nm"
    return RayPath(heading, tuple(crossings), Status(status), ending)


def _holds(margin: Tensor | None) -> bool:
    return margin is None or bool(margin > 0.0)


def _crossing(number: int, surface: SurfaceState, met: SurfaceCrossing, traced: Trace) -> Crossing:
    normal = surface.shape.normal(surface.parameters, *met.point)
    cosine = abs(sum(float(a) * float(b) for a, b in zip(normal, met.arriving, strict=True)))
    x, y, z = (float(c) for c in traced.points[-1])
    l, m, n = (float(c) for c in traced.ray[3:])  # noqa: E741
    return Crossing(
        f"{number} {surface.shape.kind}",
        (x, y, z),
        (l, m, n),
        math.degrees(math.acos(min(cosine, 1.0))),
        math.hypot(float(met.point[0]), float(met.point[1])),
        surface.semi_diameter,
    )


def _why_missed(surface: SurfaceState, here: Components, sense: float) -> str:
    """Say why a ray, in the surface's axes, does not meet it."""
    to_plane, towards = distance_to_plane(here, 0.0, sense)
    if not _holds(towards):
        return "missed: the ray travels along the vertex plane or away from it"
    shape, parameters = surface.shape, surface.parameters
    x, y, _, l, m, n = transfer(here, to_plane)  # noqa: E741
    scale = tolerance_scale(surface.semi_diameter)
    t, _ = shape.intersect(parameters, PlaneRay(x, y, l, m, n), sense, scale)
    x, y, z = x + l * t, y + m * t, n * t
    sag, sx, sy, exists = shape.sag_and_gradient(parameters, x, y)
    height = math.hypot(float(x), float(y))
    if not _holds(exists):
        return f"missed: {height:.4f} mm from the axis, beyond the end of the sag"
    if abs(float(sag - z)) > 1e-6 * scale:
        if shape.closed_form:
            return "missed: the ray passes beside the surface"
        return "missed: Newton's iteration found no intersection"
    if float(sense * (n - l * sx - m * sy)) <= 0.0:
        return "missed: the ray touches the surface and does not cross it in the sense of the light"
    return f"missed: {height:.4f} mm from the axis, beyond the sag branch of the vertex"


def _why_reflected(
    indices: Sequence[float | Tensor], surface: SurfaceState, crossing: Crossing
) -> str:
    """Say why no light of a ray goes on behind a surface; indices are those in front and behind."""
    if surface.deflection is not None:
        return (
            f"no light goes on: the {surface.deflection.law.kind}'s order is evanescent at "
            f"{crossing.incidence:.3f}° of incidence"
        )
    before, after = (abs(float(index)) for index in indices[:2])
    critical = math.degrees(math.asin(min(1.0, after / before)))
    return (
        f"total internal reflection: {crossing.incidence:.3f}° of incidence, beyond the critical "
        f"angle {critical:.3f}° ({before:.6f} to {after:.6f})"
    )
