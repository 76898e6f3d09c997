"""A step carries a block of rays through a surface, to other axes, or to the sensor."""

import triton
import triton.language as tl

from dolens.kernels.cuda.arithmetic import clamp, distance_to_plane, refract
from dolens.kernels.cuda.axes import change_axes, lens_axes
from dolens.kernels.cuda.conic import conic_intersect, sphere_intersect
from dolens.kernels.cuda.explicit import explicit_intersect
from dolens.kernels.cuda.figures import clear_of_figures
from dolens.kernels.cuda.functions import CODE, LAW_CODE, LAW_FORWARD
from dolens.kernels.cuda.gradient import surface_gradient
from dolens.kernels.cuda.layout import (
    BASE,
    CENTER_X,
    CENTER_Y,
    CHANGE_AXES,
    CIRCLE,
    CONIC,
    DEFLECT,
    EDGE,
    ELLIPSE,
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
    MISSED,
    NUMBERS,
    OUTLINE,
    PLANE,
    RECTANGLE,
    REFRACTS,
    SCALE,
    SENSE,
    SENSE_BEHIND,
    SENSOR,
    SHIFT,
    SPHERE,
    TAG,
    TOTALLY_REFLECTED,
    VIGNETTED,
)


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
                record, codes, extras, x, y, l, m, n, sense, limit, scale, FORMS[k]
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
                        record + tl.load(codes + NUMBERS), codes, x, y, l, m, n,
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
