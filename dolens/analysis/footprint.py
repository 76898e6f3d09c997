"""Footprints show where the beams of the fields meet every surface, within its clear aperture."""

from dataclasses import dataclass

import torch
from torch import Tensor

from dolens.analysis.conditions import Conditions
from dolens.analysis.pupil_quadrature import uniform_pupil_points
from dolens.analysis.ray_intercepts import launch_through_stop
from dolens.optics.elements import from_lens_axes
from dolens.optics.field_and_aperture import in_double_precision
from dolens.optics.lens import Lens
from dolens.optics.ray_tracing import trace_rays
from dolens.optics.rays import Components, Status
from dolens.optics.surfaces.clear_aperture import ClearAperture


@dataclass(frozen=True)
class Footprint:
    """Rays of F fields on S surfaces, N through each stop; float64 on the CPU.

    Attributes:
        fields: (F, 2), degrees or mm.
        field_unit: `°` for an object at infinity, else `mm`.
        wavelength: nm.
        surfaces: their numbers; coordinate breaks are left out.
        apertures: of each of them.
        points: (S, F, N, 2), mm in the surface's own axes, x and y about its vertex; NaN where a
            ray does not get there.
        passes: (F, N), bool: the ray passes all apertures and reaches the sensor.
        clipped: (S, F), the share of the rays through the stop that end at the surface: at its
            aperture, by total reflection or because they miss it.
        weight: (N,), share of a ray in the light through the stop; zero for rays on its rim.
        extent: (S, F), mm, the largest distance from the vertex of rays that pass; NaN where none
            does.
    """

    fields: Tensor
    field_unit: str
    wavelength: float
    surfaces: tuple[int, ...]
    apertures: tuple[ClearAperture, ...]
    points: Tensor
    passes: Tensor
    clipped: Tensor
    weight: Tensor
    extent: Tensor


@torch.no_grad()
def footprint(
    lens: Lens,
    where: Conditions,
    wavelength: float | None = None,
    rays: int = 1000,
) -> Footprint:
    """Trace rays spread uniformly over the stop, and tell where they meet each surface.

    Args:
        lens: the lens.
        where: fields and object distance.
        wavelength: nm; None for the reference wavelength.
        rays: of each field, a multiple of four, before apertures clip any.

    Raises:
        InputError: a wrong number of rays.
    """
    lens = in_double_precision(lens)
    wavelength = float(wavelength or where.reference_wavelength)
    pupil, weight = uniform_pupil_points(rays)
    launched = launch_through_stop(lens, where.at(wavelengths=wavelength), pupil)
    system = lens.system()
    hit = trace_rays(system, launched.rays, 1.0, True)
    started = launched.started[:, 0]
    numbers = tuple(int(n) for n, s in lens.surfaces.items() if not s.changes_axes)
    ended = torch.where(hit.valid, len(lens.surfaces) + 1, hit.surface)[:, 0]
    met = (hit.status == Status.OK) | (hit.status == Status.VIGNETTED)
    assert hit.points is not None  # they were recorded
    points, clipped = [], []
    for number in numbers:
        x, y, z = hit.points[number - 1][:, 0].unbind(-1)
        there = from_lens_axes(Components(x, y, z, x, y, z), system.axes[number - 1])
        # A ray that an aperture stops is shown there, outside of it, and no farther.
        arrives = started & ((ended > number) | ((ended == number) & met[:, 0]))
        local = torch.stack((there.x, there.y), -1)
        points.append(local.where(arrives[..., None], torch.nan))
        clipped.append((weight * (started & (ended == number)).cpu()).sum(-1))
    stacked = torch.stack(points).cpu()
    passes = (hit.valid[:, 0] & started).cpu()
    away = stacked.norm(dim=-1).where(passes, -torch.inf).amax(-1)
    return Footprint(
        where.fields,
        where.field_unit,
        wavelength,
        numbers,
        tuple(lens.surfaces[str(number)].aperture for number in numbers),
        stacked,
        passes,
        torch.stack(clipped),
        weight,
        away.where(away >= 0.0, torch.nan),
    )
