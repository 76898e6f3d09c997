"""A step's adjoint takes a block's cotangents from behind the step to its front.

With F = z - sag (or a conic's implicit form) and g = ∇F, the ray meets the surface at P = Q + t·d,
where dt = -(g·(dQ + t·dd) + F_θ·dθ)/(g·d).  With τ = (P̄·d + n̄·path)/(g·d), where n̄ is the index
in front times the path's cotangent, Q̄ = P̄ - τ·g, d̄ gains t·Q̄, and θ̄ gains -τ·F_θ.  The normal
N = g/|g| passes its cotangent on to g, and g to P by F's second derivatives and to θ.
"""

import triton
import triton.language as tl

from dolens.kernels.cuda.arithmetic import divide, refract_adjoint, safe_sqrt
from dolens.kernels.cuda.axes import change_axes_adjoint, lens_axes_adjoint
from dolens.kernels.cuda.conic import conic_curvature_cotangent, conic_gradient, conic_sums
from dolens.kernels.cuda.functions import CODE, HESSIAN, SUMS
from dolens.kernels.cuda.layout import (
    CHANGE_AXES,
    CONIC,
    HAS_CHANGE_AXES,
    HAS_CONIC,
    HAS_LENS_AXES,
    HAS_SPHERE,
    KIND,
    LENS_AXES,
    PLANE,
    REFRACTS,
    SENSOR,
    SHAPE,
    SHIFT,
    SPHERE,
)
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


@triton.jit
def step_adjoint(
    codes, record, extras, sums, index, ratio,
    before, after, px, py, pz, a, b, c, path, alive, KINDS: tl.constexpr, FORMS: tl.constexpr,
):  # fmt: skip
    """Return the cotangents in front of a step from those behind it; its own are added to `sums`.

    Args:
        codes: to `ratio`: as in `step`; `sums` lie as the record does.
        before: the kept state in front: x, y, z, l, m, n, distance.
        after: and behind.
        px: to pz: cotangents of the position behind.
        a: to c: of the direction behind.
        path: of the optical path.
        alive: which rays count.
        KINDS: see `step`, and FORMS.

    Returns:
        Cotangents of position and direction in front, and of the indices in front and behind.
    """
    kind = tl.load(codes + KIND)
    x0, y0, z0, l, m, n, _ = before
    x, y, z, out_l, out_m, out_n, t = after
    of_front, of_behind = tl.zeros_like(x), tl.zeros_like(x)
    if (kind >= PLANE) | (kind == SENSOR):
        gx, gy, gz, inverse, xx, xy, yy, zz = surface_gradient(
            record, codes, extras, kind, x, y, z, KINDS, FORMS
        )
        ux, uy, uz = tl.zeros_like(x), tl.zeros_like(x), tl.zeros_like(x)
        if tl.load(codes + REFRACTS) != 0:
            nx, ny, nz = gx * inverse, gy * inverse, gz * inverse
            a, b, c, vx, vy, vz, of_front, of_behind = refract_adjoint(
                a, b, c, l, m, n, nx, ny, nz, out_l, out_m, out_n, ratio, index
            )
            # The cotangent of g: what lies across the normal, over |g|.
            across = vx * nx + vy * ny + vz * nz
            ux = (vx - across * nx) * inverse
            uy = (vy - across * ny) * inverse
            uz = (vz - across * nz) * inverse
        px, py, pz = px + xx * ux + xy * uy, py + xy * ux + yy * uy, pz + zz * uz
        along = divide(px * l + py * m + pz * n + index * path, gx * l + gy * m + gz * n)
        shape_sums(
            record, codes, extras, sums, kind, x, y, z, along, ux, uy, uz, alive, KINDS, FORMS
        )
        px, py, pz = px - along * gx, py - along * gy, pz - along * gz
        a, b, c = a + t * px, b + t * py, c + t * pz
        of_front += path * t
        add_sum(sums + SHIFT, pz, alive)
    if HAS_CHANGE_AXES & KINDS:
        if kind == CHANGE_AXES:
            px, py, pz, a, b, c, of_front = change_axes_adjoint(
                record, sums, index, x0, y0, z0, l, m, n, t, px, py, pz, a, b, c, path, alive
            )
    if HAS_LENS_AXES & KINDS:
        if kind == LENS_AXES:
            px, py, pz, a, b, c = lens_axes_adjoint(
                record, sums, x0, y0, z0, l, m, n, px, py, pz, a, b, c, alive
            )
    return px, py, pz, a, b, c, of_front, of_behind
