"""A surface's gradient g = ∇F at a point, F's second derivatives, and cotangents of its numbers.

F = z - sag, or a conic's implicit form; the unit normal is g/|g|.
"""

import triton
import triton.language as tl

from dolens.kernels.cuda.arithmetic import divide, safe_sqrt
from dolens.kernels.cuda.conic import conic_curvature_cotangent, conic_gradient, conic_sums
from dolens.kernels.cuda.functions import CODE, HESSIAN, SUMS
from dolens.kernels.cuda.layout import CONIC, HAS_CONIC, HAS_SPHERE, SHAPE, SPHERE
from dolens.kernels.cuda.sums import add_sum


@triton.jit
def _explicit_gradient(record, codes, extras, x, y, FORM: tl.constexpr):
    """Return g = (-s_x, -s_y, 1), 1/|g|, and F's second derivatives xx, xy, yy and zz."""
    sx, sy, sxx, sxy, syy = FORM[HESSIAN](record, codes, extras, x, y)
    gz = 1.0 + tl.zeros_like(x)
    inverse = divide(1.0, safe_sqrt(1.0 + sx * sx + sy * sy))
    return -sx, -sy, gz, inverse, -sxx, -sxy, -syy, tl.zeros_like(x)


@triton.jit
def surface_gradient(
    record, codes, extras, kind, x, y, z, KINDS: tl.constexpr, FORMS: tl.constexpr
):
    """Return g, 1/|g|, and F's second derivatives xx, xy, yy and zz, at a point of any surface."""
    gx, gy, gz = tl.zeros_like(x), tl.zeros_like(x), 1.0 + tl.zeros_like(x)
    inverse = 1.0 + tl.zeros_like(x)
    xx, xy, yy, zz = tl.zeros_like(x), tl.zeros_like(x), tl.zeros_like(x), tl.zeros_like(x)
    if HAS_SPHERE & KINDS:
        if kind == SPHERE:
            gx, gy, gz, _, xx, zz = conic_gradient(tl.load(record + SHAPE), 0.0, x, y, z)
            yy = xx
    if HAS_CONIC & KINDS:
        if kind == CONIC:
            c, k = tl.load(record + SHAPE), tl.load(record + SHAPE + 1)
            gx, gy, gz, inverse, xx, zz = conic_gradient(c, k, x, y, z)
            yy = xx
    for k in tl.static_range(len(FORMS)):
        if kind == FORMS[k][CODE]:
            gx, gy, gz, inverse, xx, xy, yy, zz = _explicit_gradient(
                record, codes, extras, x, y, FORMS[k]
            )
    return gx, gy, gz, inverse, xx, xy, yy, zz


@triton.jit
def shape_sums(
    record, codes, extras, sums, kind, x, y, z, along, ux, uy, uz, alive,
    KINDS: tl.constexpr, FORMS: tl.constexpr,
):  # fmt: skip
    """Add the cotangents of a shape's numbers, from τ and (ux, uy, uz), the cotangent of g."""
    if HAS_SPHERE & KINDS:
        if kind == SPHERE:
            of_c = conic_curvature_cotangent(0.0, x, y, z, along, ux, uy, uz)
            add_sum(sums + SHAPE, of_c, alive)
    if HAS_CONIC & KINDS:
        if kind == CONIC:
            conic_sums(record, sums, x, y, z, along, ux, uy, uz, alive)
    for k in tl.static_range(len(FORMS)):
        if kind == FORMS[k][CODE]:
            FORMS[k][SUMS](record, codes, extras, sums, x, y, along, -ux, -uy, alive)
