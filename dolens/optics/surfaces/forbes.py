"""Rotational aspheres in Forbes's orthogonal polynomials: Q_con and Q_bfs.

Q_bfs comes from its recurrence with auxiliary polynomials.

Source: Forbes, Robust, efficient computational methods for axially symmetric optical aspheres,
Opt. Express 18, 19700 (2010).
"""

import math
from collections.abc import Iterable, Iterator, Mapping
from functools import cache
from typing import Any

import numpy as np
import torch
from torch import Tensor

from dolens.kernels.surface_kernel import SurfaceKernel
from dolens.optics.surfaces.base import PackedShape, Parameters, Surface, by_names
from dolens.optics.surfaces.clear_aperture import ClearAperture
from dolens.optics.surfaces.conic import check_reach, conic_distance, conic_sag
from dolens.optics.surfaces.refraction import PlaneRay
from dolens.optics.surfaces.registry import order_of, order_pattern, register_surface
from dolens.optics.surfaces.zernike import jacobi, require_normalization_radius

_TERM = order_pattern("q", 0)
_KERNELS = ("dolens.kernels.cpu.forbes", "dolens.kernels.cuda.forbes")
# The square of the smallest cosine that the departure along the normal is divided by.
_STEEPEST = 1e-12


class ForbesSag(Surface):
    """The sag is that of a conic plus Σ q_m·Q_m(u²) times a prefactor, coefficients in mm.

    u = r/normalization_radius.  The polynomials are orthogonal for u ≤ 1.  They go on beyond, and
    the clear aperture may exceed the normalisation radius, but there a small coefficient is a large
    sag.
    """

    constants = ("normalization_radius",)

    def __init__(
        self,
        aperture: ClearAperture | float,
        parameters: Mapping[str, Any],
        dtype: torch.dtype = torch.float64,
    ) -> None:
        require_normalization_radius(parameters)
        super().__init__(aperture, parameters, dtype)

    def check_aperture(self) -> None:
        """Check that the clear aperture ends where the conic does: (1+k)·c²·r² ≤ 1."""
        check_reach(self)

    @classmethod
    def parameter_names(cls, keys: Mapping[str, object]) -> list[str]:
        """Return curvature, conic constant, the coefficients that the prescription names, by rising
        orders, and the normalisation radius.
        """
        orders = sorted(order for key in keys if (order := order_of(_TERM, key)) is not None)
        return ["curvature", "conic", *(f"q{order}" for order in orders), *cls.constants]

    @classmethod
    def start(cls, p: Parameters, ray: PlaneRay, sense: float) -> Tensor:
        """Return the conic's own intersection, or the vertex plane where that is out of reach."""
        c, k = p["curvature"], p["conic"]
        t, met = conic_distance(c, c + (c * k) * (ray.n * ray.n), ray, sense)
        return torch.where(met > 0.0, t, torch.zeros_like(t))


@register_surface
class QCon(ForbesSag):
    """The sag is conic + u⁴·Σ q_m·Q_m^con(u²).

    Q_m^con is the Jacobi polynomial P_m^(0, 4)(2u² - 1).
    Source: Forbes, Shape specification for axially symmetric optical surfaces, Opt. Express 15,
    5218 (2007).
    """

    kind = "q_con"
    kernel = SurfaceKernel(*_KERNELS)
    rotational = True

    @classmethod
    def sag_and_gradient(
        cls, p: Parameters, x: Tensor, y: Tensor
    ) -> tuple[Tensor, Tensor, Tensor, Tensor | None]:
        """Return sag and slopes, and the margin of the conic's branch."""
        r2 = torch.addcmul(x * x, y, y)
        sag, slope, exists = conic_sag(p["curvature"], p["conic"], r2)
        scale = 1.0 / p["normalization_radius"] ** 2
        q = r2 * scale
        total, derivative = _series(p, jacobi(q, 4, _count(p)), q)
        slope = slope + scale * q * (2.0 * total + q * derivative)
        return sag + q * q * total, 2.0 * x * slope, 2.0 * y * slope, exists

    @classmethod
    @by_names
    def packed(cls, p: Parameters) -> PackedShape:
        """Return c, k, no a2, the normalisation radius, and q0, q1, ...; columns: how many."""
        count = _count(p)
        numbers = (p["curvature"], p["conic"], None, p["normalization_radius"])
        return PackedShape((*numbers, *(p.get(f"q{m}") for m in range(count))), columns=count)


@register_surface
class QBfs(ForbesSag):
    """The sag is conic + u²·(1 - u²)·σ·Σ q_m·Q_m^bfs(u²).

    The departure is measured along the conic's normal, whose secant is σ = √(1 - k·c²r²)/
    √(1 - (1+k)·c²r²); with k = 0 the conic is the best-fit sphere of Forbes's definition.  The
    departure is zero at the vertex and at u = 1, and the mean square of its slope is Σ q_m² (over
    the normalisation radius).  The surface ends where the last root is 1e-6.
    Source: Forbes (2007, 2010), as `q_con` and `dolens.optics.surfaces.forbes`.
    """

    kind = "q_bfs"
    kernel = SurfaceKernel(*_KERNELS)
    rotational = True

    @classmethod
    def sag_and_gradient(
        cls, p: Parameters, x: Tensor, y: Tensor
    ) -> tuple[Tensor, Tensor, Tensor, Tensor | None]:
        """Return sag and slopes, and the margin of the conic's branch.

        With a = 1 - k·c²r² and b = a - c²r²: σ = √(a/b), and dσ/d(r²) = σ·c²/(2ab).
        """
        c, k = p["curvature"], p["conic"]
        r2 = torch.addcmul(x * x, y, y)
        sag, slope, _ = conic_sag(c, k, r2)
        scale = 1.0 / p["normalization_radius"] ** 2
        q = r2 * scale
        total, derivative = _series(p, q_bfs(q, _count(p)), q)
        turned = c * c * r2
        squared = 1.0 - (1.0 + k) * turned
        b = squared.clamp(min=_STEEPEST)
        a = b + turned
        secant = torch.sqrt(a / b)
        departure = q * (1.0 - q) * total
        along = scale * ((1.0 - 2.0 * q) * total + q * (1.0 - q) * derivative)
        slope = slope + secant * (along + (0.5 * (c * c)) * departure / (a * b))
        exists = squared.detach() - _STEEPEST
        return sag + departure * secant, 2.0 * x * slope, 2.0 * y * slope, exists

    @classmethod
    def packed(cls, p: Parameters) -> PackedShape:
        """Return c, k, no a2, the normalisation radius, and the coefficients of auxiliary
        polynomials; columns: how many; degree: 1.
        """
        count = _count(p)
        numbers = [p["curvature"], p["conic"], None, p["normalization_radius"]]
        if count:
            given = torch.stack([p.get(f"q{m}", _zero(p)) for m in range(count)])
            numbers.append(torch.from_numpy(to_auxiliary(count)).to(given) @ given)
        return PackedShape(tuple(numbers), columns=count, degree=1)


def _series(
    p: Parameters, polynomials: Iterable[tuple[Tensor, Tensor]], q: Tensor
) -> tuple[Tensor, Tensor]:
    """Return Σ q_m·Q_m and its derivative, from the polynomials with theirs, at q."""
    total, derivative = torch.zeros_like(q), torch.zeros_like(q)
    for m, (value, d) in enumerate(polynomials):
        if f"q{m}" in p:
            total = total + p[f"q{m}"] * value
            derivative = derivative + p[f"q{m}"] * d
    return total, derivative


def _count(p: Parameters) -> int:
    """Return one more than the highest order among the coefficients."""
    return max((int(m[1]) + 1 for name in p if (m := _TERM.fullmatch(name))), default=0)


def _zero(p: Parameters) -> Tensor:
    return torch.zeros_like(p["curvature"])


@cache
def _factors(count: int) -> tuple[tuple[float, ...], tuple[float, ...], tuple[float, ...]]:
    """Return f, g and h of P_m = f_m·Q_m + g_(m-1)·Q_(m-1) + h_(m-2)·Q_(m-2) for m < count."""
    f, g, h = [2.0, math.sqrt(19.0) / 2.0], [-0.5], []
    for m in range(2, count):
        h.append(-m * (m - 1) / (2.0 * f[m - 2]))
        g.append(-(1.0 + g[m - 2] * h[m - 2]) / f[m - 1])
        f.append(math.sqrt(m * (m + 1) + 3.0 - g[m - 1] ** 2 - h[m - 2] ** 2))
    return tuple(f), tuple(g), tuple(h)


def q_bfs(q: Tensor, count: int) -> Iterator[tuple[Tensor, Tensor]]:
    """Yield Q_m at q = u² and its derivative in q, for m = 0, 1, ..., count - 1.

    The auxiliary polynomials are P_0 = 2, P_1 = 6 - 8q, P_(m+1) = (2 - 4q)·P_m - P_(m-1).
    """
    f, g, h = _factors(count)
    zero = q * 0.0
    here, slope, after, after_slope = zero + 2.0, zero, 6.0 - 8.0 * q, zero - 8.0
    last: list[tuple[Tensor, Tensor]] = []
    for m in range(count):
        value, d = here, slope
        if m > 0:
            value, d = value - g[m - 1] * last[-1][0], d - g[m - 1] * last[-1][1]
        if m > 1:
            value, d = value - h[m - 2] * last[-2][0], d - h[m - 2] * last[-2][1]
        last = [*last[-1:], (value / f[m], d / f[m])]
        yield last[-1]
        factor = 2.0 - 4.0 * q
        here, slope, after, after_slope = (
            after,
            after_slope,
            factor * after - here,
            factor * after_slope - 4.0 * after - slope,
        )


@cache
def to_auxiliary(count: int) -> np.ndarray:
    """Return the matrix (count, count) that takes coefficients of Q_m to those of P_m/2.

    Σ a_m·Q_m = Σ b_m·P_m with P = L·Q, L banded, so that b = L^(-T)·a.  P_m/2 begins with 1.
    """
    f, g, h = _factors(count)
    banded = np.diag(f[:count])
    for m in range(1, count):
        banded[m, m - 1] = g[m - 1]
        if m > 1:
            banded[m, m - 2] = h[m - 2]
    return 2.0 * np.linalg.solve(banded, np.eye(count)).T
