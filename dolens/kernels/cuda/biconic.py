"""A biconic has the sag s = N/(1 + W) with N = c_x·x² + c_y·y² and W² = 1 - e_x·x² - e_y·y².

Here e_x = (1+k_x)·c_x² and e_y = (1+k_y)·c_y².  The record holds c_x, c_y, k_x and k_y.
"""

import triton
import triton.language as tl

from dolens.kernels.cuda.arithmetic import TINY, add_sum, divide, safe_sqrt
from dolens.kernels.cuda.functions import SagFunctions
from dolens.kernels.cuda.layout import SHAPE


@triton.jit
def _parts(record, x, y):
    """Return c, e, W², 1/W and 1/(1+W), the sag, and its slopes."""
    cx, cy = tl.load(record + SHAPE), tl.load(record + SHAPE + 1)
    ex = (1.0 + tl.load(record + SHAPE + 2)) * cx * cx
    ey = (1.0 + tl.load(record + SHAPE + 3)) * cy * cy
    squared = 1.0 - ex * x * x - ey * y * y
    root = safe_sqrt(squared)
    # Beyond the branch the surface goes on as a paraboloid.
    g = tl.where(squared > TINY, divide(1.0 + tl.zeros_like(x), root), 0.0)
    u = divide(1.0 + tl.zeros_like(x), 1.0 + root)
    s = (cx * x * x + cy * y * y) * u
    sx, sy = x * (2.0 * cx + ex * s * g) * u, y * (2.0 * cy + ey * s * g) * u
    return cx, cy, ex, ey, squared, g, u, s, sx, sy


@triton.jit
def biconic_sag(record, codes, extras, x, y):
    """Return sag, slopes, and W², which is positive on the branch."""
    _, _, _, _, squared, _, _, s, sx, sy = _parts(record, x, y)
    return s, sx, sy, squared


@triton.jit
def biconic_hessian(record, codes, extras, x, y):
    """Return slopes and second derivatives, from s·(1+W) = N."""
    cx, cy, ex, ey, _, g, u, s, sx, sy = _parts(record, x, y)
    wx, wy = -ex * x * g, -ey * y * g
    return (
        sx,
        sy,
        (2.0 * cx - 2.0 * sx * wx + s * (ex * g + wx * wx * g)) * u,
        (s * wx * wy * g - sx * wy - sy * wx) * u,
        (2.0 * cy - 2.0 * sy * wy + s * (ey * g + wy * wy * g)) * u,
    )


@triton.jit
def biconic_sums(record, codes, extras, sums, x, y, of_sag, of_sx, of_sy, alive):
    """Add the cotangents of c_x, c_y, k_x and k_y, from those of the sag and its slopes.

    At fixed e ∂s/∂c_x is x²·u with u = 1/(1+W), and ∂s/∂e_x is x²·m with m = s·u/(2W).
    """
    cx, cy, ex, ey, _, g, u, s, sx, sy = _parts(record, x, y)
    of_root = -(of_sx * ex * x + of_sy * ey * y) * g
    m = 0.5 * s * g * u
    du = -u * u * of_root
    dm = 0.5 * u * g * (of_sx * sx + of_sy * sy - s * of_root * (u + g))
    ax, ay = x * (of_sag * x + 2.0 * of_sx), y * (of_sag * y + 2.0 * of_sy)
    of_ex, of_ey = ax * m + x * x * dm, ay * m + y * y * dm
    ky, kx = tl.load(record + SHAPE + 3), tl.load(record + SHAPE + 2)
    add_sum(sums + SHAPE, ax * u + x * x * du + 2.0 * (1.0 + kx) * cx * of_ex, alive)
    add_sum(sums + SHAPE + 1, ay * u + y * y * du + 2.0 * (1.0 + ky) * cy * of_ey, alive)
    add_sum(sums + SHAPE + 2, cx * cx * of_ex, alive)
    add_sum(sums + SHAPE + 3, cy * cy * of_ey, alive)


KERNELS = SagFunctions(biconic_sag, biconic_hessian, biconic_sums)
