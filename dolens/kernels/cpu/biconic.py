"""A biconic has the sag s = N/(1 + W) with N = c_x·x² + c_y·y² and W² = 1 - e_x·x² - e_y·y².

Here e_x = (1+k_x)·c_x² and e_y = (1+k_y)·c_y².  The record holds c_x, c_y, k_x and k_y.
"""

import math
from collections.abc import Callable
from typing import Any

from numba import njit

from dolens.kernels.cpu.explicit import OPTIONS, given_by_scalars
from dolens.kernels.limits import TINY


def biconic(real: Callable[[float], Any]) -> tuple[Any, Any, Any]:
    """Return the functions of one point for a precision, `real`."""
    zero, half, one, two, tiny = real(0.0), real(0.5), real(1.0), real(2.0), real(TINY)

    @njit(**OPTIONS)
    def roots(ex, ey, x, y):  # noqa: ANN001, ANN202
        """Return W², W, 1/W and 1/(1+W); beyond the branch W hardly moves, and 1/W is zero."""
        squared = one - ex * x * x - ey * y * y
        inside = squared > tiny
        root = math.sqrt(squared if inside else tiny)
        return squared, root, one / root if inside else zero, one / (one + root)

    @njit(**OPTIONS)
    def sag(p, x, y):  # noqa: ANN001, ANN202
        """Return sag, slopes, and W², which is positive on the branch."""
        cx, cy = p[0], p[1]
        ex, ey = (one + p[2]) * cx * cx, (one + p[3]) * cy * cy
        squared, _, g, u = roots(ex, ey, x, y)
        s = (cx * x * x + cy * y * y) * u
        steep = s * g
        return s, x * (two * cx + ex * steep) * u, y * (two * cy + ey * steep) * u, squared

    @njit(**OPTIONS)
    def sag_hessian(p, x, y):  # noqa: ANN001, ANN202
        """Return s_xx, s_xy, s_yy, from s·(1+W) = N: s_xx·(1+W) + 2s_x·W_x + s·W_xx = 2c_x."""
        cx, cy = p[0], p[1]
        ex, ey = (one + p[2]) * cx * cx, (one + p[3]) * cy * cy
        _, _, g, u = roots(ex, ey, x, y)
        s = (cx * x * x + cy * y * y) * u
        steep = s * g
        sx, sy = x * (two * cx + ex * steep) * u, y * (two * cy + ey * steep) * u
        wx, wy = -ex * x * g, -ey * y * g
        return (
            (two * cx - two * sx * wx + s * (ex * g + wx * wx * g)) * u,
            (s * wx * wy * g - sx * wy - sy * wx) * u,
            (two * cy - two * sy * wy + s * (ey * g + wy * wy * g)) * u,
        )

    @njit(**OPTIONS)
    def parameters(p, x, y, of_sag, of_x, of_y):  # noqa: ANN001, ANN202
        """Return the cotangents of the parameters from those of the sag and its slopes.

        With u = 1/(1+W): ∂s/∂c_x at fixed e is x²·u, and ∂s/∂e_x is x²·m with m = s·u/(2W).  Their
        slopes come from those of u and m along (of_x, of_y).
        """
        cx, cy = p[0], p[1]
        ex, ey = (one + p[2]) * cx * cx, (one + p[3]) * cy * cy
        _, _, g, u = roots(ex, ey, x, y)
        s = (cx * x * x + cy * y * y) * u
        steep = s * g
        along = of_x * x * (two * cx + ex * steep) * u + of_y * y * (two * cy + ey * steep) * u
        of_root = -(of_x * ex * x + of_y * ey * y) * g
        m = half * steep * u
        du = -u * u * of_root
        dm = half * u * g * (along - s * of_root * (u + g))
        ax, ay = x * (of_sag * x + two * of_x), y * (of_sag * y + two * of_y)
        of_ex, of_ey = ax * m + x * x * dm, ay * m + y * y * dm
        return (
            ax * u + x * x * du + two * (one + p[2]) * cx * of_ex,
            ay * u + y * y * du + two * (one + p[3]) * cy * of_ey,
            cx * cx * of_ex,
            cy * cy * of_ey,
        )

    return sag, sag_hessian, parameters


KERNELS = given_by_scalars(biconic, numbers=4)
