"""A law's functions are compiled for a block of rays: those of a phase, or of any other law."""

from functools import cache

import triton.language as tl

from dolens.kernels import refraction
from dolens.kernels.cuda.arithmetic import divide
from dolens.kernels.cuda.functions import LawKernels
from dolens.kernels.cuda.layout import LAW_EXTRAS
from dolens.kernels.cuda.shapes import bound, unpacked
from dolens.kernels.cuda.translation import compiled
from dolens.kernels.shapes import LawFunctions, PhaseFunctions

deflect, deflect_adjoint = compiled(refraction.deflect), compiled(refraction.deflect_adjoint)


# The names in capitals are bound for each law.
def _phase(
    numbers, codes, extras, x, y, l, m, n, nx, ny, nz, index, ratio, per_radian, sense
):  # fmt: skip
    p = unpacked(numbers, codes, extras + tl.load(codes + LAW_EXTRAS), LAYOUT)  # noqa: F821
    phase, px, py = PHASE(p, x, y)  # noqa: F821
    scale = divide(per_radian * ratio, index)
    l, m, n, transmitted = deflect(scale * px, scale * py, l, m, n, nx, ny, nz, ratio, sense)
    return l, m, n, transmitted, per_radian * phase


def _phase_adjoint(
    numbers, codes, extras, sums, x, y, l, m, n, nx, ny, nz, index, ratio, per_radian, sense,
    out_l, out_m, out_n, a, b, c, path, alive,
):  # fmt: skip
    p = unpacked(numbers, codes, extras + tl.load(codes + LAW_EXTRAS), LAYOUT)  # noqa: F821
    _, px, py, xx, xy, yy = HESSIAN(p, x, y)  # noqa: F821
    per_index = divide(1.0, index)
    scale = per_radian * ratio * per_index
    of_gx, of_gy, a, b, c, vx, vy, vz, of_front, of_behind = deflect_adjoint(
        scale * px, scale * py, l, m, n, nx, ny, nz, out_l, out_m, out_n, a, b, c, ratio, per_index
    )
    of_phase, of_px, of_py = per_radian * path, scale * of_gx, scale * of_gy
    qx = of_phase * px + of_px * xx + of_py * xy
    qy = of_phase * py + of_px * xy + of_py * yy
    PARAMETERS((sums, alive), p, x, y, of_phase, of_px, of_py)  # noqa: F821
    return qx, qy, a, b, c, vx, vy, vz, of_front, of_behind


def _forward(
    numbers, codes, extras, x, y, l, m, n, nx, ny, nz, index, ratio, per_radian, sense
):  # fmt: skip
    p = unpacked(numbers, codes, extras + tl.load(codes + LAW_EXTRAS), LAYOUT)  # noqa: F821
    l, m, n, path = FORWARD(  # noqa: F821
        p, x, y, l, m, n, index, divide(1.0, index), ratio, sense
    )
    return l, m, n, 1.0 + tl.zeros_like(x), path


def _adjoint(
    numbers, codes, extras, sums, x, y, l, m, n, nx, ny, nz, index, ratio, per_radian, sense,
    out_l, out_m, out_n, a, b, c, path, alive,
):  # fmt: skip
    p = unpacked(numbers, codes, extras + tl.load(codes + LAW_EXTRAS), LAYOUT)  # noqa: F821
    qx, qy, a, b, c, of_front, of_behind = ADJOINT(  # noqa: F821
        (sums, alive), p, x, y, l, m, n, index, divide(1.0, index), ratio, sense, a, b, c, path
    )
    zero = tl.zeros_like(x)
    return qx, qy, a, b, c, zero, zero, zero, of_front, of_behind


@cache
def kernels(law: PhaseFunctions | LawFunctions) -> LawKernels:
    """Return the functions of a law."""
    names = f"{law.name}_forward", f"{law.name}_adjoint"
    if isinstance(law, LawFunctions):
        return LawKernels(
            bound(_forward, names[0], law.layout, FORWARD=law.forward),
            bound(_adjoint, names[1], law.layout, ADJOINT=law.adjoint),
        )
    parts = {"HESSIAN": law.phase_hessian, "PARAMETERS": law.parameters}
    return LawKernels(
        bound(_phase, names[0], law.layout, PHASE=law.phase),
        bound(_phase_adjoint, names[1], law.layout, **parts),
    )
