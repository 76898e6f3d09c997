"""Rays of a search sample half of the pupil of a centred lens, for every field and wavelength.

Conditions say at which aperture, field and weights each lens is asked for at a stage.
"""

import math
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import torch
from torch import Tensor

from dolens.analysis.pupil_quadrature import gaussian_rings
from dolens.lens_search.specification import Specification


@dataclass(frozen=True)
class SearchRays:
    """What the rays of all lenses share.  F fields, N rays.

    A group is the light of one field of all wavelengths.  Then come groups of one ray each: chief
    rays at the reference wavelength, of the fields but the first and of those halfway to them from
    the one before, since distortion is greatest anywhere.

    Attributes:
        pupil: (N, 2), in radii of the entrance pupil, x ≥ 0.
        tangent: (N,), of the ray's field angle.
        weight: (N,), of spots: they sum to one over each group; of chief rays 1.
        group: (N,), int64.
        wavelength: (N,), int32.
        field: (N,), int64, which of the fields; of a chief ray between two the outer one.
        fields: F.
        chiefs: C chief rays.
    """

    pupil: Tensor
    tangent: Tensor
    weight: Tensor
    group: Tensor
    wavelength: Tensor
    field: Tensor
    fields: int
    chiefs: int

    @property
    def groups(self) -> int:
        """Return the number of groups."""
        return self.fields + self.chiefs

    @property
    def slopes(self) -> Tensor:
        """Return the tangents of the field angles, (F,)."""
        return torch.stack([self.tangent[self.group == n][0] for n in range(self.fields)])

    def at_rim(self, azimuths: int) -> "SearchRays":
        """Return rays of all fields and wavelengths through the half rim of the pupil.

        Args:
            azimuths: how many, from the lowest point to the highest.
        """
        azimuth = torch.linspace(-0.5 * math.pi, 0.5 * math.pi, azimuths, dtype=torch.float64)
        points = torch.stack([azimuth.cos(), azimuth.sin()], -1)
        beams = torch.unique(torch.stack([self.field, self.wavelength]), dim=1)
        field, wavelength = beams.repeat_interleave(azimuths, 1)
        count = len(field)
        return SearchRays(
            points.repeat(beams.shape[1], 1),
            self.slopes[field],
            torch.ones(count, dtype=torch.float64),
            field,
            wavelength.to(torch.int32),
            field,
            self.fields,
            0,
        )


def half_pupil(rings: int, arms: int, rim: bool = False) -> tuple[Tensor, Tensor]:
    """Return points of the half x ≥ 0 of the unit circle (N, 2) and weights that sum to one.

    Gaussian quadrature in r² (Forbes, J. Opt. Soc. Am. A 5, 1943, 1988): exact for even polynomials
    of degree up to 4·rings - 2 in r, and of harmonics below 2·arms.  With the rim it is Radau's,
    exact up to 4·rings - 4: polynomial surfaces can turn steeply beyond the outermost ray.

    Args:
        rings: radii.
        arms: azimuths of the half.
        rim: whether the outermost ring is the rim itself.
    """
    radius, shares = gaussian_rings(rings, rim)
    azimuth = -0.5 * math.pi + (np.arange(arms) + 0.5) * math.pi / arms
    around = torch.from_numpy(np.stack([np.cos(azimuth), np.sin(azimuth)], -1))
    points = radius[:, None, None] * around
    return points.reshape(-1, 2), (shares / arms).repeat_interleave(arms)


def search_rays(specification: Specification, rings: int = 4, arms: int = 8) -> SearchRays:
    """Sample all fields and wavelengths, each wavelength alike; of aspheres up to the rim.

    Args:
        specification: its fields and wavelengths.
        rings: of the pupil.
        arms: of its half.
    """
    points, shares = half_pupil(rings, arms, rim=any(specification.asphere_terms))
    waves, fields = len(specification.wavelengths), len(specification.fields)
    pupil, tangent, weight, group, wavelength = [], [], [], [], []
    tangents = [math.tan(math.radians(angle)) for angle in specification.fields]
    for number, slope in enumerate(tangents):
        for wave in range(waves):
            pupil.append(points)
            weight.append(shares / waves)
            tangent.append(torch.full((len(points),), slope, dtype=torch.float64))
            group.append(torch.full((len(points),), number))
            wavelength.append(torch.full((len(points),), wave, dtype=torch.int32))
    middle = torch.zeros((1, 2), dtype=torch.float64)
    one = torch.ones(1, dtype=torch.float64)
    owner = [torch.cat(group)]
    chiefs = 0
    for outer, (before, slope) in enumerate(pairwise(tangents), 1):
        for between in (0.5 * (before + slope), slope):
            pupil.append(middle)
            weight.append(one)
            tangent.append(between * one)
            group.append(torch.full((1,), fields + chiefs))
            owner.append(torch.full((1,), outer))
            wavelength.append(torch.full((1,), specification.reference, dtype=torch.int32))
            chiefs += 1
    return SearchRays(
        torch.cat(pupil),
        torch.cat(tangent),
        torch.cat(weight),
        torch.cat(group),
        torch.cat(wavelength),
        torch.cat(owner),
        fields,
        chiefs,
    )


def launched(
    rays: SearchRays, radius: Tensor, field: Tensor, pupils: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Return positions and directions (L, N, 3) on the plane of the entrance pupil, and the
    tangents of the field angles (L, N).

    Args:
        rays: N of them.
        radius: of the entrance pupil of each lens, mm, (L,).
        field: factor of the fields' tangents of each lens, (L,).
        pupils: of each field, (L, F, 6): see `dolens.lens_search.real_pupils`.
    """
    tangent = field[:, None] * rays.tangent
    shift, scale, bend, dip, across, keystone = pupils[:, rays.field].unbind(-1)
    px, py = rays.pupil.unbind(-1)
    x = px * (across + py * keystone)
    y = shift + py * (scale + py * bend) + px * px * dip
    return (*_rays(radius[:, None] * x, radius[:, None] * y, tangent), tangent)


def through_points(points: Tensor, tangent: Tensor) -> tuple[Tensor, Tensor]:
    """Return positions and directions (L, N, 3) of rays through points of the entrance pupil's
    plane.

    Args:
        points: (L, N, 2), mm.
        tangent: of the field angles, (L, N).
    """
    return _rays(points[..., 0], points[..., 1], tangent)


def _rays(x: Tensor, y: Tensor, tangent: Tensor) -> tuple[Tensor, Tensor]:
    cosine = torch.rsqrt(1.0 + tangent * tangent)
    zero = torch.zeros_like(cosine)
    position = torch.stack([x, y, zero], -1)
    return position, torch.stack([zero, tangent * cosine, cosine], -1)


@dataclass(frozen=True)
class Conditions:
    """What a lens is asked at some stage of its growth.

    Attributes:
        f_number: (L,).
        field: (L,), factor of the tangents of the field angles.
        field_weights: (L, F), ω.
        shifts: (L, O), added to the deviations of operands: the multipliers of the augmented
            Lagrangian over twice the weight, which let operands hold exactly at a small weight.
        pupils: (L, F, 6), where the beam of each field crosses the plane of the entrance pupil;
            see `dolens.lens_search.real_pupils`.
        beam: (L, S + 1), the beam's real height on each surface, and that of the axial beam at the
            stop, over its paraxial one.
    """

    f_number: Tensor
    field: Tensor
    field_weights: Tensor
    shifts: Tensor
    pupils: Tensor
    beam: Tensor

    def chosen(self, which: Tensor) -> "Conditions":
        """Return those of some lenses."""
        return Conditions(
            self.f_number[which],
            self.field[which],
            self.field_weights[which],
            self.shifts[which],
            self.pupils[which],
            self.beam[which],
        )


def beam_heights(specification: Specification, rays: SearchRays) -> Tensor:
    """Return how high the beam of each field is at the stop, over the stop, (F,).

    Apertures may clip the beam of the outermost field above and below until it is an ellipse of
    1 - v of the stop's area, v the vignetting allowed; of a field at the share t of its tangent
    until it has 1 - v·t².
    """
    slopes = rays.slopes
    widest = slopes.amax().clamp(min=1e-300)
    return 1.0 - specification.vignetting * (slopes / widest).square()


def paraxial_pupils(specification: Specification, rays: SearchRays) -> Tensor:
    """Return shift, scale, bend, dip, scale across and keystone of the beam of each field, (F, 6),
    on the plane of the entrance pupil: those of a pupil without aberrations.
    """
    heights = beam_heights(specification, rays)
    none, one = torch.zeros_like(heights), torch.ones_like(heights)
    return torch.stack([none, heights, none, none, one, none], -1)
