"""Conditions say what each lens of a search is asked at some stage: aperture, field and weights."""

from dataclasses import dataclass

import torch
from torch import Tensor

from dolens.lens_search.search_rays import SearchRays
from dolens.lens_search.specification import Specification


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
