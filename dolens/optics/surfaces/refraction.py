"""Rays at a surface, and Snell's law."""

from typing import NamedTuple

from torch import Tensor

from dolens.kernels.refraction import refract

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
    l, m, n, squared = refract(*direction, *normal, ratio, sense)  # noqa: E741
    return Refraction(l, m, n, squared.detach())
