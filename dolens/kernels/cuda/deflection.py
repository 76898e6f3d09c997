"""All phases share these functions of a block; see `dolens.optics.surfaces.phase`, and for the
adjoint `dolens.kernels.cpu.deflection`.
"""

import triton
import triton.language as tl

from dolens.kernels.cuda.arithmetic import clamp, divide, safe_sqrt
from dolens.kernels.limits import LONGEST, LONGEST_WAVEVECTOR, STEEPEST

_LONGEST, _STEEPEST = tl.constexpr(LONGEST), tl.constexpr(STEEPEST)
_LONGEST_WAVEVECTOR = tl.constexpr(LONGEST_WAVEVECTOR)


@triton.jit
def deflect(phase, px, py, l, m, n, nx, ny, nz, index, ratio, per_radian, sense):
    """Return the directions behind a phase of this value and gradient, cos² of the angle there
    (positive if the order is not evanescent), and the path that it adds.
    """
    scale = divide(per_radian * ratio, index)
    gx, gy = scale * px, scale * py
    bx, by, az = ratio * l, ratio * m, ratio * n
    ax, ay = bx + gx, by + gy
    along = clamp(ax * nx + ay * ny + az * nz, _LONGEST_WAVEVECTOR)
    more = gx * (ax + bx) + gy * (ay + by)
    squared = (1.0 - ratio * ratio) - more + along * along
    squared = tl.where(tl.abs(gx) + tl.abs(gy) < _STEEPEST, squared, -1.0)
    change = sense * safe_sqrt(squared) - along
    return (
        clamp(ax + change * nx, _LONGEST),
        clamp(ay + change * ny, _LONGEST),
        clamp(az + change * nz, _LONGEST),
        squared,
        per_radian * phase,
    )


@triton.jit
def deflect_adjoint(
    px, py, xx, xy, yy, l, m, n, nx, ny, nz, index, ratio, per_radian,
    out_l, out_m, out_n, a, b, c, path,
):  # fmt: skip
    """Return the cotangents of the phase and its gradient; and as a law's adjoint does, of x and y,
    the direction, the normal, and both indices.
    """
    per_index = divide(ratio, index)
    scale = per_radian * per_index
    gx, gy = scale * px, scale * py
    ax, ay, az = ratio * l + gx, ratio * m + gy, ratio * n
    inside = out_l * nx + out_m * ny + out_n * nz
    along = ax * nx + ay * ny + az * nz
    change = inside - along
    of_change = a * nx + b * ny + c * nz
    e = divide(of_change, inside)
    of_along = e * along - of_change
    tx, ty, tz = a + of_along * nx, b + of_along * ny, c + of_along * nz
    of_gx, of_gy = tx - e * ax, ty - e * ay
    of_ratio = (l * tx + m * ty + n * tz) - e * (ratio + gx * l + gy * m)
    of_phase, of_px, of_py = per_radian * path, scale * of_gx, scale * of_gy
    return (
        of_phase,
        of_px,
        of_py,
        of_phase * px + of_px * xx + of_py * xy,
        of_phase * py + of_px * xy + of_py * yy,
        ratio * (tx - e * gx),
        ratio * (ty - e * gy),
        ratio * tz,
        change * a + of_along * ax,
        change * b + of_along * ay,
        change * c + of_along * az,
        of_ratio * per_index,
        -(of_ratio * ratio + gx * of_gx + gy * of_gy) * per_index,
    )
