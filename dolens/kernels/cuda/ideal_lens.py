"""An ideal lens deflects rays on its plane; see `dolens.optics.surfaces.ideal_lens`, and for the
adjoint `dolens.kernels.cpu.ideal_lens`.

Numbers: the power φ, and the reduced vergence V of the light that arrives.
"""

import triton
import triton.language as tl

from dolens.kernels.cuda.arithmetic import GRAZING, add_sum, divide, safe_sqrt
from dolens.kernels.cuda.functions import LawFunctions


@triton.jit
def ideal_lens_forward(numbers, codes, x, y, l, m, n, nx, ny, nz, index, ratio, per_radian, sense):
    """Change slopes and path."""
    behind = divide(index, ratio)
    bend, turn = divide(tl.load(numbers), behind), divide(tl.load(numbers + 1), index)
    cosine = tl.where(tl.abs(n) > GRAZING, tl.abs(n), GRAZING)
    q = divide(1.0, cosine)
    ux, uy = l * q, m * q
    vx, vy = ratio * ux - x * bend, ratio * uy - y * bend
    q2 = safe_sqrt(1.0 + vx * vx + vy * vy)
    wx, wy = ux - x * turn, uy - y * turn
    across = wx * wx + wy * wy
    arrived = divide(x * (ux + wx) + y * (uy + wy), safe_sqrt(1.0 + across) + q)
    left = divide(
        x * (vx + ratio * wx) + y * (vy + ratio * wy),
        safe_sqrt(1.0 + ratio * ratio * across) + q2,
    )
    cosine = divide(1.0, q2)
    added = behind * left - index * arrived
    return vx * cosine, vy * cosine, sense * cosine, 1.0 + tl.zeros_like(x), added


@triton.jit
def ideal_lens_adjoint(
    numbers, codes, sums, x, y, l, m, n, nx, ny, nz, index, ratio, per_radian, sense,
    out_l, out_m, out_n, a, b, c, path, alive,
):  # fmt: skip
    """Sweep cotangents back through the lens."""
    behind = divide(index, ratio)
    per_front, per_behind = divide(1.0, index), divide(1.0, behind)
    bend, turn = tl.load(numbers) * per_behind, tl.load(numbers + 1) * per_front
    q = divide(1.0, tl.abs(n))
    ux, uy = l * q, m * q
    vx, vy = ratio * ux - x * bend, ratio * uy - y * bend
    q2 = safe_sqrt(1.0 + vx * vx + vy * vy)
    wx, wy = ux - x * turn, uy - y * turn
    across = wx * wx + wy * wy
    q0, q02 = safe_sqrt(1.0 + across), safe_sqrt(1.0 + ratio * ratio * across)
    first, second = divide(1.0, q0 + q), divide(1.0, q02 + q2)
    arrived = (x * (ux + wx) + y * (uy + wy)) * first
    left = (x * (vx + ratio * wx) + y * (vy + ratio * wy)) * second

    cosine = divide(1.0, q2)
    of_front, of_behind = -path * arrived, path * left
    of_s1, of_s2 = -path * index * first, path * behind * second
    of_q2 = -(a * vx + b * vy + c * sense) * cosine * cosine - of_s2 * left
    of_q = -of_s1 * arrived
    # Twice the cotangent of w².
    of_across = divide(of_q, q0) - divide(of_s2 * left * ratio * ratio, q02)
    of_x = of_s1 * (ux + wx) + of_s2 * (vx + ratio * wx)
    of_y = of_s1 * (uy + wy) + of_s2 * (vy + ratio * wy)
    of_wx = (of_s1 + of_s2 * ratio) * x + of_across * wx
    of_wy = (of_s1 + of_s2 * ratio) * y + of_across * wy
    of_ratio = of_s2 * (x * wx + y * wy) - divide(of_s2 * left * ratio * across, q02)
    of_vx = a * cosine + of_s2 * x + of_q2 * vx * cosine
    of_vy = b * cosine + of_s2 * y + of_q2 * vy * cosine
    of_turn = -(x * of_wx + y * of_wy)
    of_bend = -(x * of_vx + y * of_vy)
    of_ratio += ux * of_vx + uy * of_vy
    of_x -= turn * of_wx + bend * of_vx
    of_y -= turn * of_wy + bend * of_vy
    of_ux = of_s1 * x + of_wx + ratio * of_vx
    of_uy = of_s1 * y + of_wy + ratio * of_vy
    of_q += l * of_ux + m * of_uy
    add_sum(sums, of_bend * per_behind, alive)
    add_sum(sums + 1, of_turn * per_front, alive)
    of_front += (of_ratio * ratio - of_turn * turn) * per_front
    of_behind -= (of_ratio * ratio + of_bend * bend) * per_behind
    zero = tl.zeros_like(x)
    return (
        of_x, of_y, of_ux * q, of_uy * q, -of_q * q * q * sense,
        zero, zero, zero, of_front, of_behind,
    )  # fmt: skip


KERNELS = LawFunctions(ideal_lens_forward, ideal_lens_adjoint)
