"""A toroid has the sag s = f + c·x²/(g + W) with g = 1 - c·f and W² = g² - c²·x², W = 1 - c·s.

f is the section of an even asphere along y.  The record holds the even asphere's numbers, and then
c, the curvature along x.
"""

import triton
import triton.language as tl

from dolens.kernels.cuda.arithmetic import GRAZING, TINY, add_sum, divide, safe_sqrt
from dolens.kernels.cuda.functions import SagFunctions
from dolens.kernels.cuda.layout import COUNT, SHAPE
from dolens.kernels.cuda.shapes import (
    even_asphere_hessian,
    even_asphere_sag,
    even_asphere_sums,
)

C_X = tl.constexpr(int(SHAPE) + 3)  # its place where there are no even coefficients but a2


@triton.jit
def _section(record, codes, extras, x, y):
    """Return c, the curve, its slope and its margin, g, W² and W."""
    c = tl.load(record + C_X + tl.load(codes + COUNT))
    f, _, slope, margin = even_asphere_sag(record, codes, extras, tl.zeros_like(x), y)
    g = 1.0 - c * f
    margin = tl.where(g < margin, g, margin)
    g = tl.where(g > GRAZING, g, GRAZING)
    squared = g * g - c * x * c * x
    return c, f, slope, margin, g, squared, safe_sqrt(squared)


@triton.jit
def toroid_sag(record, codes, extras, x, y):
    """Return sag, slopes, and a margin that is positive where curve and circle are."""
    c, f, slope, margin, g, squared, root = _section(record, codes, extras, x, y)
    on = squared > TINY
    inverse = divide(1.0 + tl.zeros_like(x), tl.where(on, root, g))
    bent = c * x * inverse
    sx = tl.where(on, bent, 2.0 * bent)
    sy = slope * tl.where(on, g * inverse, 1.0 + bent * bent)
    return f + divide(c * x * x, g + root), sx, sy, tl.where(squared < margin, squared, margin)


@triton.jit
def toroid_hessian(record, codes, extras, x, y):
    """Return slopes and second derivatives.

    W·s_xx = c + c·s_x², W·s_xy = c·s_x·s_y and W·s_yy = g·f'' + c·(s_y² - f'²).
    """
    c, _, slope, _, g, _, root = _section(record, codes, extras, x, y)
    _, _, _, _, second = even_asphere_hessian(record, codes, extras, tl.zeros_like(x), y)
    inverse = divide(1.0 + tl.zeros_like(x), root)
    sx, sy = c * x * inverse, slope * g * inverse
    return (
        sx,
        sy,
        c * (1.0 + sx * sx) * inverse,
        c * sx * sy * inverse,
        (g * second + c * (sy * sy - slope * slope)) * inverse,
    )


@triton.jit
def toroid_sums(record, codes, extras, sums, x, y, of_sag, of_sx, of_sy, alive):
    """Add the cotangents of the curve's numbers and of c.

    Of c: W·s_c = (s² + x² - f²)/2.  Of the curve's numbers: s_θ = (g/W)·f_θ, so the section takes
    the cotangents times g/W, and what the slopes of g/W add.
    """
    c, f, slope, _, g, _, root = _section(record, codes, extras, x, y)
    inverse = divide(1.0 + tl.zeros_like(x), root)
    ratio = g * inverse
    sx, sy = c * x * inverse, slope * ratio
    s = f + divide(c * x * x, g + root)
    along = of_sx * sx + of_sy * sy
    lever = 0.5 * ((s - f) * (s + f) + x * x)
    of_lever = s * along + x * of_sx - f * slope * of_sy
    of_c = inverse * (of_sag * lever + of_lever + c * lever * along * inverse)
    add_sum(sums + C_X + tl.load(codes + COUNT), of_c, alive)
    of_f = of_sag * ratio + c * (ratio * along - slope * of_sy) * inverse
    zero = tl.zeros_like(x)
    even_asphere_sums(record, codes, extras, sums, zero, y, of_f, zero, ratio * of_sy, alive)


KERNELS = SagFunctions(toroid_sag, toroid_hessian, toroid_sums)
