"""Jacobi polynomials of a block of rays; see `dolens.optics.surfaces.zernike`."""

from functools import cache
from typing import Any

from numba import carray, njit, types

from dolens.kernels.cpu.compiler import OPTIONS, shifted
from dolens.kernels.cpu.layout import BLOCK

# Rows behind the pointer that the functions take: P_k and P_(k-1), and their derivatives.
VALUE, SLOPE, SECOND, LOWER, LOWER_SLOPE, LOWER_SECOND = (BLOCK * row for row in range(6))
ROWS = 6
SIZE = ROWS * BLOCK


@cache
def jacobi(real: types.Type) -> tuple[Any, Any, Any]:
    """Compile the recurrence's coefficients, its beginning P_0 = 1, and one step of a block."""
    zero, one, two = real(0.0), real(1.0), real(2.0)

    @njit(**OPTIONS)
    def recurrence(k, m):  # noqa: ANN001, ANN202
        """Return (α, β, γ) of P_k = (α·q + β)·P_(k-1) - γ·P_(k-2)."""
        if k == 1:
            return real(m + 2), -real(m + 1), zero
        below, here, both = real(2 * k + m - 2), real(2 * k + m - 1), real(2 * k + m)
        inverse = one / (two * real(k) * real(k + m) * below)
        slope = here * both * below * inverse
        return (
            two * slope,
            -(here * real(m) * real(m) * inverse) - slope,
            two * real(k - 1) * real(k + m - 1) * both * inverse,
        )

    @njit(**OPTIONS)
    def begin(rows):  # noqa: ANN001, ANN202
        r = carray(rows, SIZE)
        for i in range(BLOCK):
            r[VALUE + i], r[SLOPE + i], r[SECOND + i] = one, zero, zero
            r[LOWER + i], r[LOWER_SLOPE + i], r[LOWER_SECOND + i] = zero, zero, zero

    @njit(**OPTIONS)
    def advance(rows, q, a, b, c):  # noqa: ANN001, ANN202
        """Go from P_(k-1) to P_k, at the numbers that `q` points to."""
        r, at = carray(rows, SIZE), carray(shifted(q, 0), BLOCK)
        for i in range(BLOCK):
            factor = a * at[i] + b
            value, slope, second = r[VALUE + i], r[SLOPE + i], r[SECOND + i]
            r[VALUE + i] = factor * value - c * r[LOWER + i]
            r[SLOPE + i] = factor * slope + a * value - c * r[LOWER_SLOPE + i]
            r[SECOND + i] = factor * second + two * a * slope - c * r[LOWER_SECOND + i]
            r[LOWER + i], r[LOWER_SLOPE + i], r[LOWER_SECOND + i] = value, slope, second

    return recurrence, begin, advance
