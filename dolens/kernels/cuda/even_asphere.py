"""An even asphere has the sag s = conic + q·a2 + q²·H(q) with q = r² and H = a4 + a6·q + ....

The record holds c, k, a2, and the coefficients of H.
"""

import triton
import triton.language as tl

from dolens.kernels.cuda.arithmetic import add_sum, divide, safe_sqrt
from dolens.kernels.cuda.functions import SagFunctions
from dolens.kernels.cuda.layout import COUNT, SHAPE


@triton.jit
def even_asphere_sag(record, codes, extras, x, y):
    """Return sag, slopes, and the margin of the conic's branch."""
    c, k = tl.load(record + SHAPE), tl.load(record + SHAPE + 1)
    a2, count = tl.load(record + SHAPE + 2), tl.load(codes + COUNT)
    q = x * x + y * y
    h, d = tl.zeros_like(x), tl.zeros_like(x)
    for i in range(count):
        d = d * q + h
        h = h * q + tl.load(record + SHAPE + 2 + count - i)
    squared = 1.0 - (1.0 + k) * c * c * q
    root = safe_sqrt(squared)
    twice = divide(c, root) + 2.0 * (a2 + q * (2.0 * h + q * d))
    return divide(c * q, 1.0 + root) + q * (a2 + q * h), x * twice, y * twice, squared


@triton.jit
def even_asphere_hessian(record, codes, extras, x, y):
    """Return slopes and second derivatives: with f(q), s_xx = 2f' + 4x²f'', s_xy = 4xyf''."""
    c, k = tl.load(record + SHAPE), tl.load(record + SHAPE + 1)
    a2, count = tl.load(record + SHAPE + 2), tl.load(codes + COUNT)
    q = x * x + y * y
    h, d, e = tl.zeros_like(x), tl.zeros_like(x), tl.zeros_like(x)
    for i in range(count):
        e = e * q + d
        d = d * q + h
        h = h * q + tl.load(record + SHAPE + 2 + count - i)
    ec2 = (1.0 + k) * c * c
    root = safe_sqrt(1.0 - ec2 * q)
    conic = divide(0.5 * c, root)
    slope = conic + a2 + q * (2.0 * h + q * d)
    second = divide(0.5 * conic * ec2, root * root) + 2.0 * h + 4.0 * q * d + 2.0 * q * q * e
    return (
        2.0 * x * slope,
        2.0 * y * slope,
        2.0 * slope + 4.0 * x * x * second,
        4.0 * x * y * second,
        2.0 * slope + 4.0 * y * y * second,
    )


@triton.jit
def even_asphere_sums(record, codes, extras, sums, x, y, of_sag, of_sx, of_sy, alive):
    """Add the cotangents of c, k, a2 and further coefficients, from those of sag and slopes.

    With R = √(1 - (1+k)c²q): s_c = (q + (1+k)s²)/2R and s_k = c·s²/2R of the conic's sag s, and of
    its derivative in q, c/2R: 1/2R³ and c³q/4R³.
    """
    c, k = tl.load(record + SHAPE), tl.load(record + SHAPE + 1)
    e = 1.0 + k
    q = x * x + y * y
    of_slope = 2.0 * (of_sx * x + of_sy * y)
    root = safe_sqrt(1.0 - e * c * c * q)
    inverse = divide(1.0, root)
    sag = divide(c * q, 1.0 + root)
    cubed = 0.5 * of_slope * inverse * inverse * inverse
    add_sum(sums + SHAPE, 0.5 * of_sag * inverse * (q + e * sag * sag) + cubed, alive)
    of_k = 0.5 * c * (of_sag * inverse * sag * sag + c * c * q * cubed)
    add_sum(sums + SHAPE + 1, of_k, alive)
    add_sum(sums + SHAPE + 2, of_sag * q + of_slope, alive)
    lower = q
    for i in range(tl.load(codes + COUNT)):
        upper = lower * q
        add_sum(sums + SHAPE + 3 + i, of_sag * upper + (i + 2.0) * of_slope * lower, alive)
        lower = upper


KERNELS = SagFunctions(
    even_asphere_sag, even_asphere_hessian, even_asphere_sums, starts_on_conic=True
)
