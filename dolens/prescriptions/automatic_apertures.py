"""Automatic semi-diameters: as far from the axis as the light of the fields goes.

A row that says `semi_diameter: auto` clips nothing, and a number is needed to draw the surface and
to set the scale of tolerances.  It is the largest height of real rays through the rim of the
entrance pupil, of all fields and wavelengths.  The real pupil of a wide field may lie far from the
paraxial one: where fewer than half of a field's rays get through, rays are aimed at the rim of the
stop instead.  Where no ray gets through at all, the height is the paraxial one.
"""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from dolens.optics.aiming import aim
from dolens.optics.elements import from_lens_axes
from dolens.optics.fields import Fields
from dolens.optics.lens import Lens
from dolens.optics.paraxial import vergence
from dolens.optics.ray_tracing import trace_rays
from dolens.optics.rays import Components, Rays, TracedRays
from dolens.optics.surfaces.clear_aperture import Unlimited
from dolens.optics.system import OpticalSystem
from dolens.prescriptions.apertures import is_automatic

# Points of the pupil's rim.
_RIM = 16
# Where nothing tells a size, mm.
_UNKNOWN = 1.0
# Of the light's height: a drawn semi-diameter below is not where the light is.
_TINY = 0.01


@torch.no_grad()
def set_automatic_semi_diameters(lens: Lens, prescription: Mapping[str, Any]) -> Lens:
    """Give the surfaces of a new lens the semi-diameters that its prescription leaves to the light.

    A surface that clips nothing is also drawn no farther than it reaches, whatever its prescription
    says, and where what it says is nothing beside the light, as far as the light goes.
    """
    rows = {str(n): row for n, row in prescription["surfaces"].items()}
    # The stop has its size from the pupil, and clips.
    others = [n for n in lens.surfaces if n in rows and n != str(lens.stop)]
    automatic = [n for n in others if is_automatic(rows[n])]
    automatic += _too_small(lens, [n for n in others if n not in automatic])
    if automatic:
        heights = _paraxial_heights(lens)
        for n in automatic:
            _resize(lens, n, heights[n])
        heights = heights | _real_heights(lens)
        for n in automatic:
            _resize(lens, n, heights[n])
    for n, surface in lens.surfaces.items():
        if not surface.aperture.clips and surface.semi_diameter > surface.reach:
            _resize(lens, n, surface.reach)
    return lens


def set_common_semi_diameters(lenses: Sequence[Lens], numbers: Iterable[str]) -> None:
    """Give automatic semi-diameters of states of one lens the largest value of all.

    Args:
        lenses: the lens as each of its states has it.
        numbers: of the surfaces.
    """
    for n in numbers:
        largest = max(lens.surfaces[n].semi_diameter for lens in lenses)
        for lens in lenses:
            _resize(lens, n, largest)


def _too_small(lens: Lens, numbers: Sequence[str]) -> list[str]:
    """Return the surfaces that clip nothing and whose semi-diameter cannot be meant for the light:
    programs give a tiny one to what is not to be drawn.
    """
    sizes = {n: surface.semi_diameter for n, surface in lens.surfaces.items()}
    free = [n for n in numbers if not lens.surfaces[n].aperture.clips]
    least = _TINY * max(sizes.values())
    small = [n for n in free if sizes[n] < least]
    heights = _paraxial_heights(lens) if small else {}
    return [n for n in small if sizes[n] < _TINY * heights[n]]


def _resize(lens: Lens, number: str, semi_diameter: float) -> None:
    surface = lens.surfaces[number]
    if not (math.isfinite(semi_diameter) and semi_diameter > 0.0):
        semi_diameter = _UNKNOWN
    edge = Unlimited(min(semi_diameter, surface.reach))
    surface.aperture = replace(surface.aperture, edge=edge)


def _fields(lens: Lens) -> Fields:
    if lens.fields is not None:
        return lens.fields
    return Fields("angles" if vergence(lens.object_distance) == 0.0 else "heights", ((0.0, 0.0),))


def _points(lens: Lens) -> Tensor:
    """Return the field points as `Lens.aim` takes them, (F, 2)."""
    fields = _fields(lens)
    points = torch.tensor(fields.points, dtype=lens.dtype)
    near = vergence(lens.object_distance)
    if fields.kind == "heights" or near == 0.0:
        return points
    return -torch.deg2rad(points).tan() / near


def _paraxial_heights(lens: Lens) -> dict[str, float]:
    """Return |y| + |ȳ| of the marginal and the chief ray at every surface; of fields from the side,
    which have no paraxial chief ray, the marginal ray's alone.
    """
    points = _points(lens)
    if _fields(lens).from_the_side:
        points = torch.where(points.abs() < 90.0, points, 0.0)
    field = float(points.norm(dim=-1).max())
    rays = lens.paraxial_rays(field, lens.primary_wavelength, lens.object_distance)
    heights = (rays.marginal.height.abs() + rays.chief.height.abs()).tolist()
    return dict(zip(lens.surfaces, heights, strict=True))


def _real_heights(lens: Lens) -> dict[str, float]:
    """Return the largest height of real rays at every surface: from every field to the rim of the
    paraxial entrance pupil, or of what vignetting factors leave of it.

    Light from the side never crosses that pupil, and of a wide field half the rays may miss: such
    rays are aimed at the rim of the stop.
    """
    points, fields = _points(lens), _fields(lens)
    pupil = lens.first_order(lens.primary_wavelength).entrance_pupil
    if not (fields.from_the_side or math.isfinite(float(pupil.z))):
        return {}
    angle = torch.arange(_RIM, dtype=lens.dtype) * (2.0 * math.pi / _RIM)
    rim = torch.stack((angle.sin(), angle.cos()), -1).expand(len(points), _RIM, 2)
    if fields.vignetting is not None:
        rim = torch.stack([of.on_stop(one) for of, one in zip(fields.vignetting, rim, strict=True)])
        rim = rim / rim.norm(dim=-1, keepdim=True).clamp(min=1.0)
    waves = torch.tensor(lens.wavelengths or (lens.primary_wavelength,), dtype=torch.float64)
    system = lens.system().opened().traced_by("reference")
    if fields.from_the_side:
        return _heights_of(system, [_aimed(lens, system, points, rim, waves)])
    # An inverted pupil has the rim of an upright one.
    at = torch.cat([0.5 * pupil.diameter * rim, pupil.z.expand(*rim.shape[:-1], 1)], -1)
    distance = lens.object_distance
    if distance is None or vergence(distance) == 0.0:
        towards = torch.cat([torch.deg2rad(points).tan(), torch.ones_like(points[:, :1])], -1)
        towards = towards[:, None].expand_as(at)
    else:
        start = torch.full_like(points[:, :1], -float(distance))
        towards = at - torch.cat([points, start], -1)[:, None]
        towards = torch.where(towards[..., 2:] < 0.0, -towards, towards)
    towards = towards / towards.norm(dim=-1, keepdim=True)
    traced = [trace_rays(system, Rays(at[:, :, None], towards[:, :, None], waves), 1.0, True)]
    missing = traced[0].valid.double().mean((1, 2)) < 0.5
    if bool(missing.any()):
        traced.append(_aimed(lens, system, points[missing], rim[missing], waves))
    return _heights_of(system, traced)


def _aimed(
    lens: Lens, system: OpticalSystem, points: Tensor, rim: Tensor, waves: Tensor
) -> TracedRays:
    """Trace rays of field points (F, 2) that are aimed at points (F, N, 2) of the stop."""
    field = _radians(lens, points)[:, None, None]
    rays = aim(system, field, rim[:, :, None], waves, lens.object_distance)
    hit = trace_rays(system, rays, 1.0, True)
    return replace(hit, valid=hit.valid & rays.converged)


def _heights_of(system: OpticalSystem, traced: Sequence[TracedRays]) -> dict[str, float]:
    """Return the largest height of rays at every surface; nothing where none gets through."""
    passed = torch.cat([h.points[:, h.valid] for h in traced if h.points is not None], 1)
    if not passed.shape[1]:
        return {}
    found = {}
    for number, (axes, point) in enumerate(zip(system.axes, passed, strict=True), 1):
        x, y, z = point.unbind(-1)
        local = from_lens_axes(Components(x, y, z, x, y, z), axes)
        found[str(number)] = float(torch.hypot(local.x, local.y).max())
    return found


def _radians(lens: Lens, points: Tensor) -> Tensor:
    """Return field points as `dolens.optics.aiming.aim` takes them: radians or mm."""
    return torch.deg2rad(points) if vergence(lens.object_distance) == 0.0 else points
