"""An XY phase φ = m·Σ a_ij·u^i·v^j with u = x/R, v = y/R; see `dolens.kernels.cpu.phases.xy`."""

import triton
import triton.language as tl

from dolens.kernels.cuda.arithmetic import add_sum, deflect, deflect_adjoint, divide
from dolens.kernels.cuda.functions import LawFunctions
from dolens.kernels.cuda.layout import LENGTH, NUMBERS


@triton.jit
def _degree(codes):
    """Return the highest degree."""
    terms = tl.load(codes + LENGTH) - tl.load(codes + NUMBERS) - 2
    degree = 0
    while degree * (degree + 3) // 2 < terms:
        degree += 1
    return degree


@triton.jit
def _scaled(numbers, x, y):
    """Return m, 1/R, u and v."""
    inverse = divide(1.0 + tl.zeros_like(x), tl.load(numbers + 1) + tl.zeros_like(x))
    return tl.load(numbers), inverse, inverse * x, inverse * y


@triton.jit
def _horner(numbers, degree, u, v):
    """Return Σ, Σ_u, Σ_v, Σ_uu, Σ_uv and Σ_vv by Horner's rule in u within one in v."""
    p, pu, pv = tl.zeros_like(u), tl.zeros_like(u), tl.zeros_like(u)
    half_uu, puv, half_vv = tl.zeros_like(u), tl.zeros_like(u), tl.zeros_like(u)
    for back_j in range(degree + 1):
        j = degree - back_j
        r, ru, half_ruu = tl.zeros_like(u), tl.zeros_like(u), tl.zeros_like(u)
        for back_k in range(back_j + 1):
            total = degree - back_k
            place = 1 + total * (total + 1) // 2 + j
            half_ruu = half_ruu * u + ru
            ru = ru * u + r
            r = r * u + tl.load(numbers + place, mask=total > 0, other=0.0)
        half_vv = half_vv * v + pv
        puv = puv * v + pu
        half_uu = half_uu * v + half_ruu
        pv = pv * v + p
        pu = pu * v + ru
        p = p * v + r
    return p, pu, pv, 2.0 * half_uu, puv, 2.0 * half_vv


@triton.jit
def xy_forward(numbers, codes, x, y, l, m, n, nx, ny, nz, index, ratio, per_radian, sense):
    """Deflect rays by an XY phase."""
    order, inverse, u, v = _scaled(numbers, x, y)
    p, pu, pv, _, _, _ = _horner(numbers, _degree(codes), u, v)
    slope = order * inverse
    return deflect(
        order * p, slope * pu, slope * pv,
        l, m, n, nx, ny, nz, index, ratio, per_radian, sense,
    )  # fmt: skip


@triton.jit
def xy_adjoint(
    numbers, codes, sums, x, y, l, m, n, nx, ny, nz, index, ratio, per_radian, sense,
    out_l, out_m, out_n, a, b, c, path, alive,
):  # fmt: skip
    """Sweep cotangents back through an XY phase."""
    order, inverse, u, v = _scaled(numbers, x, y)
    degree = _degree(codes)
    _, pu, pv, puu, puv, pvv = _horner(numbers, degree, u, v)
    slope = order * inverse
    second = slope * inverse
    of_phase, of_px, of_py, qx, qy, a, b, c, vx, vy, vz, of_front, of_behind = deflect_adjoint(
        slope * pu, slope * pv, second * puu, second * puv, second * pvv,
        l, m, n, nx, ny, nz, index, ratio, per_radian, out_l, out_m, out_n, a, b, c, path,
    )  # fmt: skip
    of_phase, of_px, of_py = order * of_phase, slope * of_px, slope * of_py
    power_v, lower_v = 1.0 + tl.zeros_like(x), tl.zeros_like(x)
    for j in range(degree + 1):
        power_u, lower_u = 1.0 + tl.zeros_like(x), tl.zeros_like(x)
        for k in range(degree + 1 - j):
            total = k + j
            if total > 0:
                of_a = of_phase * power_u * power_v + of_px * (k * 1.0) * lower_u * power_v
                of_a += of_py * (j * 1.0) * power_u * lower_v
                add_sum(sums + 1 + total * (total + 1) // 2 + j, of_a, alive)
            lower_u = power_u
            power_u = power_u * u
        lower_v = power_v
        power_v = power_v * v
    return qx, qy, a, b, c, vx, vy, vz, of_front, of_behind


KERNELS = LawFunctions(xy_forward, xy_adjoint)
