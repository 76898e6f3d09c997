"""A step carries a block of rays through a surface, to other axes, or to the sensor.

Newton's iteration finds the intercept on a surface that is given by its sag.

A surface's gradient g = ∇F at a point, F's second derivatives, and cotangents of its numbers.

F = z - sag, or a conic's implicit form; the unit normal is g/|g|.
"""

import triton
import triton.language as tl

from dolens.kernels import refraction
from dolens.kernels.cuda.arithmetic import (
    add_sum,
    away_from_zero,
    clamp,
    distance_to_plane,
    divide,
    safe_sqrt,
)
from dolens.kernels.cuda.axes import change_axes, lens_axes
from dolens.kernels.cuda.conic import (
    conic_distance,
    conic_intersect,
    gradient_and_second,
    shape_cotangents,
    sphere_intersect,
)
from dolens.kernels.cuda.functions import CODE, HESSIAN, LAW_CODE, LAW_FORWARD, ON_CONIC, SAG, SUMS
from dolens.kernels.cuda.layout import (
    ARM,
    BASE,
    CENTER_X,
    CENTER_Y,
    CHANGE_AXES,
    CIRCLE,
    CONIC,
    DEFLECT,
    EDGE,
    ELLIPSE,
    ELLIPTIC,
    FIGURES,
    HALF_X,
    HALF_Y,
    HAS_CHANGE_AXES,
    HAS_CONIC,
    HAS_DEFLECT,
    HAS_FIGURES,
    HAS_LENS_AXES,
    HAS_SENSOR,
    HAS_SPHERE,
    HOLE,
    HOLE_X,
    HOLE_Y,
    KIND,
    LAW,
    LENS_AXES,
    LIMIT,
    MAX_STEPS,
    MISSED,
    MORE_STEPS,
    NUMBERS,
    OUTLINE,
    PLANE,
    RECTANGLE,
    REFRACTS,
    SCALE,
    SENSE,
    SENSE_BEHIND,
    SENSOR,
    SHAPE,
    SHIFT,
    SPHERE,
    TAG,
    TOTALLY_REFLECTED,
    VIGNETTED,
)
from dolens.kernels.cuda.translation import compiled

refract = compiled(refraction.refract)


@triton.jit
def intersect(
    record, codes, extras, kind, x, y, l, m, n, sense, KINDS: tl.constexpr, FORMS: tl.constexpr
):
    """Return the distance from the vertex plane to a surface, the unit normal there, and whether it
    is met.
    """
    limit = tl.load(record + LIMIT)
    t, nx, ny = tl.zeros_like(x), tl.zeros_like(x), tl.zeros_like(x)
    nz = 1.0 + tl.zeros_like(x)
    met = tl.full(x.shape, True, tl.int1)
    if HAS_SPHERE & KINDS:
        if kind == SPHERE:
            t, nx, ny, nz, met = sphere_intersect(record, x, y, l, m, n, sense, limit)
    if HAS_CONIC & KINDS:
        if kind == CONIC:
            t, nx, ny, nz, met = conic_intersect(record, x, y, l, m, n, sense, limit)
    scale = tl.load(record + SCALE)
    for k in tl.static_range(len(FORMS)):
        if kind == FORMS[k][CODE]:
            t, nx, ny, nz, met = explicit_intersect(
                record, codes, extras, x, y, l, m, n, sense, limit, scale, FORMS, k
            )
    return t, nx, ny, nz, met


@triton.jit
def passes(record, codes, x, y, KINDS: tl.constexpr):
    """Return whether a point is strictly inside the clear aperture."""
    inside = tl.load(record + EDGE) - (x * x + y * y) > 0.0
    if HAS_FIGURES & KINDS:
        figures = tl.load(codes + FIGURES)
        if figures != 0:
            inside &= clear_of_figures(record + figures, x, y)
    outline, hole = tl.load(codes + OUTLINE), tl.load(codes + HOLE)
    x, y = x - tl.load(record + CENTER_X), y - tl.load(record + CENTER_Y)
    if outline == RECTANGLE:
        inside &= tl.abs(x) < tl.load(record + HALF_X)
        inside &= tl.abs(y) < tl.load(record + HALF_Y)
    if outline == ELLIPSE:
        inside &= tl.load(record + HALF_X) * x * x + tl.load(record + HALF_Y) * y * y < 1.0
    if hole == CIRCLE:
        inside &= x * x + y * y > tl.load(record + HOLE_X)
    if hole == RECTANGLE:
        across = tl.abs(x) > tl.load(record + HOLE_X)
        inside &= across | (tl.abs(y) > tl.load(record + HOLE_Y))
    if hole == ELLIPSE:
        inside &= tl.load(record + HOLE_X) * x * x + tl.load(record + HOLE_Y) * y * y > 1.0
    return inside


@triton.jit
def step(
    codes, record, extras, index, ratio, per_radian,
    x, y, z, l, m, n, path, ended, vignetted,
    KINDS: tl.constexpr, FORMS: tl.constexpr, LAWS: tl.constexpr,
):  # fmt: skip
    """Carry a block through one step.

    Args:
        codes: the step's row.
        record: its numbers.
        extras: places of polynomials' coefficients.
        index: in front.
        ratio: μ.
        per_radian: λ/2π, mm.
        x: to n: the ray, in the axes of the step before.
        path: optical path so far, mm.
        ended: tag and status of a miss or a total reflection, else 0; int32.
        vignetted: of the first aperture that stopped the ray, else 0.
        KINDS: bit k is set where the lens has steps of kind k, and one where apertures are made of
            figures; code for no others is made.
        FORMS: of the surfaces given by their sag that the lens has; see `functions.shape_of`.
        LAWS: of deflection that the lens has; see `functions.law_of`.

    Returns:
        x to vignetted behind the step, and the distance travelled to it.
    """
    kind = tl.load(codes + KIND)
    sense = tl.load(record + SENSE)
    tag = tl.load(record + TAG).to(tl.int32)
    travelled = tl.zeros_like(x)
    if kind >= PLANE:
        t0, towards = distance_to_plane(z + tl.load(record + SHIFT), n, sense)
        limit = tl.load(record + LIMIT)
        x, y = clamp(x + t0 * l, limit), clamp(y + t0 * m, limit)
        towards &= (tl.abs(x) < limit) & (tl.abs(y) < limit)
        t, nx, ny, nz, met = intersect(
            record, codes, extras, kind, x, y, l, m, n, sense, KINDS, FORMS
        )
        towards &= tl.abs(t) < limit
        x, y, z = x + t * l, y + t * m, t * n
        travelled = t0 + t
        ended = tl.where((ended > 0) | (met & towards), ended, tag + MISSED)
        vignetted = tl.where(
            (vignetted > 0) | passes(record, codes, x, y, KINDS), vignetted, tag + VIGNETTED
        )
        if tl.load(codes + REFRACTS) != 0:
            behind = tl.load(record + SENSE_BEHIND)
            l, m, n, transmitted = refract(l, m, n, nx, ny, nz, ratio, behind)
            ended = tl.where((ended > 0) | (transmitted > 0.0), ended, tag + TOTALLY_REFLECTED)
    if HAS_DEFLECT & KINDS:
        if kind == DEFLECT:
            gx, gy, gz, inverse, _, _, _, _ = surface_gradient(
                record, codes, extras, tl.load(codes + BASE), x, y, z, KINDS, FORMS
            )
            for k in tl.static_range(len(LAWS)):
                if tl.load(codes + LAW) == LAWS[k][LAW_CODE]:
                    l, m, n, transmitted, added = LAWS[k][LAW_FORWARD](
                        record + tl.load(codes + NUMBERS), codes, extras, x, y, l, m, n,
                        gx * inverse, gy * inverse, gz * inverse,
                        index, ratio, per_radian, tl.load(record + SENSE_BEHIND),
                    )  # fmt: skip
                    path = path + added
                    ended = tl.where(
                        (ended > 0) | (transmitted > 0.0), ended, tag + TOTALLY_REFLECTED
                    )
    if HAS_CHANGE_AXES & KINDS:
        if kind == CHANGE_AXES:
            x, y, z, l, m, n, travelled = change_axes(record, x, y, z, l, m, n)
    if HAS_LENS_AXES & KINDS:
        if kind == LENS_AXES:
            x, y, z, l, m, n = lens_axes(record, x, y, z, l, m, n)
    if HAS_SENSOR & KINDS:
        if kind == SENSOR:
            travelled, towards = distance_to_plane(z + tl.load(record + SHIFT), n, sense)
            x, y, z = x + travelled * l, y + travelled * m, tl.zeros_like(x)
            ended = tl.where((ended > 0) | towards, ended, tag + MISSED)
    return x, y, z, l, m, n, path + index * travelled, ended, vignetted, travelled


@triton.jit
def explicit_intersect(
    record, codes, extras, x, y, l, m, n, sense, limit, scale,
    FORMS: tl.constexpr, form: tl.constexpr,
):  # fmt: skip
    """Return the distance from the vertex plane, the unit normal there, and whether it is met.

    As `Surface.intersect`: the iteration ends when no ray of the block moves any more, or after
    `MAX_STEPS`; whether a ray has converged is read off its residual at the end.
    """
    # √ε, its power 7/8, and 64 ε.
    close = 2.0**-26 if x.dtype == tl.float64 else 2.0**-11.5
    closest = 2.0**-45.5 if x.dtype == tl.float64 else 2.0**-20.125
    rounding = 2.0**-46 if x.dtype == tl.float64 else 2.0**-17
    t = tl.zeros_like(x)
    if FORMS[form][ON_CONIC]:
        c, k = tl.load(record + SHAPE), tl.load(record + SHAPE + 1)
        start, squared = conic_distance(c, c + (c * k) * (n * n), x, y, l, m, n, sense)
        t = tl.where(squared > 0.0, clamp(start, limit), 0.0)
    moving = tl.full((), 1, tl.int32)
    steps = tl.full((), 0, tl.int32)
    most = tl.full((), MAX_STEPS, tl.int32)
    while (moving > 0) & (steps < most):
        sag, sx, sy, _ = FORMS[form][SAG](record, codes, extras, x + l * t, y + m * t)
        change = divide(sag - n * t, away_from_zero(l * sx + m * sy - n))
        change = clamp(change, scale)
        t = t - change
        moves = tl.abs(change) > close * (tl.abs(t) + scale)
        moving = tl.max(moves.to(tl.int32), 0)
        steps += 1
        if FORMS[form][ON_CONIC]:
            if ((moving == 0) | (steps == most)) & (most == MAX_STEPS):
                # Rays that end at no root that counts begin once more, on the vertex plane.
                sag, sx, sy, _ = FORMS[form][SAG](record, codes, extras, x + l * t, y + m * t)
                slope = l * sx + m * sy - n
                reach = tl.abs(slope) * (tl.abs(t) + scale)
                counts = (sense * slope < 0.0) & (tl.abs(sag - n * t) <= close * reach)
                again = (t != 0.0) & ~counts
                t = tl.where(again, 0.0, t)
                moving = tl.max(again.to(tl.int32), 0)
                most = steps + MAX_STEPS
    # Rays along a tangent are not there yet: they take some steps more.  Where the loop went on to
    # its end, those that converge have done so long before.
    sag, sx, sy, margin = FORMS[form][SAG](record, codes, extras, x + l * t, y + m * t)
    moving = 1 - moving
    for _ in range(MORE_STEPS):
        residual, slope = sag - n * t, l * sx + m * sy - n
        reach = tl.abs(slope) * (tl.abs(t) + scale)
        again = (tl.abs(residual) > closest * reach) & (tl.abs(residual) <= close * reach)
        moving *= tl.max(again.to(tl.int32), 0)
        if moving > 0:
            t = tl.where(again, t - divide(residual, away_from_zero(slope)), t)
            sag, sx, sy, margin = FORMS[form][SAG](record, codes, extras, x + l * t, y + m * t)
    residual = sag - n * t
    slope = l * sx + m * sy - n
    steep = tl.where(tl.abs(slope) > 1.0, tl.abs(slope), 1.0)
    allowed = rounding * (tl.abs(sag) + (tl.abs(t) + scale) * steep)
    met = (sense * slope < 0.0) & (margin > 0.0) & (tl.abs(residual) < allowed)
    # One step more, too short to matter for the slopes.
    change = clamp(divide(residual, away_from_zero(slope)), scale)
    met &= (tl.abs(change) <= 1e-2 * (tl.abs(t) + scale)) & (tl.abs(residual) <= limit)
    t = clamp(t - change, limit)
    nz = divide(1.0, safe_sqrt(1.0 + sx * sx + sy * sy))
    return t, -sx * nz, -sy * nz, nz, met


@triton.jit
def _explicit_gradient(record, codes, extras, x, y, FORMS: tl.constexpr, form: tl.constexpr):
    """Return g = (-s_x, -s_y, 1), 1/|g|, and F's second derivatives xx, xy, yy and zz."""
    sx, sy, sxx, sxy, syy = FORMS[form][HESSIAN](record, codes, extras, x, y)
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
            c = tl.load(record + SHAPE)
            gx, gy, gz, _, xx, zz = gradient_and_second(c, 0.0, x, y, z)
            yy = xx
    if HAS_CONIC & KINDS:
        if kind == CONIC:
            c, k = tl.load(record + SHAPE), tl.load(record + SHAPE + 1)
            gx, gy, gz, inverse, xx, zz = gradient_and_second(c, k, x, y, z)
            yy = xx
    for k in tl.static_range(len(FORMS)):
        if kind == FORMS[k][CODE]:
            gx, gy, gz, inverse, xx, xy, yy, zz = _explicit_gradient(
                record, codes, extras, x, y, FORMS, k
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
            c = tl.load(record + SHAPE)
            of_c, _ = shape_cotangents(c, 0.0, x, y, z, along, ux, uy, uz)
            add_sum(sums + SHAPE, of_c, alive)
    if HAS_CONIC & KINDS:
        if kind == CONIC:
            c, k = tl.load(record + SHAPE), tl.load(record + SHAPE + 1)
            of_c, of_k = shape_cotangents(c, k, x, y, z, along, ux, uy, uz)
            add_sum(sums + SHAPE, of_c, alive)
            add_sum(sums + SHAPE + 1, of_k, alive)
    for k in tl.static_range(len(FORMS)):
        if kind == FORMS[k][CODE]:
            FORMS[k][SUMS](record, codes, extras, sums, x, y, along, -ux, -uy, alive)


@triton.jit
def in_polygon(sides, count, x, y, on_it):
    """Return whether points are inside a polygon; on a side the answer is `on_it`."""
    odd = tl.full(x.shape, 0, tl.int32)
    on = tl.full(x.shape, 0, tl.int32)
    for k in range(count // 4):
        ax, ay = tl.load(sides + 4 * k), tl.load(sides + 4 * k + 1)
        bx, by = tl.load(sides + 4 * k + 2), tl.load(sides + 4 * k + 3)
        u, v = x - ax, y - ay
        cross = (bx - ax) * v - (by - ay) * u
        here = (cross == 0.0) & (u * (x - bx) <= 0.0) & (v * (y - by) <= 0.0)
        on = on | here.to(tl.int32)
        # The lower end of a side counts and the upper one does not.
        upwards = (y >= ay) & (y < by) & (cross > 0.0)
        downwards = (y >= by) & (y < ay) & (cross < 0.0)
        odd = odd ^ (upwards | downwards).to(tl.int32)
    return tl.where(on > 0, on_it, odd > 0)


@triton.jit
def clear_of_figures(figures, x, y):
    """Return whether no figure stops the rays at x, y; `figures` points to their numbers."""
    clear = tl.full(x.shape, 1, tl.int32)
    at = figures + 1
    for _ in range(tl.load(figures).to(tl.int32)):
        kind, count = tl.load(at).to(tl.int32), tl.load(at + 4).to(tl.int32)
        blocks = tl.load(at + 1) > 0.5
        u, v = x - tl.load(at + 2), y - tl.load(at + 3)
        own = at + 5
        inside = tl.full(x.shape, 0, tl.int32)
        if kind == ELLIPTIC:
            square = tl.load(own) * u * u + tl.load(own + 1) * v * v
            within = (square >= tl.load(own + 2)) & (square <= tl.load(own + 3))
            inside = within.to(tl.int32)
        elif kind == ARM:
            c, s = tl.load(own), tl.load(own + 1)
            within = (c * u + s * v >= 0.0) & (tl.abs(c * v - s * u) <= tl.load(own + 2))
            inside = within.to(tl.int32)
        else:
            inside = in_polygon(own, count, u, v, blocks).to(tl.int32)
        clear = clear & (inside != blocks.to(tl.int32)).to(tl.int32)
        at = at + 5 + count
    return clear > 0
