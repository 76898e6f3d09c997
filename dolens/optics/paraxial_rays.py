"""Paraxial rays through every surface: the marginal ray, the chief ray, and their invariant."""

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from dolens.optics.paraxial import matrix_to_stop, ratio, vergence
from dolens.optics.paraxial_recurrence import TwoRays, through_surfaces
from dolens.optics.paraxial_surfaces import curvatures_of, powers_of
from dolens.optics.system import OpticalSystem


class ParaxialRay(NamedTuple):
    """A paraxial ray at every surface; each (surfaces,).

    Attributes:
        height: on the vertex plane, mm.
        slope_before: dy/dz in the medium before the surface.
        slope_after: dy/dz in the medium behind it.
    """

    height: Tensor
    slope_before: Tensor
    slope_after: Tensor


class ParaxialRays(NamedTuple):
    """The two rays that first-order optics is made of, and what they keep.

    Attributes:
        marginal: from the axial object point to the edge of the stop.
        chief: from the edge of the field to the centre of the stop.
        lagrange_invariant: H = n(u·ȳ - ū·y), mm, the same before and behind every surface (y, u of
            the marginal ray, ȳ, ū of the chief ray).  With the object at infinity -n·y·tan(field).
    """

    marginal: ParaxialRay
    chief: ParaxialRay
    lagrange_invariant: Tensor


def field_tangent(
    field: float | Tensor, object_distance: float | Tensor | None, like: Tensor
) -> Tensor:
    """Slope of the line from the object point to the first vertex.

    Args:
        field: angle in radians for an object at infinity; else the height of the object in mm.
        object_distance: mm in front of the first vertex, or None.
        like: whose precision and device the result has.
    """
    field = torch.as_tensor(field, dtype=like.dtype, device=like.device)
    near = torch.as_tensor(vergence(object_distance), dtype=like.dtype, device=like.device)
    # No branch on the value: a tensor of distances may hold an infinite one.
    return torch.where(near == 0.0, torch.tan(field), -field * near)


def paraxial_rays(
    system: OpticalSystem,
    wavelength: float | Tensor,
    field: float | Tensor,
    object_distance: float | Tensor | None = None,
) -> ParaxialRays:
    """Trace the marginal and the chief ray through every surface.

    The marginal ray has a positive height on surface 1; it meets the edge of the stop, whose
    semi-diameter is the aperture.

    Args:
        system: the lens.
        wavelength: nm.
        field: radians, the chief ray's slope being tan(field), for an object at infinity; else the
            height of the object point in mm, from which the chief ray comes down.
        object_distance: mm in front of the first vertex; None or `inf` for an object at infinity.
    """
    matrix = matrix_to_stop(system, wavelength)
    a, b = matrix[0, 0], matrix[0, 1]
    n = system.signed_indices(wavelength)
    near = vergence(object_distance)
    tangent = field_tangent(field, object_distance, matrix)
    at_stop = a + b * (n[0] * near)
    radius = torch.full_like(at_stop, system.surfaces[system.stop - 1].semi_diameter)
    y = ratio(radius, at_stop.abs())
    # The chief ray's height -bnT/(a + bn/d) and slope aT/(a + bn/d) meet the axis at the stop,
    # a·y + b·n·u = 0, and the object point, y - d·u = -d·T.
    chief_y, chief_u = ratio(-b * n[0] * tangent, at_stop), ratio(a * tangent, at_stop)

    start = TwoRays(y, chief_y, n[0] * (y * near), n[0] * chief_u)
    powers = powers_of(system, wavelength)
    behind = list(through_surfaces(start, curvatures_of(system), system.thicknesses, n, powers))
    reduced = [start, *behind]
    marginal = _ray([s.y for s in behind], [s.nu for s in reduced], n)
    chief = _ray([s.y2 for s in behind], [s.nu2 for s in reduced], n)
    invariant = start.nu * chief_y - start.nu2 * y
    return ParaxialRays(marginal, chief, invariant)


def _ray(
    heights: list[Tensor], reduced: list[Tensor], indices: Sequence[float | Tensor]
) -> ParaxialRay:
    """A ray from its heights and from its reduced slopes before and behind all surfaces."""
    slopes = torch.stack([nu / n for nu, n in zip(reduced, indices, strict=True)])
    return ParaxialRay(torch.stack(heights), slopes[:-1], slopes[1:])
