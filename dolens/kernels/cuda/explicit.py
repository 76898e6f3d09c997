"""Newton's iteration finds the ray intercept on a surface that is given by its sag."""

import triton
import triton.language as tl

from dolens.kernels.cuda.arithmetic import away_from_zero, clamp, divide, safe_sqrt
from dolens.kernels.cuda.conic import conic_distance
from dolens.kernels.cuda.functions import ON_CONIC, SAG
from dolens.kernels.cuda.layout import MAX_STEPS, MORE_STEPS, SHAPE


@triton.jit
def explicit_intersect(
    record, codes, extras, x, y, l, m, n, sense, limit, scale, FORM: tl.constexpr
):
    """Return the distance from the vertex plane, the unit normal there, and whether it is met.

    As `Surface.intersect`: the iteration ends when no ray of the block moves any more, or after
    `MAX_STEPS`; whether a ray has converged is read off its residual at the end.
    """
    # √ε, its power 7/8, and 64 ε.
    close = 2.0**-26 if x.dtype == tl.float64 else 2.0**-11.5
    closest = 2.0**-45.5 if x.dtype == tl.float64 else 2.0**-20.125
    rounding = 2.0**-46 if x.dtype == tl.float64 else 2.0**-17
    t = tl.zeros_like(x)
    if FORM[ON_CONIC]:
        c, k = tl.load(record + SHAPE), tl.load(record + SHAPE + 1)
        start, squared = conic_distance(c, c + (c * k) * (n * n), x, y, l, m, n, sense)
        t = tl.where(squared > 0.0, clamp(start, limit), 0.0)
    moving = tl.full((), 1, tl.int32)
    steps = tl.full((), 0, tl.int32)
    most = tl.full((), MAX_STEPS, tl.int32)
    while (moving > 0) & (steps < most):
        sag, sx, sy, _ = FORM[SAG](record, codes, extras, x + l * t, y + m * t)
        change = divide(sag - n * t, away_from_zero(l * sx + m * sy - n))
        change = clamp(change, scale)
        t = t - change
        moves = tl.abs(change) > close * (tl.abs(t) + scale)
        moving = tl.max(moves.to(tl.int32), 0)
        steps += 1
        if FORM[ON_CONIC]:
            if ((moving == 0) | (steps == most)) & (most == MAX_STEPS):
                # Rays that end at no root that counts begin once more, on the vertex plane.
                sag, sx, sy, _ = FORM[SAG](record, codes, extras, x + l * t, y + m * t)
                slope = l * sx + m * sy - n
                reach = tl.abs(slope) * (tl.abs(t) + scale)
                counts = (sense * slope < 0.0) & (tl.abs(sag - n * t) <= close * reach)
                again = (t != 0.0) & ~counts
                t = tl.where(again, 0.0, t)
                moving = tl.max(again.to(tl.int32), 0)
                most = steps + MAX_STEPS
    # Rays along a tangent are not there yet: they take some steps more.  Where the loop went on to
    # its end, those that converge have done so long before.
    sag, sx, sy, margin = FORM[SAG](record, codes, extras, x + l * t, y + m * t)
    moving, steps = 1 - moving, tl.full((), 0, tl.int32)
    while (moving > 0) & (steps < MORE_STEPS):
        residual, slope = sag - n * t, l * sx + m * sy - n
        reach = tl.abs(slope) * (tl.abs(t) + scale)
        again = (tl.abs(residual) > closest * reach) & (tl.abs(residual) <= close * reach)
        t = tl.where(again, t - divide(residual, away_from_zero(slope)), t)
        moving = tl.max(again.to(tl.int32), 0)
        if moving > 0:
            sag, sx, sy, margin = FORM[SAG](record, codes, extras, x + l * t, y + m * t)
        steps += 1
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
