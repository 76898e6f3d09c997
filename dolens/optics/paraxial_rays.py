"""Paraxial rays through every surface: the marginal ray, the chief ray, and their invariant."""

from typing import NamedTuple

import torch
from torch import Tensor

from dolens.optics.paraxial import matrix_to_stop, ratio, vergence
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


def trace_paraxial(
    system: OpticalSystem, wavelength: float | Tensor, height: Tensor, slope: Tensor
) -> ParaxialRay:
    """Trace a paraxial ray: n'u' = nu - y(n' - n)c at a surface, y + t·u in a gap.

    Args:
        system: the lens.
        wavelength: nm.
        height: mm, on the first vertex plane.
        slope: before the first surface.
    """
    indices = system.indices(wavelength)
    heights, before, after = [], [], []
    for i, surface in enumerate(system.surfaces):
        if i:
            height = height + system.thicknesses[i - 1] * slope
        curvature = surface.shape.paraxial_curvature(surface.parameters)
        power = (indices[i + 1] - indices[i]) * curvature
        heights.append(height)
        before.append(slope)
        slope = (indices[i] * slope - height * power) / indices[i + 1]
        after.append(slope)
    return ParaxialRay(torch.stack(heights), torch.stack(before), torch.stack(after))


def marginal_ray(
    system: OpticalSystem,
    wavelength: float | Tensor,
    object_distance: float | Tensor | None = None,
) -> ParaxialRay:
    """From the axial object point to the edge of the stop, at positive height on surface 1.

    Args:
        system: the lens; its stop's semi-diameter is the aperture.
        wavelength: nm.
        object_distance: mm in front of the first vertex; None or `inf` for an object at infinity.
    """
    matrix = matrix_to_stop(system, wavelength)
    near = vergence(object_distance)
    at_stop = matrix[0, 0] + matrix[0, 1] * (system.indices(wavelength)[0] * near)
    radius = torch.full_like(at_stop, system.surfaces[system.stop - 1].semi_diameter)
    height = ratio(radius, at_stop.abs())
    return trace_paraxial(system, wavelength, height, height * near)


def chief_ray(
    system: OpticalSystem,
    wavelength: float | Tensor,
    field: float | Tensor,
    object_distance: float | Tensor | None = None,
) -> ParaxialRay:
    """From the edge of the field to the centre of the stop.

    Args:
        system: the lens.
        wavelength: nm.
        field: radians, the ray's slope being tan(field), for an object at infinity; else the height
            of the object point in mm, from which the ray comes down.
        object_distance: mm in front of the first vertex; None or `inf` for an object at infinity.
    """
    matrix = matrix_to_stop(system, wavelength)
    a, b = matrix[0, 0], matrix[0, 1]
    n = system.indices(wavelength)[0]
    near = vergence(object_distance)
    tangent = field_tangent(field, object_distance, matrix)
    at_stop = a + b * (n * near)
    # Height -bnT/(a + bn/d) and slope aT/(a + bn/d) meet the axis at the stop, a·y + b·n·u = 0,
    # and the object point, y - d·u = -d·T.
    height, slope = ratio(-b * n * tangent, at_stop), ratio(a * tangent, at_stop)
    return trace_paraxial(system, wavelength, height, slope)


def paraxial_rays(
    system: OpticalSystem,
    wavelength: float | Tensor,
    field: float | Tensor,
    object_distance: float | Tensor | None = None,
) -> ParaxialRays:
    """The marginal and the chief ray; for the arguments see there."""
    marginal = marginal_ray(system, wavelength, object_distance)
    chief = chief_ray(system, wavelength, field, object_distance)
    n = system.indices(wavelength)[0]
    u, u_chief = marginal.slope_before[0], chief.slope_before[0]
    invariant = n * (u * chief.height[0] - u_chief * marginal.height[0])
    return ParaxialRays(marginal, chief, invariant)
