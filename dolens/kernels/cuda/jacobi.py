"""The recurrence of Jacobi polynomials; see `dolens.optics.surfaces.zernike`."""

import triton
import triton.language as tl

from dolens.kernels.cuda.arithmetic import divide


@triton.jit
def recurrence(k, m, unit):
    """Return (α, β, γ) of P_k = (α·q + β)·P_(k-1) - γ·P_(k-2), in the precision of `unit`, a one.

    k = 1 has factors of zero over zero at m = 0, which are left out.
    """
    first = k == 1
    below, here, both = unit * (2 * k + m - 2), unit * (2 * k + m - 1), unit * (2 * k + m)
    scale = 2.0 * (unit * k) * (unit * (k + m)) * below
    scale = tl.where(first, unit, scale)
    slope = divide(here * both * below, scale)
    offset = -divide(here * (unit * m) * (unit * m), scale) - slope
    c = divide(2.0 * (unit * (k - 1)) * (unit * (k + m - 1)) * both, scale)
    a = tl.where(first, unit * (m + 2), 2.0 * slope)
    return a, tl.where(first, -unit * (m + 1), offset), tl.where(first, 0.0 * unit, c)


@triton.jit
def advance(e, f, g, q, p, low, d, low_d):
    """Return P_k, P_(k-1), and their derivatives, from those of one order less.

    P_k = (e·q + f)·P_(k-1) - g·P_(k-2).
    """
    return (e * q + f) * p - g * low, p, (e * q + f) * d + e * p - g * low_d, d


@triton.jit
def advance_second(e, f, g, q, d, h, low_h):
    """Return the second derivatives of P_k and P_(k-1), from them and d = P'_(k-1)."""
    return (e * q + f) * h + 2.0 * e * d - g * low_h, h
