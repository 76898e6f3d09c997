"""Real beams of the whole field are traced through a found lens, and measured on every surface."""

import math
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import NamedTuple

import torch
from torch import Tensor

from dolens.analysis.conditions import FieldScan, conditions, field_scans
from dolens.analysis.pupil_quadrature import uniform_pupil_points
from dolens.analysis.ray_intercepts import launch_through_stop
from dolens.errors import InputError
from dolens.optics.lens import Lens
from dolens.optics.materials import is_glass
from dolens.optics.ray_tracing import trace_rays
from dolens.optics.rays import arrives
from dolens.optics.surfaces.clear_aperture import Unlimited

# Field heights from the axis to the edge, and rays through the stop, besides those on its rim.
FIELDS, RAYS = 21, 400
# Degrees, or mm of a near object: the edge of the field of a lens for the axis alone.
_AXIS = 1e-4
# Radii at which the distance between two surfaces is taken.
RADII = 65
# What a drawn surface reaches beyond the rays.
_MARGIN = 1.02


class Space(NamedTuple):
    """A `Space` lies between two refracting surfaces.

    Attributes:
        first: number of the surface in front of it.
        last: number of the surface behind it.
        glass: whether it is filled with glass.
        centre: mm, its thickness on the axis.
        edge: mm, its least thickness out to the edge.
    """

    first: int
    last: int
    glass: bool
    centre: float
    edge: float


@dataclass(frozen=True)
class RealBeams:
    """Holds real beams of F fields and W wavelengths on S surfaces.

    Attributes:
        scan: the fields, from the axis to the edge along y.
        wavelengths: (W,), nm.
        failed: (F,), the share of the rays through the stop that miss a surface, are reflected
            totally or cannot be aimed.
        vignetted: (F,), the share that apertures clip.
        heights: (S,), mm, the largest distance from the axis of rays that pass; NaN without any.
        advance: mm, of the rays that pass, the least way along z from each refracting surface to
            the next, the last one to the sensor; below zero where surfaces cross within a beam.
        refracting: numbers of the refracting surfaces.
        stop_clearance: mm, likewise to a stop of its own from the surfaces beside it; infinite
            where the stop is on a refracting surface.
        marginal_sine: sine of the angle to the axis at the sensor of the outermost real ray from
            the axial object point, through the rim of the stop where nothing else clips it, at the
            wavelength nearest to the reference.
    """

    scan: FieldScan
    wavelengths: Tensor
    failed: Tensor
    vignetted: Tensor
    heights: Tensor
    advance: Tensor
    refracting: tuple[int, ...]
    stop_clearance: float
    marginal_sine: float


@torch.no_grad()
def real_beams(lens: Lens, count: int = FIELDS, rays: int = RAYS) -> RealBeams:
    """Trace beams through the physical stop, of fields from the axis to the edge of the lens's.

    Those of a lens for the axis alone stay at the axis, but for a rounding error.

    Args:
        lens: centred, in double precision, with fields.
        count: fields.
        rays: of each field and wavelength, a multiple of four.

    Raises:
        InputError: the lens is not centred.
    """
    system = lens.system()
    if system.breaks or system.mirrors or not system.rotationally_symmetric:
        raise InputError(f"lens '{lens.name}': found lenses are checked that are centred, of glass")
    where = conditions(lens)
    edge = None if bool(where.fields.any()) else _AXIS
    (scan,) = field_scans(lens, where.object_distance, edge, count)
    pupil, weight = uniform_pupil_points(rays)
    # The chief ray weighs nothing, and crosses where surfaces cross on the axis.
    pupil = torch.cat([pupil.new_zeros(1, 2), pupil])
    weight = torch.cat([weight.new_zeros(1), weight])
    reference = where.reference_wavelength
    waves = where.wavelengths
    launched = launch_through_stop(lens, where.at(scan.fields), pupil)
    hit = trace_rays(system, launched.rays, 1.0, True)
    assert hit.points is not None  # they were recorded
    failed = ~(arrives(hit.status) & launched.started)
    passes = hit.valid & launched.started
    points = torch.cat([hit.points, hit.position[None]])
    kept = passes.expand(points.shape[:-1])
    lowest = torch.full_like(points[..., 0], -math.inf)
    heights = torch.where(kept, points[..., :2].norm(dim=-1), lowest)[:-1].flatten(1).amax(1)
    z = torch.where(passes, points[..., 2], math.nan).flatten(1)
    refracting = tuple(n for n in range(1, len(system.surfaces) + 1) if system.refracts(n))
    advance = _least_steps(z[[*(n - 1 for n in refracting), -1]])
    beside = [n for n in (lens.stop - 1, lens.stop, lens.stop + 1) if 1 <= n <= len(z) - 1]
    apart = lens.stop not in refracting
    clearance = float(_least_steps(z[[n - 1 for n in beside]]).amin()) if apart else math.inf
    at = int((waves - reference).abs().argmin())
    sines = hit.direction[0, at, :, :2].norm(dim=-1)[passes[0, at]]
    return RealBeams(
        scan,
        waves,
        (failed * weight).sum(-1).amax(1),
        ((~failed & ~passes) * weight).sum(-1).amax(1),
        torch.where(heights >= 0.0, heights, math.nan),
        advance,
        refracting,
        clearance,
        float(sines.max()) if len(sines) else math.nan,
    )


@torch.no_grad()
def spaces(lens: Lens, heights: Tensor) -> tuple[Space, ...]:
    """Return the glass and air between refracting surfaces, the sensor's space left out.

    A surface ends where its beams do, and from there a flat leads out to the edge of its element,
    which is as high as the higher of the beams on its surfaces.  Where two elements face each
    other, they do so out to the lower of their edges.

    Args:
        lens: centred.
        heights: (S,), mm, of the beams on its surfaces.
    """
    system = lens.system().double()
    refracting = [n for n in range(1, len(system.surfaces) + 1) if system.refracts(n)]
    vertices = [float(z) for z in system.vertices]
    edges = _element_heights(lens, refracting, heights)
    found = []
    for first, last in pairwise(refracting):
        glass = is_glass(lens.materials[first])
        reach = [edges[n] for n in (first, last)]
        radii = torch.linspace(0.0, 1.0, RADII, dtype=torch.float64)
        radii = radii * (max(reach) if glass else min(reach))
        front, back = (
            sag_and_slope(lens, n, radii.clamp(max=float(heights[n - 1])))[0] for n in (first, last)
        )
        centre = vertices[last - 1] - vertices[first - 1]
        found.append(Space(first, last, glass, centre, float((centre + back - front).amin())))
    return tuple(found)


@torch.no_grad()
def with_drawn_heights(lens: Lens, heights: Tensor) -> Lens:
    """Return a copy of a lens whose surfaces that clip nothing are drawn as far as its beams go.

    Args:
        lens: stays as it is.
        heights: (S,), mm, of the beams on its surfaces; NaN leaves a surface as it is.
    """
    drawn = lens.storing_its_values().requires_grad_(False)
    for surface, height in zip(drawn.surfaces.values(), heights.tolist(), strict=True):
        if not surface.aperture.clips and height > 0.0:
            size = min(_MARGIN * height, surface.reach)
            surface.aperture = replace(surface.aperture, edge=Unlimited(size))
    return drawn


def _least_steps(z: Tensor) -> Tensor:
    """Return the least difference from each row to the next, of the rays (columns) that are no NaN;
    infinite without any.
    """
    return z.diff(dim=0).nan_to_num(math.inf).amin(1)


def _element_heights(lens: Lens, refracting: list[int], heights: Tensor) -> dict[int, float]:
    """Return the height of the element that each refracting surface is of, mm."""
    found: dict[int, float] = {}
    group: list[int] = []
    for number in refracting:
        group.append(number)
        if not is_glass(lens.materials[number]):
            height = max(float(heights[n - 1]) for n in group)
            found |= dict.fromkeys(group, height)
            group = []
    return found | {n: float(heights[n - 1]) for n in group}


def sag_and_slope(lens: Lens, number: int, radii: Tensor) -> tuple[Tensor, Tensor]:
    """Return the sag of a surface, counted from 1, at radii (N,), mm, and its derivative."""
    surface = lens.system().surfaces[number - 1]
    found = surface.sag_and_slopes(torch.zeros_like(radii), radii)
    return found[0], found[2]
