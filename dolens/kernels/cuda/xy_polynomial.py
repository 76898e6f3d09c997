"""An XY polynomial may have the implicit b·z² term; see `dolens.optics.surfaces.xy_polynomial`.

With P = Σ a·x^i·y^j and W = √(1 - 4bP): s = 2P/(1 + W), s_x = P_x/W.  P and its derivatives come
from Horner's rule in x within one in y.  `extras` say for every monomial, in that order (j, and
within it i, falling; i + j up to the degree), which number of the record is its coefficient; -1:
none.
"""

from collections.abc import Sequence

import triton
import triton.language as tl

from dolens.kernels.cuda.arithmetic import add_sum, divide, safe_sqrt
from dolens.kernels.cuda.functions import SagFunctions
from dolens.kernels.cuda.layout import COLUMNS, DEGREE, EXTRAS, SHAPE
from dolens.kernels.table import Code, Slot


@triton.jit
def _coefficient(record, places, term):
    place = tl.load(places + term)
    return tl.load(record + place, mask=place >= 0, other=0.0)


@triton.jit
def _slopes(record, places, degree, x, y):
    """Return P, P_x and P_y."""
    p, px, py = tl.zeros_like(x), tl.zeros_like(x), tl.zeros_like(x)
    term = 0
    for j in range(degree + 1):
        r, rx = tl.zeros_like(x), tl.zeros_like(x)
        for _ in range(j + 1):
            rx = rx * x + r
            r = r * x + _coefficient(record, places, term)
            term += 1
        py = py * y + p
        px = px * y + rx
        p = p * y + r
    return p, px, py


@triton.jit
def _second_derivatives(record, places, degree, x, y):
    """Return P, P_x, P_y, P_xx, P_xy and P_yy."""
    p, px, py = tl.zeros_like(x), tl.zeros_like(x), tl.zeros_like(x)
    pxx, pxy, half_pyy = tl.zeros_like(x), tl.zeros_like(x), tl.zeros_like(x)
    term = 0
    for j in range(degree + 1):
        r, rx, half_rxx = tl.zeros_like(x), tl.zeros_like(x), tl.zeros_like(x)
        for _ in range(j + 1):
            half_rxx = half_rxx * x + rx
            rx = rx * x + r
            r = r * x + _coefficient(record, places, term)
            term += 1
        half_pyy = half_pyy * y + py
        py = py * y + p
        pxy = pxy * y + px
        p = p * y + r
        px = px * y + rx
        pxx = pxx * y + 2.0 * half_rxx
    return p, px, py, pxx, pxy, 2.0 * half_pyy


@triton.jit
def xy_polynomial_sag(record, codes, extras, x, y):
    """Return sag, slopes, and the margin 1 - 4bP of the branch through the vertex."""
    places = extras + tl.load(codes + EXTRAS)
    sag, sx, sy = _slopes(record, places, tl.load(codes + DEGREE), x, y)
    margin = 1.0 + tl.zeros_like(x)
    if tl.load(codes + COLUMNS) != 0:
        margin = 1.0 - 4.0 * tl.load(record + SHAPE) * sag
        root = safe_sqrt(margin)
        sag = divide(2.0 * sag, 1.0 + root)
        sx, sy = divide(sx, root), divide(sy, root)
    return sag, sx, sy, margin


@triton.jit
def xy_polynomial_hessian(record, codes, extras, x, y):
    """Return slopes and second derivatives: s_xy = P_xy/W + 2b·P_x·P_y/W³."""
    places = extras + tl.load(codes + EXTRAS)
    p, sx, sy, sxx, sxy, syy = _second_derivatives(record, places, tl.load(codes + DEGREE), x, y)
    if tl.load(codes + COLUMNS) != 0:
        b = tl.load(record + SHAPE)
        inverse = divide(1.0, safe_sqrt(1.0 - 4.0 * b * p))
        factor = 2.0 * b * inverse
        sx, sy = sx * inverse, sy * inverse
        sxx = sxx * inverse + factor * sx * sx
        sxy = sxy * inverse + factor * sx * sy
        syy = syy * inverse + factor * sy * sy
    return sx, sy, sxx, sxy, syy


@triton.jit
def xy_polynomial_sums(record, codes, extras, sums, x, y, of_sag, of_sx, of_sy, alive):
    """Add the cotangents of b and the coefficients, from those of the sag and its slopes.

    Those of P, P_x and P_y first: s_P = 1/W, ∂s_x/∂P = 2b·P_x/W³; and with b, s_b = s²/W and
    ∂s_x/∂b = 2P·P_x/W³.
    """
    places, degree = extras + tl.load(codes + EXTRAS), tl.load(codes + DEGREE)
    if tl.load(codes + COLUMNS) != 0:
        b = tl.load(record + SHAPE)
        p, px, py = _slopes(record, places, degree, x, y)
        root = safe_sqrt(1.0 - 4.0 * b * p)
        inverse = divide(1.0, root)
        cubed = 2.0 * inverse * inverse * inverse * (of_sx * px + of_sy * py)
        sag = divide(2.0 * p, 1.0 + root)
        add_sum(sums + SHAPE, of_sag * sag * sag * inverse + p * cubed, alive)
        of_sag = of_sag * inverse + b * cubed
        of_sx, of_sy = of_sx * inverse, of_sy * inverse
    # From the last monomial back: j and i grow, with their powers and the next lower ones.
    term = (degree + 1) * (degree + 2) // 2 - 1
    v, v_lower = 1.0 + tl.zeros_like(x), tl.zeros_like(x)
    for j in range(degree + 1):
        u, u_lower = 1.0 + tl.zeros_like(x), tl.zeros_like(x)
        for i in range(degree + 1 - j):
            place = tl.load(places + term)
            if place >= 0:
                of_p = of_sag * u * v + of_sx * (i * 1.0) * u_lower * v
                add_sum(sums + place, of_p + of_sy * (j * 1.0) * u * v_lower, alive)
            u_lower = u
            u = u * x
            term -= 1
        v_lower = v
        v = v * y


def horner_order(row: list[int], extras: Sequence[int]) -> list[int]:
    """Return the places of the coefficients in Horner's order, from the powers of the monomials in
    `extras`.

    A place counts from the record's beginning; -1: no such monomial.  The row's degree becomes the
    highest i + j.
    """
    first = row[Code.EXTRAS]
    powers = extras[first : first + 2 * row[Code.COUNT]]
    place = {
        (i, j): Slot.HEADER + 1 + t
        for t, (i, j) in enumerate(zip(powers[::2], powers[1::2], strict=True))
    }
    degree = max((i + j for i, j in place), default=0)
    row[Code.DEGREE] = degree
    order = [(i, j) for j in range(degree, -1, -1) for i in range(degree - j, -1, -1)]
    return [place.get(power, -1) for power in order]


KERNELS = SagFunctions(
    xy_polynomial_sag, xy_polynomial_hessian, xy_polynomial_sums, extras=horner_order
)
