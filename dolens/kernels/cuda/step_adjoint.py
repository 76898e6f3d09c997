"""A step's adjoint takes a block's cotangents from behind the step to its front.

With F = z - sag (or a conic's implicit form) and g = ∇F, the ray meets the surface at P = Q + t·d,
where dt = -(g·(dQ + t·dd) + F_θ·dθ)/(g·d).  With τ = (P̄·d + n̄·path)/(g·d), where n̄ is the index
in front times the path's cotangent, Q̄ = P̄ - τ·g, d̄ gains t·Q̄, and θ̄ gains -τ·F_θ.  The normal
N = g/|g| passes its cotangent on to g, and g to P by F's second derivatives and to θ.
"""

import triton
import triton.language as tl

from dolens.kernels import refraction
from dolens.kernels.cuda.arithmetic import add_sum, divide
from dolens.kernels.cuda.axes import change_axes_adjoint, lens_axes_adjoint
from dolens.kernels.cuda.functions import LAW_ADJOINT, LAW_CODE
from dolens.kernels.cuda.layout import (
    BASE,
    CHANGE_AXES,
    DEFLECT,
    HAS_CHANGE_AXES,
    HAS_DEFLECT,
    HAS_LENS_AXES,
    KIND,
    LAW,
    LENS_AXES,
    NUMBERS,
    PLANE,
    REFRACTS,
    SENSE_BEHIND,
    SENSOR,
    SHIFT,
)
from dolens.kernels.cuda.step import shape_sums, surface_gradient
from dolens.kernels.cuda.translation import compiled

refract_adjoint = compiled(refraction.refract_adjoint)


@triton.jit
def step_adjoint(
    codes, record, extras, sums, index, ratio, per_radian,
    before, after, px, py, pz, a, b, c, path, alive,
    KINDS: tl.constexpr, FORMS: tl.constexpr, LAWS: tl.constexpr,
):  # fmt: skip
    """Return the cotangents in front of a step from those behind it; its own are added to `sums`.

    Args:
        codes: to `per_radian`: as in `step`; `sums` lie as the record does.
        before: the kept state in front: x, y, z, l, m, n, distance.
        after: and behind.
        px: to pz: cotangents of the position behind.
        a: to c: of the direction behind.
        path: of the optical path.
        alive: which rays count.
        KINDS: see `step`, and FORMS and LAWS.

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
            a, b, c, vx, vy, vz, of_front, of_behind, _ = refract_adjoint(
                a, b, c, l, m, n, nx, ny, nz, out_l, out_m, out_n, ratio, divide(1.0, index)
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
    if HAS_DEFLECT & KINDS:
        if kind == DEFLECT:
            base = tl.load(codes + BASE)
            gx, gy, gz, inverse, xx, xy, yy, zz = surface_gradient(
                record, codes, extras, base, x, y, z, KINDS, FORMS
            )
            nx, ny, nz = gx * inverse, gy * inverse, gz * inverse
            place = tl.load(codes + NUMBERS)
            vx, vy, vz = tl.zeros_like(x), tl.zeros_like(x), tl.zeros_like(x)
            for k in tl.static_range(len(LAWS)):
                if tl.load(codes + LAW) == LAWS[k][LAW_CODE]:
                    qx, qy, a, b, c, vx, vy, vz, of_front, of_behind = LAWS[k][LAW_ADJOINT](
                        record + place, codes, extras, sums + place, x, y, l, m, n, nx, ny, nz,
                        index, ratio, per_radian, tl.load(record + SENSE_BEHIND),
                        out_l, out_m, out_n, a, b, c, path, alive,
                    )  # fmt: skip
                    px, py = px + qx, py + qy
            across = vx * nx + vy * ny + vz * nz
            ux = (vx - across * nx) * inverse
            uy = (vy - across * ny) * inverse
            uz = (vz - across * nz) * inverse
            px, py, pz = px + xx * ux + xy * uy, py + xy * ux + yy * uy, pz + zz * uz
            shape_sums(
                record, codes, extras, sums, base, x, y, z, tl.zeros_like(x), ux, uy, uz, alive,
                KINDS, FORMS,
            )  # fmt: skip
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
