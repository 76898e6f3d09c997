"""Real beams: where each field's beam enters so that it fills the stop, and how wide it becomes.

Where the entrance pupil has aberrations the beam of a field does not cross its plane in the
paraxial circle.  Rays at the middle of the stop and at five points of its rim say where it does:
the point (px, h·py) of the stop, in radii, is reached from

    x = r·px·(d + k·py),   y = r·(a + b·py + c·py² + e·px²)

on the plane of the paraxial entrance pupil of radius r, with h < 1 where a part of the field's beam
may be vignetted.  These six numbers of each field are held
while a lens is optimised, and found anew between rounds.
"""

from dataclasses import replace

import torch
from torch import Tensor

from dolens.lens_search.merit import SearchMerit
from dolens.lens_search.search_rays import Conditions, beam_heights, launched, through_points
from dolens.optics.lens_family import FamilyRays

# Of the beam at the stop, in its half axes: the middle, and the rim above, below, at the side and
# between these.
_SLANT = 0.5**0.5
_PROBES = torch.tensor(
    [[0.0, 0.0], [0.0, 1.0], [0.0, -1.0], [1.0, 0.0], [_SLANT, _SLANT], [_SLANT, -_SLANT]],
    dtype=torch.float64,
)
_STEPS = 6
# Rays that miss their points of the stop by more than this share of its radius are not believed.
_MISSED = 1e-3
# Of the half rim whose rays say how wide beams are; others reach a little farther.
_AZIMUTHS = 9
_ROOM = 1.003
# Real beams beyond these factors of the paraxial ones are not believed either.
_LEAST, _MOST = 0.5, 2.0


def with_real_beams(merit: SearchMerit, u: Tensor, conditions: Conditions) -> Conditions:
    """Return the conditions with pupils and beams as real rays have them; as they were for a lens
    whose rays fail.

    Args:
        merit: of the lenses.
        u: variables, (L, P).
        conditions: of the lenses.
    """
    f = merit.specification.focal_length
    _, first_order = merit.first_order(u)
    zero = torch.zeros(len(u), dtype=torch.float64)
    pupil = first_order.entrance_pupil + zero
    values = merit.lens_values(u, pupil)
    radius = 0.5 * f / conditions.f_number
    fields = merit.rays.fields
    tangent = (conditions.field[:, None] * merit.rays.slopes).repeat_interleave(len(_PROBES), 1)
    wavelength = torch.full((tangent.shape[1],), merit.specification.reference, dtype=torch.int32)
    stop = merit.arrangement.stop_place + 2

    def at(points: Tensor, surface: int) -> tuple[Tensor, Tensor]:
        position, direction = through_points(points, tangent)
        return merit.family.intercepts(values, FamilyRays(position, direction, wavelength), surface)

    # The stop is as wide as the axial beam is there.
    heights = beam_heights(merit.specification, merit.rays).repeat_interleave(len(_PROBES))
    probes = torch.stack([_PROBES[:, 0].repeat(fields), heights * _PROBES[:, 1].repeat(fields)], -1)
    rim = radius[:, None, None] * probes
    on_axis, _ = at(rim, stop)
    stop_radius = on_axis[:, 1, 1]
    wanted = stop_radius[:, None, None] * probes
    magnification = (first_order.stop_height + zero)[:, None, None]
    points, arrived = rim, on_axis
    slope = magnification.expand_as(points)
    for _ in range(_STEPS):
        step = -(arrived - wanted) / slope
        step = step.clamp(-0.5 * radius[:, None, None], 0.5 * radius[:, None, None])
        next_points = points + step
        there, _ = at(next_points, stop)
        # The secant's slope, where the step is large enough to tell.
        secant = (there - arrived) / torch.where(step == 0.0, 1.0, step)
        tells = (step.abs() > 1e-9 * radius[:, None, None]) & (
            (secant / magnification - 1.0).abs() < 0.9
        )
        slope = torch.where(tells, secant, slope)
        points, arrived = next_points, there
    _, valid = at(points, stop)
    error = (arrived - wanted).abs().amax(-1) / stop_radius.abs()[:, None]
    found = (valid & (error < _MISSED)).all(-1)
    at_rim = (points / radius[:, None, None]).unflatten(1, (fields, len(_PROBES)))
    middle, above, below = at_rim[..., 0, 1], at_rim[..., 1, 1], at_rim[..., 2, 1]
    pupils = torch.stack(
        [
            middle,
            0.5 * (above - below),
            0.5 * (above + below) - middle,
            at_rim[..., 3, 1] - middle,
            at_rim[..., 3, 0],
            # x at the slanting points is s·(d ± s·k), with s² = 1/2.
            at_rim[..., 4, 0] - at_rim[..., 5, 0],
        ],
        -1,
    )
    believed = torch.where(found[:, None, None], pupils, conditions.pupils)
    rim_rays = merit.rays.at_rim(_AZIMUTHS)
    position, direction, _ = launched(rim_rays, radius, conditions.field, believed)
    beams = FamilyRays(position, direction, rim_rays.wavelength)
    beam = []
    for number in range(merit.arrangement.surfaces):
        surface = merit.arrangement.sequence.index(number) + 2
        there, _ = merit.family.intercepts(values, beams, surface)
        expected = abs(first_order.marginal[number]) * radius / f + abs(
            first_order.chief[number]
        ) * tangent.amax(-1)
        beam.append(there.norm(dim=-1).amax(-1) / f / expected)
    beam.append((stop_radius / (radius * (first_order.stop_height + zero))).abs())
    factors = _ROOM * torch.stack(beam, -1)
    least = _LEAST * (1.0 - merit.specification.vignetting)
    found &= ((factors > least) & (factors < _MOST)).all(-1)
    return replace(
        conditions,
        pupils=torch.where(found[:, None, None], believed, conditions.pupils),
        beam=torch.where(found[:, None], factors, conditions.beam),
    )


def stop_radii(merit: SearchMerit, u: Tensor, conditions: Conditions) -> Tensor:
    """Return the stop's semi-diameters over f, (L,), by a real marginal ray."""
    f = merit.specification.focal_length
    pupil = merit.paraxial_of(u)[1]
    points = torch.zeros((len(u), 1, 2), dtype=torch.float64)
    points[:, 0, 1] = 0.5 * f / conditions.f_number
    position, direction = through_points(points, torch.zeros((len(u), 1), dtype=torch.float64))
    wavelength = torch.full((1,), merit.specification.reference, dtype=torch.int32)
    found, _ = merit.family.intercepts(
        merit.lens_values(u, pupil),
        FamilyRays(position, direction, wavelength),
        merit.arrangement.stop_place + 2,
    )
    return found[:, 0, 1].abs() / f
