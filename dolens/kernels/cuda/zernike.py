"""Zernike polynomials on an even asphere; see `dolens.optics.surfaces.zernike`.

The record holds the even asphere's numbers, the normalisation radius, the decentre, and the
coefficients.  Extras say which coefficient belongs to which term.  With w = u + i·v the terms of
azimuthal order m add up to Re(w^m)·A(q) + Im(w^m)·B(q), q = u² + v².
"""

import triton
import triton.language as tl

from dolens.kernels.cuda.arithmetic import add_sum, divide, safe_sqrt
from dolens.kernels.cuda.functions import SagFunctions
from dolens.kernels.cuda.jacobi import advance, advance_second, recurrence
from dolens.kernels.cuda.layout import COUNT, DEGREE, EXTRAS, SHAPE
from dolens.kernels.cuda.shapes import (
    even_asphere_hessian,
    even_asphere_sag,
    even_asphere_sums,
)

OWN = tl.constexpr(int(SHAPE) + 3)  # where there are no even coefficients but a2
CONSTANTS = tl.constexpr(3)  # normalisation radius and decentre, before the coefficients


@triton.jit
def _norm(normalised, k, m, unit):
    """Return √(n+1), times √2 for m > 0, or one."""
    squared = unit * (2 * k + m + 1) * tl.where(m > 0, 2, 1)
    return tl.where(normalised != 0, safe_sqrt(squared), unit)


@triton.jit
def _coefficient(own, place):
    return tl.load(own + CONSTANTS + place, mask=place >= 0, other=0.0)


@triton.jit
def _place(own, x, y):
    """Return a one in the record's precision, one over the normalisation radius, u and v."""
    radius = tl.load(own)
    unit = divide(radius, radius)
    scale = divide(unit, radius)
    return unit, scale, (x - tl.load(own + 1)) * scale, (y - tl.load(own + 2)) * scale


@triton.jit
def zernike_sag(record, codes, extras, x, y):
    """Return sag, slopes, and the margin of the conic's branch."""
    sag, sx, sy, margin = even_asphere_sag(record, codes, extras, x, y)
    own = record + OWN + tl.load(codes + COUNT)
    unit, scale, u, v = _place(own, x, y)
    q = u * u + v * v
    cursor = extras + tl.load(codes + EXTRAS)
    normalised = tl.load(cursor)
    cursor += 1
    c, s = 1.0 + tl.zeros_like(x), tl.zeros_like(x)
    c1, s1 = tl.zeros_like(x), tl.zeros_like(x)
    for m in range(tl.load(codes + DEGREE) + 1):
        count = tl.load(cursor)
        cursor += 1
        p, low = 1.0 + tl.zeros_like(x), tl.zeros_like(x)
        d, low_d = tl.zeros_like(x), tl.zeros_like(x)
        a, da = tl.zeros_like(x), tl.zeros_like(x)
        b, db = tl.zeros_like(x), tl.zeros_like(x)
        for k in range(count):
            if k > 0:
                e, f, g = recurrence(k, m, unit)
                p, low, d, low_d = advance(e, f, g, q, p, low, d, low_d)
            norm = _norm(normalised, k, m, unit)
            of_cosine = norm * _coefficient(own, tl.load(cursor))
            of_sine = norm * _coefficient(own, tl.load(cursor + 1))
            cursor += 2
            a += of_cosine * p
            da += of_cosine * d
            b += of_sine * p
            db += of_sine * d
        radial = 2.0 * (c * da + s * db)
        sag += c * a + s * b
        sx += (unit * m * (c1 * a + s1 * b) + u * radial) * scale
        sy += (unit * m * (c1 * b - s1 * a) + v * radial) * scale
        c1, s1 = c, s
        c = c1 * u - s1 * v
        s = s1 * u + c1 * v
    return sag, sx, sy, margin


@triton.jit
def zernike_hessian(record, codes, extras, x, y):
    """Return slopes and second derivatives.

    With E = C·A + S·B, and G1 and G2 the same with w^(m-1) and w^(m-2):
    s_uu = m(m-1)·G2 + 4u·m·G1' + 2E' + 4u²·E''.
    """
    sx, sy, sxx, sxy, syy = even_asphere_hessian(record, codes, extras, x, y)
    own = record + OWN + tl.load(codes + COUNT)
    unit, scale, u, v = _place(own, x, y)
    q = u * u + v * v
    cursor = extras + tl.load(codes + EXTRAS)
    normalised = tl.load(cursor)
    cursor += 1
    c, s = 1.0 + tl.zeros_like(x), tl.zeros_like(x)
    c1, s1, c2, s2 = tl.zeros_like(x), tl.zeros_like(x), tl.zeros_like(x), tl.zeros_like(x)
    for m in range(tl.load(codes + DEGREE) + 1):
        count = tl.load(cursor)
        cursor += 1
        p, low = 1.0 + tl.zeros_like(x), tl.zeros_like(x)
        d, low_d = tl.zeros_like(x), tl.zeros_like(x)
        h, low_h = tl.zeros_like(x), tl.zeros_like(x)
        a, da, dda = tl.zeros_like(x), tl.zeros_like(x), tl.zeros_like(x)
        b, db, ddb = tl.zeros_like(x), tl.zeros_like(x), tl.zeros_like(x)
        for k in range(count):
            if k > 0:
                e, f, g = recurrence(k, m, unit)
                h, low_h = advance_second(e, f, g, q, d, h, low_h)
                p, low, d, low_d = advance(e, f, g, q, p, low, d, low_d)
            norm = _norm(normalised, k, m, unit)
            of_cosine = norm * _coefficient(own, tl.load(cursor))
            of_sine = norm * _coefficient(own, tl.load(cursor + 1))
            cursor += 2
            a += of_cosine * p
            da += of_cosine * d
            dda += of_cosine * h
            b += of_sine * p
            db += of_sine * d
            ddb += of_sine * h
        order, pairs = unit * m, unit * (m * (m - 1))
        e1, e2 = 2.0 * (c * da + s * db), 4.0 * (c * dda + s * ddb)
        g0, h0 = order * (c1 * a + s1 * b), order * (c1 * b - s1 * a)
        g1, h1 = 2.0 * order * (c1 * da + s1 * db), 2.0 * order * (c1 * db - s1 * da)
        g2, h2 = pairs * (c2 * a + s2 * b), pairs * (c2 * b - s2 * a)
        sx += (g0 + u * e1) * scale
        sy += (h0 + v * e1) * scale
        sxx += (g2 + 2.0 * u * g1 + e1 + u * u * e2) * scale * scale
        sxy += (h2 + u * h1 + v * g1 + u * v * e2) * scale * scale
        syy += (e1 - g2 + 2.0 * v * h1 + v * v * e2) * scale * scale
        c2, s2 = c1, s1
        c1, s1 = c, s
        c = c1 * u - s1 * v
        s = s1 * u + c1 * v
    return sx, sy, sxx, sxy, syy


@triton.jit
def zernike_sums(record, codes, extras, sums, x, y, of_sag, of_sx, of_sy, alive):
    """Add the cotangents of the even asphere's numbers and of the coefficients.

    Of Re(w^m)·P(q): of_sag·C·P + of_u·(m·C_1·P + 2u·C·P') + of_v·(-m·S_1·P + 2v·C·P').
    """
    even_asphere_sums(record, codes, extras, sums, x, y, of_sag, of_sx, of_sy, alive)
    first = OWN + tl.load(codes + COUNT)
    unit, scale, u, v = _place(record + first, x, y)
    out = sums + first + CONSTANTS
    q = u * u + v * v
    of_u, of_v = of_sx * scale, of_sy * scale
    along = 2.0 * (of_u * u + of_v * v)
    cursor = extras + tl.load(codes + EXTRAS)
    normalised = tl.load(cursor)
    cursor += 1
    c, s = 1.0 + tl.zeros_like(x), tl.zeros_like(x)
    c1, s1 = tl.zeros_like(x), tl.zeros_like(x)
    for m in range(tl.load(codes + DEGREE) + 1):
        count = tl.load(cursor)
        cursor += 1
        order = unit * m
        of_cosine = of_sag * c + order * (of_u * c1 - of_v * s1)
        of_sine = of_sag * s + order * (of_u * s1 + of_v * c1)
        p, low = 1.0 + tl.zeros_like(x), tl.zeros_like(x)
        d, low_d = tl.zeros_like(x), tl.zeros_like(x)
        for k in range(count):
            if k > 0:
                e, f, g = recurrence(k, m, unit)
                p, low, d, low_d = advance(e, f, g, q, p, low, d, low_d)
            norm = _norm(normalised, k, m, unit)
            cosine, sine = tl.load(cursor), tl.load(cursor + 1)
            cursor += 2
            if cosine >= 0:
                add_sum(out + cosine, norm * (of_cosine * p + along * c * d), alive)
            if sine >= 0:
                add_sum(out + sine, norm * (of_sine * p + along * s * d), alive)
        c1, s1 = c, s
        c = c1 * u - s1 * v
        s = s1 * u + c1 * v


KERNELS = SagFunctions(zernike_sag, zernike_hessian, zernike_sums, starts_on_conic=True)
