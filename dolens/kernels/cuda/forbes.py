"""Forbes's Q_con and Q_bfs on a conic; see `dolens.optics.surfaces.forbes`.

The record holds c, k, a2 (zero), the normalisation radius, and the coefficients b of polynomials
with a three-term recurrence: the Jacobi polynomials P^(0, 4) of Q_con (degree 0 in the codes), or
the auxiliary polynomials of Q_bfs (degree 1).  With q = r²/R² and T = Σ b·P(q) the departure is
D = q²·T, or D = E·σ with E = q(1 - q)·T and σ = √(a/b), a = 1 - k·κ·q and b = a - κ·q, κ = c²R²:
the secant of the conic's normal, σ' = σ·κ/(2ab).
"""

import triton
import triton.language as tl

from dolens.kernels.cuda.arithmetic import add_sum, divide, safe_sqrt
from dolens.kernels.cuda.functions import SagFunctions
from dolens.kernels.cuda.jacobi import advance, advance_second, recurrence
from dolens.kernels.cuda.layout import COLUMNS, DEGREE, SHAPE
from dolens.kernels.cuda.shapes import (
    even_asphere_hessian,
    even_asphere_sag,
    even_asphere_sums,
)

OWN = tl.constexpr(int(SHAPE) + 3)  # the normalisation radius, and then the coefficients
STEEPEST = tl.constexpr(1e-12)  # as in the reference


@triton.jit
def _step(k, best_fit, unit):
    """Return (α, β, γ) of P_k = (α·q + β)·P_(k-1) - γ·P_(k-2)."""
    a, b, c = recurrence(k, 4, unit)
    fits = best_fit != 0
    first = k == 1
    return (
        tl.where(fits, -4.0 * unit, a),
        tl.where(fits, tl.where(first, 3.0 * unit, 2.0 * unit), b),
        tl.where(fits, tl.where(first, 0.0 * unit, unit), c),
    )


@triton.jit
def _secant(q, k, kappa):
    """Return a, b and σ; beyond the branch b is held."""
    b = 1.0 - (1.0 + k) * kappa * q
    b = tl.where(b > STEEPEST, b, STEEPEST)
    a = b + kappa * q
    return a, b, safe_sqrt(divide(a, b))


@triton.jit
def _departure(q, t, t1, t2, k, kappa, best_fit):
    """Return D and its derivatives in q, and E and E'."""
    fits = best_fit != 0
    e = tl.where(fits, q * (1.0 - q) * t, q * q * t)
    e1 = tl.where(fits, (1.0 - 2.0 * q) * t + q * (1.0 - q) * t1, q * (2.0 * t + q * t1))
    e2 = tl.where(
        fits,
        2.0 * ((1.0 - 2.0 * q) * t1 - t) + q * (1.0 - q) * t2,
        2.0 * t + q * (4.0 * t1 + q * t2),
    )
    kappa = tl.where(fits, kappa, 0.0)
    a, b, secant = _secant(q, k, kappa)
    secant = tl.where(fits, secant, 1.0)
    inverse = divide(1.0 + tl.zeros_like(q), a * b)
    s1 = 0.5 * kappa * inverse
    s2 = s1 * (s1 + kappa * (k * b + (1.0 + k) * a) * inverse)
    return secant * e, secant * (e1 + e * s1), secant * (e2 + 2.0 * e1 * s1 + e * s2), e, e1


@triton.jit
def _total(record, codes, x, y):
    """Return a one, one over R², k, κ, whether it is Q_bfs, q, and T with two derivatives."""
    radius, c = tl.load(record + OWN), tl.load(record + SHAPE)
    conic = tl.load(record + SHAPE + 1)
    unit = divide(radius, radius)
    scale = divide(unit, radius * radius)
    best_fit = tl.load(codes + DEGREE)
    q = (x * x + y * y) * scale
    t, t1, t2 = tl.zeros_like(x), tl.zeros_like(x), tl.zeros_like(x)
    p, low = 1.0 + tl.zeros_like(x), tl.zeros_like(x)
    d, low_d = tl.zeros_like(x), tl.zeros_like(x)
    h, low_h = tl.zeros_like(x), tl.zeros_like(x)
    for k in range(tl.load(codes + COLUMNS)):
        if k > 0:
            e, f, g = _step(k, best_fit, unit)
            h, low_h = advance_second(e, f, g, q, d, h, low_h)
            p, low, d, low_d = advance(e, f, g, q, p, low, d, low_d)
        b = tl.load(record + OWN + 1 + k)
        t += b * p
        t1 += b * d
        t2 += b * h
    return unit, scale, conic, c * c * radius * radius, best_fit, q, t, t1, t2


@triton.jit
def forbes_sag(record, codes, extras, x, y):
    """Return sag, slopes, and the margin of the branch."""
    sag, sx, sy, margin = even_asphere_sag(record, codes, extras, x, y)
    _, scale, k, kappa, best_fit, q, t, t1, t2 = _total(record, codes, x, y)
    d, d1, _, _, _ = _departure(q, t, t1, t2, k, kappa, best_fit)
    slope = 2.0 * scale * d1
    margin = tl.where(best_fit != 0, margin - STEEPEST, margin)
    return sag + d, sx + x * slope, sy + y * slope, margin


@triton.jit
def forbes_hessian(record, codes, extras, x, y):
    """Return slopes and second derivatives."""
    sx, sy, sxx, sxy, syy = even_asphere_hessian(record, codes, extras, x, y)
    _, scale, k, kappa, best_fit, q, t, t1, t2 = _total(record, codes, x, y)
    _, d1, d2, _, _ = _departure(q, t, t1, t2, k, kappa, best_fit)
    slope, second = 2.0 * scale * d1, 4.0 * scale * scale * d2
    return (
        sx + x * slope,
        sy + y * slope,
        sxx + slope + x * x * second,
        sxy + x * y * second,
        syy + slope + y * y * second,
    )


@triton.jit
def forbes_sums(record, codes, extras, sums, x, y, of_sag, of_sx, of_sy, alive):
    """Add the cotangents of the conic and of the coefficients.

    Of b: the departure and its slope with P in T's place.  Of c and k, which turn the normal: see
    the CPU's kernel.
    """
    even_asphere_sums(record, codes, extras, sums, x, y, of_sag, of_sx, of_sy, alive)
    unit, scale, conic, kappa, best_fit, q, t, t1, t2 = _total(record, codes, x, y)
    _, _, _, e, e1 = _departure(q, t, t1, t2, conic, kappa, best_fit)
    of_slope = 2.0 * scale * (of_sx * x + of_sy * y)
    if best_fit != 0:
        a, b, secant = _secant(q, conic, kappa)
        inverse = divide(1.0 + tl.zeros_like(q), a * b)
        of_secant = of_sag * e + of_slope * (e1 + e * 0.5 * kappa * inverse)
        weight = of_slope * e
        mixed = kappa * q * inverse * (conic * b + (1.0 + conic) * a)
        share = 0.5 * secant * inverse
        of_kappa = share * (of_secant * q + weight * (1.0 + mixed))
        bent = kappa * kappa * q
        of_k = share * (of_secant * bent * q + weight * bent * (a + b) * inverse)
        of_c = divide(2.0 * tl.load(record + SHAPE), scale) * of_kappa
        add_sum(sums + SHAPE, of_c, alive)
        add_sum(sums + SHAPE + 1, of_k, alive)
    p, low = 1.0 + tl.zeros_like(x), tl.zeros_like(x)
    d, low_d = tl.zeros_like(x), tl.zeros_like(x)
    for k in range(tl.load(codes + COLUMNS)):
        if k > 0:
            alpha, beta, gamma = _step(k, best_fit, unit)
            p, low, d, low_d = advance(alpha, beta, gamma, q, p, low, d, low_d)
        zero = tl.zeros_like(x)
        value, slope, _, _, _ = _departure(q, p, d, zero, conic, kappa, best_fit)
        add_sum(sums + OWN + 1 + k, of_sag * value + of_slope * slope, alive)


KERNELS = SagFunctions(forbes_sag, forbes_hessian, forbes_sums, starts_on_conic=True)
