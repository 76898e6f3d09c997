"""Rotational aspheres in Forbes's orthogonal polynomials: Q_con and Q_bfs.

Q_bfs comes from its recurrence with auxiliary polynomials.

Source: Forbes, Robust, efficient computational methods for axially symmetric optical aspheres,
Opt. Express 18, 19700 (2010).
"""

import math
from collections.abc import Mapping
from functools import cache
from typing import Any

import numpy as np
import torch
from torch import Tensor

from dolens.kernels.operations import (
    Number,
    Series,
    by_radius,
    divide,
    fma,
    length,
    next_second,
    next_term,
    number,
    put,
    sqrt,
    term,
    where,
    zero,
)
from dolens.kernels.shapes import Shape
from dolens.kernels.table import Code
from dolens.optics.surfaces.base import PackedShape, Parameters, Surface
from dolens.optics.surfaces.clear_aperture import ClearAperture
from dolens.optics.surfaces.conic import (
    check_reach,
    conic_cotangents,
    conic_sag,
    conic_slopes,
    start_on_conic,
)
from dolens.optics.surfaces.refraction import PlaneRay
from dolens.optics.surfaces.registry import order_of, order_pattern, register_surface
from dolens.optics.surfaces.zernike import jacobi_step, require_normalization_radius

_TERM = order_pattern("q", 0)
# The square of the smallest cosine that the departure along the normal is divided by.
STEEPEST = 1e-12


def _step(k: Number, best_fit: Number) -> tuple[Number, Number, Number]:
    """Return (α, β, γ) of P_k = (α·q + β)·P_(k-1) - γ·P_(k-2), beginning with P_0 = 1.

    Those of Q_con (`best_fit` is 0.0) are Jacobi polynomials P_k^(0, 4)(2q - 1); the auxiliary ones
    of Q_bfs (1.0) have P_(-1) = -1.
    """
    fits = best_fit > 0.0
    alpha, beta, gamma = jacobi_step(k, 4.0)
    return where(fits, -4.0, alpha), where(fits, 2.0, beta), where(fits, 1.0, gamma)


def _total(b: Series, q: Number, like: Number, best_fit: Number) -> tuple[Number, Number]:
    """Return T = Σ b_k·P_k(q) and T'; `like` is a number of the surface's."""
    t, t1 = zero(q), zero(q)
    p, d, p_below, d_below = zero(q) + 1.0, zero(q), zero(q) - best_fit, zero(q)
    for i in range(length(b)):
        t = fma(term(b, i), p, t)
        t1 = fma(term(b, i), d, t1)
        alpha, beta, gamma = _step(number(i + 1, like), best_fit)
        p, d, p_below, d_below = next_term(alpha, beta, gamma, q, p, d, p_below, d_below)
    return t, t1


def _total_second(
    b: Series, q: Number, like: Number, best_fit: Number
) -> tuple[Number, Number, Number]:
    """Return T, T' and T''; see `_total`."""
    t, t1, t2 = zero(q), zero(q), zero(q)
    p, d, e = zero(q) + 1.0, zero(q), zero(q)
    p_below, d_below, e_below = zero(q) - best_fit, zero(q), zero(q)
    for i in range(length(b)):
        t = fma(term(b, i), p, t)
        t1 = fma(term(b, i), d, t1)
        t2 = fma(term(b, i), e, t2)
        alpha, beta, gamma = _step(number(i + 1, like), best_fit)
        e, e_below = next_second(alpha, beta, gamma, q, d, e, e_below)
        p, d, p_below, d_below = next_term(alpha, beta, gamma, q, p, d, p_below, d_below)
    return t, t1, t2


def _put_terms(
    cotangents: Any, b: Series, q: Number, like: Number, best_fit: Number,
    of_value: Number, of_slope: Number,
) -> None:  # fmt: skip
    """Give the cotangents of the coefficients, of_value·P_k + of_slope·P_k', and of the radius."""
    put(cotangents, 2, zero(q))
    p, d, p_below, d_below = zero(q) + 1.0, zero(q), zero(q) - best_fit, zero(q)
    for i in range(length(b)):
        put(cotangents, 3 + i, of_value * p + of_slope * d)
        alpha, beta, gamma = _step(number(i + 1, like), best_fit)
        p, d, p_below, d_below = next_term(alpha, beta, gamma, q, p, d, p_below, d_below)


def q_con_sag(p: Any, x: Number, y: Number) -> tuple[Number, Number, Number, Number]:
    """Return sag and slopes, and the margin of the conic's branch."""
    c, k, radius, b = p
    r2 = fma(x, x, y * y)
    scale = divide(1.0, radius * radius)
    sag, slope, margin = conic_sag(c, k, r2)
    q = r2 * scale
    t, t1 = _total(b, q, c, 0.0)
    slope = 2.0 * fma(scale * q, fma(q, t1, 2.0 * t), slope)
    return fma(q * q, t, sag), x * slope, y * slope, margin


def q_con_hessian(p: Any, x: Number, y: Number) -> tuple[Number, Number, Number, Number, Number]:
    """Return slopes and second derivatives."""
    c, k, radius, b = p
    r2 = fma(x, x, y * y)
    scale = divide(1.0, radius * radius)
    slope, second = conic_slopes(c, k, r2)
    q = r2 * scale
    t, t1, t2 = _total_second(b, q, c, 0.0)
    slope = slope + scale * q * (2.0 * t + q * t1)
    return by_radius(x, y, slope, second + scale * scale * (2.0 * t + q * (4.0 * t1 + q * t2)))


def q_con_parameters(
    cotangents: Any, p: Any, x: Number, y: Number, of_sag: Number, of_x: Number, of_y: Number
) -> None:
    """Give the cotangents of c, k and the coefficients."""
    c, k, radius, b = p
    r2 = fma(x, x, y * y)
    scale = divide(1.0, radius * radius)
    of_slope = 2.0 * (of_x * x + of_y * y)
    of_c, of_k = conic_cotangents(c, k, r2, of_sag, of_slope)
    put(cotangents, 0, of_c)
    put(cotangents, 1, of_k)
    q = r2 * scale
    along = of_slope * scale
    _put_terms(cotangents, b, q, c, 0.0, q * (of_sag * q + 2.0 * along), along * q * q)


def _secant(c: Number, k: Number, r2: Number) -> tuple[Number, Number, Number, Number]:
    """Return a = 1 - k·c²r², b = a - c²r², which is held beyond the branch, σ = √(a/b), and 1/ab.

    Then dσ/d(r²) = σ·c²/(2ab).
    """
    turned = c * c * r2
    left = 1.0 - (1.0 + k) * turned
    b = where(left > STEEPEST, left, STEEPEST)
    a = b + turned
    return a, b, sqrt(divide(a, b)), divide(1.0, a * b)


def q_bfs_sag(p: Any, x: Number, y: Number) -> tuple[Number, Number, Number, Number]:
    """Return sag and slopes, and the margin of the conic's branch.

    The departure is σ·E with E = q·(1 - q)·T.
    """
    c, k, radius, terms = p
    r2 = fma(x, x, y * y)
    scale = divide(1.0, radius * radius)
    sag, slope, margin = conic_sag(c, k, r2)
    q = r2 * scale
    t, t1 = _total(terms, q, c, 1.0)
    _, _, secant, inverse = _secant(c, k, r2)
    weight = q * (1.0 - q)
    e, e1 = weight * t, scale * fma(weight, t1, (1.0 - 2.0 * q) * t)
    slope = 2.0 * fma(secant, fma(0.5 * c * c * inverse, e, e1), slope)
    return fma(secant, e, sag), x * slope, y * slope, margin - STEEPEST


def q_bfs_hessian(p: Any, x: Number, y: Number) -> tuple[Number, Number, Number, Number, Number]:
    """Return slopes and second derivatives."""
    c, k, radius, terms = p
    r2 = fma(x, x, y * y)
    scale = divide(1.0, radius * radius)
    slope, second = conic_slopes(c, k, r2)
    q = r2 * scale
    t, t1, t2 = _total_second(terms, q, c, 1.0)
    a, b, secant, inverse = _secant(c, k, r2)
    weight, turn = q * (1.0 - q), 1.0 - 2.0 * q
    e, e1 = weight * t, scale * (turn * t + weight * t1)
    e2 = scale * scale * (2.0 * (turn * t1 - t) + weight * t2)
    s1 = 0.5 * c * c * inverse
    s2 = s1 * (s1 + c * c * (k * b + (1.0 + k) * a) * inverse)
    slope = slope + secant * (e1 + e * s1)
    return by_radius(x, y, slope, second + secant * (e2 + 2.0 * e1 * s1 + e * s2))


def q_bfs_parameters(
    cotangents: Any, p: Any, x: Number, y: Number, of_sag: Number, of_x: Number, of_y: Number
) -> None:
    """Give the cotangents of c, k and the coefficients.

    c and k turn the normal: with κ = c² and Λ = σ'/σ = κ/(2ab), σ_κ = σ·r²/(2ab), σ_k =
    σ·κ²r⁴/(2ab), Λ_κ = (1 + κr²·(k·b + (1+k)·a)/(ab))/(2ab) and Λ_k = κ²r²·(a + b)/(2a²b²).
    """
    c, k, radius, terms = p
    r2 = fma(x, x, y * y)
    scale = divide(1.0, radius * radius)
    of_slope = 2.0 * (of_x * x + of_y * y)
    of_c, of_k = conic_cotangents(c, k, r2, of_sag, of_slope)
    q = r2 * scale
    t, t1 = _total(terms, q, c, 1.0)
    a, b, secant, inverse = _secant(c, k, r2)
    weight, turn, kappa = q * (1.0 - q), 1.0 - 2.0 * q, c * c
    e, e1 = weight * t, scale * (turn * t + weight * t1)
    s1 = 0.5 * kappa * inverse
    of_secant = of_sag * e + of_slope * (e1 + e * s1)
    mixed = kappa * r2 * inverse * (k * b + (1.0 + k) * a)
    share, bent = 0.5 * secant * inverse, kappa * kappa * r2
    of_kappa = share * (of_secant * r2 + of_slope * e * (1.0 + mixed))
    put(cotangents, 0, of_c + 2.0 * c * of_kappa)
    of_turn = share * bent * (of_secant * r2 + of_slope * e * (a + b) * inverse)
    put(cotangents, 1, of_k + of_turn)
    of_value = secant * (of_sag * weight + of_slope * (scale * turn + weight * s1))
    of_derivative = secant * of_slope * scale * weight
    _put_terms(cotangents, terms, q, c, 1.0, of_value, of_derivative)


_LAYOUT = (None, None, None, Code.COLUMNS)
Q_CON = Shape("q_con", q_con_sag, q_con_hessian, q_con_parameters, _LAYOUT, starts_on_conic=True)
Q_BFS = Shape("q_bfs", q_bfs_sag, q_bfs_hessian, q_bfs_parameters, _LAYOUT, starts_on_conic=True)


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
        return start_on_conic(p, ray, sense)


@register_surface
class QCon(ForbesSag):
    """The sag is conic + u⁴·Σ q_m·Q_m^con(u²).

    Q_m^con is the Jacobi polynomial P_m^(0, 4)(2u² - 1).
    Source: Forbes, Shape specification for axially symmetric optical surfaces, Opt. Express 15,
    5218 (2007).
    """

    kind = "q_con"
    shape = Q_CON
    rotational = True

    @classmethod
    def numbers(cls, p: Parameters) -> tuple[Any, ...]:
        """Return c, k, the normalisation radius, and q0, q1, ...."""
        terms = tuple(p.get(f"q{m}", 0.0) for m in range(_count(p)))
        return p["curvature"], p["conic"], p["normalization_radius"], terms


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
    shape = Q_BFS
    rotational = True

    @classmethod
    def numbers(cls, p: Parameters) -> tuple[Any, ...]:
        """Return c, k, the normalisation radius, and the coefficients of auxiliary polynomials."""
        count, terms = _count(p), tuple[Tensor, ...]()
        if count:
            given = torch.stack([p.get(f"q{m}", _zero(p)) for m in range(count)])
            terms = (torch.from_numpy(to_auxiliary(count)).to(given) @ given).unbind()
        return p["curvature"], p["conic"], p["normalization_radius"], terms

    @classmethod
    def packed(cls, p: Parameters) -> PackedShape:
        """Return the numbers; they are computed, and not stored."""
        return super().packed(p)


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
