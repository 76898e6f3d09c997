"""Operands of real chief rays: how far distortion and angles at the sensor exceed their limits."""

import math

from torch import Tensor

from dolens.lens_search.search_rays import SearchRays
from dolens.optics.lens_family import FamilyRays, FamilySums, LensFamily

# Limits are aimed at from within: the rays that a lens is checked with lie between those here, and
# the distortion of a lens with aspheres waves between them.
_WITHIN, _WITHIN_WAVES = 0.999, 0.985


def distortion(
    sums: FamilySums, rays: SearchRays, ideal: Tensor, limit: float, waves: bool
) -> tuple[Tensor, Tensor]:
    """Return how far distortion exceeds its limit (L, C), and derivatives (L, C, P + 1) with
    respect to the family's variables.

    Args:
        sums: of the rays, whose last groups are the chief rays.
        rays: C of them are chief rays.
        ideal: heights f·tan θ of the chief rays, mm, (L, C).
        limit: greatest |h/h₀ - 1|.
        waves: whether there are aspheres.
    """
    share = sums.group_residual[:, rays.fields :, 1] / ideal
    row = sums.group_jacobian[:, rays.fields :, 1] / ideal[..., None]
    return share.abs() - (_WITHIN_WAVES if waves else _WITHIN) * limit, share.sign()[
        ..., None
    ] * row


def chief_ray_angles(
    family: LensFamily, values: Tensor, rays: FamilyRays, limit: float
) -> tuple[Tensor, Tensor]:
    """Return by how much the sines of chief rays' angles at the sensor exceed that of their limit
    (L, C), and derivatives (L, C, P + 1) with respect to the family's variables.

    Args:
        family: of the lenses.
        values: the family's variables, (L, P + 1).
        rays: the chief rays, C of each lens.
        limit: greatest angle with the sensor's normal, degrees.
    """
    found = family.jacobians(values, rays, ("m",))
    sine = found.values[:, 0]
    most = math.sin(math.radians(_WITHIN * limit))
    return sine.abs() - most, sine.sign()[..., None] * found.derivatives[:, 0].mT
