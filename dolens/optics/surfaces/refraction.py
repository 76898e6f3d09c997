"""Rays at a surface, and Snell's law."""

from typing import NamedTuple

import torch
from torch import Tensor

from dolens.kernels.operations import safe_sqrt
from dolens.kernels.table import LONGEST

# A ray this many semi-diameters off the axis is invalid, and stays there.
FAR = 1e3
# mm; tolerances are those of no larger a surface, however far its clear aperture is said to reach.
_LARGEST = 1e4


def tolerance_scale(semi_diameter: float) -> float:
    """Return the length, mm, that tolerances of a surface's intercepts are shares of."""
    return min(semi_diameter, _LARGEST)


class PlaneRay(NamedTuple):
    """Rays cross the vertex plane z = 0 at x, y (mm) with these direction cosines."""

    x: Tensor
    y: Tensor
    l: Tensor  # noqa: E741
    m: Tensor
    n: Tensor


class Refraction(NamedTuple):
    """Refraction gives direction cosines behind a surface, and a margin that is positive without
    TIR.
    """

    l: Tensor  # noqa: E741
    m: Tensor
    n: Tensor
    transmitted: Tensor


def snell(
    direction: tuple[Tensor, Tensor, Tensor],
    normal: tuple[Tensor, Tensor, Tensor],
    ratio: float | Tensor,
    sense: float,
) -> Refraction:
    """Refract directions by Snell's law in vector form.

    Args:
        direction: cosines of unit vectors.
        normal: unit vectors towards +z.
        ratio: μ, index before over index after, in the order of the light's travel.
        sense: s, the sign of d'·N behind the surface: +1 for light that leaves towards +z.  With
            the other sign than d·N, and μ = 1, light is reflected: d' = d - 2(d·N)N.

    Returns:
        d' = μ·d + (s·cos t - μ·cos i)·N with cos²t = 1 - μ²(1 - cos²i); `transmitted` is cos²t.
    """
    l, m, n = direction  # noqa: E741
    nx, ny, nz = normal
    cosine = torch.addcmul(torch.addcmul(l * nx, m, ny), n, nz)
    # Only rays that missed have |cos i| > 1; two keeps them finite and rounding unclipped.
    cosine = cosine.clamp(-LONGEST, LONGEST)
    squared = (1.0 - ratio * ratio) + (ratio * ratio) * (cosine * cosine)
    along = sense * safe_sqrt(squared) - ratio * cosine
    # Rays that missed have no unit normal; a direction that grew would overflow float32 later.
    return Refraction(
        torch.addcmul(ratio * l, along, nx).clamp(-LONGEST, LONGEST),
        torch.addcmul(ratio * m, along, ny).clamp(-LONGEST, LONGEST),
        torch.addcmul(ratio * n, along, nz).clamp(-LONGEST, LONGEST),
        squared.detach(),
    )
