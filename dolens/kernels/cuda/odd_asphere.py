"""An odd asphere has the sag s = even asphere + r·(a1 + q·H(q)), q = r² and H = a3 + a5·q + ....

The record holds the even asphere's numbers, then a1 and the coefficients of H.
"""

import triton
import triton.language as tl

from dolens.kernels.cuda.arithmetic import add_sum, divide
from dolens.kernels.cuda.even_asphere import (
    even_asphere_hessian,
    even_asphere_sag,
    even_asphere_sums,
)
from dolens.kernels.cuda.functions import SagFunctions
from dolens.kernels.cuda.layout import COLUMNS, COUNT, SHAPE

# mm²: closer to the axis than its root a point counts as the vertex, as in the reference.
VERTEX = tl.constexpr(1e-30)
A1 = tl.constexpr(int(SHAPE) + 3)  # its place where there are no even coefficients but a2


@triton.jit
def _radius(q):
    """Return r and 1/r, both zero at the vertex."""
    away = q > VERTEX
    # A square root of one where it is not used; `safe_sqrt` would hold r at 1e-9.
    power = tl.where(away, q, 1.0)
    root = tl.sqrt(power) if q.dtype == tl.float64 else tl.sqrt_rn(power)
    return tl.where(away, root, 0.0), tl.where(away, divide(1.0 + tl.zeros_like(q), root), 0.0)


@triton.jit
def odd_asphere_sag(record, codes, extras, x, y):
    """Return sag, slopes, and the margin of the conic's branch."""
    sag, sx, sy, margin = even_asphere_sag(record, codes, extras, x, y)
    own = record + A1 + tl.load(codes + COUNT)
    a1, count = tl.load(own), tl.load(codes + COLUMNS)
    q = x * x + y * y
    h, d = tl.zeros_like(x), tl.zeros_like(x)
    for i in range(count):
        d = d * q + h
        h = h * q + tl.load(own + count - i)
    r, inverse = _radius(q)
    slope = a1 * inverse + r * (3.0 * h + 2.0 * q * d)
    return sag + r * (a1 + q * h), sx + x * slope, sy + y * slope, margin


@triton.jit
def odd_asphere_hessian(record, codes, extras, x, y):
    """Return slopes and second derivatives.

    With P(r) and g = P'/r: s_xx = g + (x/r)²·(P'' - g), and P'' - g has no cancellation: -a1/r +
    r·(3H + 12q·H' + 4q²·H'').
    """
    sx, sy, sxx, sxy, syy = even_asphere_hessian(record, codes, extras, x, y)
    own = record + A1 + tl.load(codes + COUNT)
    a1, count = tl.load(own), tl.load(codes + COLUMNS)
    q = x * x + y * y
    h, d, e = tl.zeros_like(x), tl.zeros_like(x), tl.zeros_like(x)
    for i in range(count):
        e = e * q + d
        d = d * q + h
        h = h * q + tl.load(own + count - i)
    r, inverse = _radius(q)
    slope = a1 * inverse + r * (3.0 * h + 2.0 * q * d)
    more = r * (3.0 * h + q * (12.0 * d + 8.0 * q * e)) - a1 * inverse
    u, v = x * inverse, y * inverse
    return (
        sx + x * slope,
        sy + y * slope,
        sxx + slope + u * u * more,
        sxy + u * v * more,
        syy + slope + v * v * more,
    )


@triton.jit
def odd_asphere_sums(record, codes, extras, sums, x, y, of_sag, of_sx, of_sy, alive):
    """Add the cotangents of the even asphere's numbers, of a1 and of the coefficients of H."""
    even_asphere_sums(record, codes, extras, sums, x, y, of_sag, of_sx, of_sy, alive)
    own = sums + A1 + tl.load(codes + COUNT)
    q = x * x + y * y
    r, inverse = _radius(q)
    of_slope = (of_sx * x + of_sy * y) * inverse
    add_sum(own, of_sag * r + of_slope, alive)
    lower = r
    for i in range(tl.load(codes + COLUMNS)):
        upper = lower * q
        add_sum(own + 1 + i, of_sag * upper + (2 * i + 3.0) * of_slope * r * lower, alive)
        lower = upper


KERNELS = SagFunctions(odd_asphere_sag, odd_asphere_hessian, odd_asphere_sums, starts_on_conic=True)
