"""A law deflects rays where they stand on a surface: a phase, or any other law; see
`dolens.optics.surfaces.deflection`.

The surface gives the normal by its block functions `sag` and `sag_hessian`, and the phase gives φ,
its gradient and its second derivatives by its own, all by address in the codes.
"""

import math
from collections.abc import Callable
from functools import cache
from typing import Any, NamedTuple

from numba import carray, types

from dolens.kernels.cpu.compiler import LawBlocks, Row, call_block, shifted
from dolens.kernels.cpu.layout import (
    BLOCK,
    CODE_ROW,
    ENDED,
    INDEX,
    INVERSE_INDEX,
    NUMBERS,
    OF_BEHIND,
    OF_FRONT,
    OF_PHASE,
    OF_PHASE_X,
    OF_PHASE_Y,
    OF_RECORD,
    OF_SAG,
    OF_SHIFT,
    OF_SLOPE_X,
    OF_SLOPE_Y,
    PARAMETERS,
    PATH,
    PER_RADIAN,
    PHASE,
    PHASE_AND_SLOPES,
    PHASE_HESSIAN,
    PHASE_PARAMETERS,
    PHASE_X,
    PHASE_XX,
    PHASE_XY,
    PHASE_Y,
    PHASE_YY,
    POINT_X,
    POINT_Y,
    RATIO,
    SAG_AND_SLOPES,
    SAG_HESSIAN,
    SAG_XX,
    SAG_XY,
    SAG_YY,
    SENSE_BEHIND,
    SHAPE,
    SHORT_RECORD,
    SLOPE_X,
    SLOPE_Y,
    STATE,
    TAG,
    TOTALLY_REFLECTED,
    TRAVELLED,
    UNBOUNDED,
    VIGNETTED,
    WORK_SIZE,
    L,
    M,
    N,
    X,
    Y,
    Z,
)
from dolens.kernels.cpu.shapes import Size, block_factory, sizes_of
from dolens.kernels.cpu.translation import scalar
from dolens.kernels.refraction import deflect, deflect_adjoint
from dolens.kernels.shapes import LawFunctions, PhaseFunctions
from dolens.kernels.table import Code


def phase_forward(real: types.Type) -> Callable[..., None]:
    """Deflect a block of rays that stand on a surface; an evanescent order ends them."""
    behind_phase = scalar(deflect, real)
    zero, one, totally_reflected = real(0.0), real(1.0), real(TOTALLY_REFLECTED)

    def kernel(before, after, cotangents, record, work, codes):  # noqa: ANN001, ANN202
        src, dst = carray(before, STATE), carray(after, STATE)
        p, w, q = carray(record, SHORT_RECORD), carray(work, WORK_SIZE), carray(codes, CODE_ROW)
        sense, evanescent = p[SENSE_BEHIND], p[TAG] + totally_reflected
        for i in range(BLOCK):
            w[POINT_X + i] = src[X + i]
            w[POINT_Y + i] = src[Y + i]
        call_block(q[SAG_AND_SLOPES], before, after, cotangents, record, work, codes)
        call_block(q[PHASE_AND_SLOPES], before, after, cotangents, record, work, codes)
        for i in range(BLOCK):
            ratio, per_radian = w[RATIO + i], w[PER_RADIAN + i]
            scale = per_radian * ratio * w[INVERSE_INDEX + i]
            sx, sy = w[SLOPE_X + i], w[SLOPE_Y + i]
            nz = one / math.sqrt(one + sx * sx + sy * sy)
            l, m, n, transmitted = behind_phase(  # noqa: E741
                scale * w[PHASE_X + i], scale * w[PHASE_Y + i], src[L + i], src[M + i], src[N + i],
                -sx * nz, -sy * nz, nz, ratio, sense,
            )  # fmt: skip
            dst[X + i], dst[Y + i], dst[Z + i] = src[X + i], src[Y + i], src[Z + i]
            dst[L + i], dst[M + i], dst[N + i] = l, m, n
            dst[PATH + i] = src[PATH + i] + per_radian * w[PHASE + i]
            ended = src[ENDED + i]
            dst[ENDED + i] = ended if ended > zero or transmitted > zero else evanescent
            dst[VIGNETTED + i], dst[TRAVELLED + i] = src[VIGNETTED + i], zero

    return kernel


def phase_adjoint(real: types.Type) -> Callable[..., None]:
    """Sweep cotangents back through a phase, in place."""
    before_phase = scalar(deflect_adjoint, real)
    zero, one = real(0.0), real(1.0)

    def kernel(before, after, cotangents, record, work, codes):  # noqa: ANN001, ANN202
        src, dst = carray(before, STATE), carray(after, STATE)
        w, q = carray(work, WORK_SIZE), carray(codes, CODE_ROW)
        cot = carray(cotangents, UNBOUNDED)
        for i in range(BLOCK):
            w[POINT_X + i] = src[X + i]
            w[POINT_Y + i] = src[Y + i]
        call_block(q[SAG_HESSIAN], before, after, cotangents, record, work, codes)
        call_block(q[PHASE_HESSIAN], before, after, cotangents, record, work, codes)
        for i in range(BLOCK):
            ratio, per_radian, per_index = w[RATIO + i], w[PER_RADIAN + i], w[INVERSE_INDEX + i]
            scale = per_radian * ratio * per_index
            sx, sy = w[SLOPE_X + i], w[SLOPE_Y + i]
            nz = one / math.sqrt(one + sx * sx + sy * sy)
            nx, ny = -sx * nz, -sy * nz
            of_gx, of_gy, l, m, n, vx, vy, vz, front, behind = before_phase(  # noqa: E741
                scale * w[PHASE_X + i], scale * w[PHASE_Y + i], src[L + i], src[M + i], src[N + i],
                nx, ny, nz, dst[L + i], dst[M + i], dst[N + i],
                cot[L + i], cot[M + i], cot[N + i], ratio, per_index,
            )  # fmt: skip
            across = vx * nx + vy * ny + vz * nz
            of_sx, of_sy = -(vx - across * nx) * nz, -(vy - across * ny) * nz
            path = per_radian * cot[PATH + i]
            of_px, of_py = scale * of_gx, scale * of_gy
            cot[X + i] += (
                of_sx * w[SAG_XX + i] + of_sy * w[SAG_XY + i]
                + path * w[PHASE_X + i] + of_px * w[PHASE_XX + i] + of_py * w[PHASE_XY + i]
            )  # fmt: skip
            cot[Y + i] += (
                of_sx * w[SAG_XY + i] + of_sy * w[SAG_YY + i]
                + path * w[PHASE_Y + i] + of_px * w[PHASE_XY + i] + of_py * w[PHASE_YY + i]
            )  # fmt: skip
            cot[L + i], cot[M + i], cot[N + i] = l, m, n
            cot[OF_FRONT + i], cot[OF_BEHIND + i], cot[OF_SHIFT + i] = front, behind, zero
            w[OF_SAG + i], w[OF_SLOPE_X + i], w[OF_SLOPE_Y + i] = zero, of_sx, of_sy
            w[OF_PHASE + i], w[OF_PHASE_X + i], w[OF_PHASE_Y + i] = path, of_px, of_py
        call_block(q[PARAMETERS], before, after, cotangents, record, work, codes)
        call_block(q[PHASE_PARAMETERS], before, after, cotangents, record, work, codes)

    return kernel


def _phase_block(real: types.Type, phase: Any, unpacked: Any) -> Callable[..., None]:
    def kernel(before, after, cotangents, record, work, codes):  # noqa: ANN001, ANN202
        w, q = carray(work, WORK_SIZE), carray(codes, CODE_ROW)
        p = unpacked(shifted(record, q[NUMBERS]))
        for i in range(BLOCK):
            value, x, y = phase(p, w[POINT_X + i], w[POINT_Y + i])
            w[PHASE + i], w[PHASE_X + i], w[PHASE_Y + i] = value, x, y

    return kernel


def _hessian_block(real: types.Type, phase_hessian: Any, unpacked: Any) -> Callable[..., None]:
    def kernel(before, after, cotangents, record, work, codes):  # noqa: ANN001, ANN202
        w, q = carray(work, WORK_SIZE), carray(codes, CODE_ROW)
        p = unpacked(shifted(record, q[NUMBERS]))
        for i in range(BLOCK):
            value, x, y, xx, xy, yy = phase_hessian(p, w[POINT_X + i], w[POINT_Y + i])
            w[PHASE + i], w[PHASE_X + i], w[PHASE_Y + i] = value, x, y
            w[PHASE_XX + i], w[PHASE_XY + i], w[PHASE_YY + i] = xx, xy, yy

    return kernel


def _parameters_block(real: types.Type, parameters: Any, unpacked: Any) -> Callable[..., None]:
    def kernel(before, after, cotangents, record, work, codes):  # noqa: ANN001, ANN202
        w, q = carray(work, WORK_SIZE), carray(codes, CODE_ROW)
        p = unpacked(shifted(record, q[NUMBERS]))
        out = shifted(cotangents, OF_RECORD + BLOCK * q[NUMBERS])
        for i in range(BLOCK):
            parameters(
                shifted(out, i), p, w[POINT_X + i], w[POINT_Y + i],
                w[OF_PHASE + i], w[OF_PHASE_X + i], w[OF_PHASE_Y + i],
            )  # fmt: skip

    return kernel


def _law_block(real: types.Type, forward: Any, unpacked: Any) -> Callable[..., None]:
    zero = real(0.0)

    def kernel(before, after, cotangents, record, work, codes):  # noqa: ANN001, ANN202
        src, dst = carray(before, STATE), carray(after, STATE)
        w, q = carray(work, WORK_SIZE), carray(codes, CODE_ROW)
        p = unpacked(shifted(record, q[NUMBERS]))
        sense = carray(record, SHORT_RECORD)[SENSE_BEHIND]
        for i in range(BLOCK):
            x, y, index = src[X + i], src[Y + i], w[INDEX + i]
            l, m, n, path = forward(  # noqa: E741
                p, x, y, src[L + i], src[M + i], src[N + i],
                index, w[INVERSE_INDEX + i], w[RATIO + i], sense,
            )  # fmt: skip
            dst[X + i], dst[Y + i], dst[Z + i] = x, y, src[Z + i]
            dst[L + i], dst[M + i], dst[N + i] = l, m, n
            dst[PATH + i] = src[PATH + i] + path
            dst[ENDED + i], dst[VIGNETTED + i] = src[ENDED + i], src[VIGNETTED + i]
            dst[TRAVELLED + i] = zero

    return kernel


def _law_adjoint_block(real: types.Type, adjoint: Any, unpacked: Any) -> Callable[..., None]:
    zero = real(0.0)

    def kernel(before, after, cotangents, record, work, codes):  # noqa: ANN001, ANN202
        src, cot = carray(before, STATE), carray(cotangents, UNBOUNDED)
        w, q = carray(work, WORK_SIZE), carray(codes, CODE_ROW)
        p = unpacked(shifted(record, q[NUMBERS]))
        sense = carray(record, SHORT_RECORD)[SENSE_BEHIND]
        out = shifted(cotangents, OF_RECORD + BLOCK * q[NUMBERS])
        for i in range(BLOCK):
            x, y, l, m, n, front, behind = adjoint(  # noqa: E741
                shifted(out, i), p, src[X + i], src[Y + i], src[L + i], src[M + i], src[N + i],
                w[INDEX + i], w[INVERSE_INDEX + i], w[RATIO + i], sense,
                cot[L + i], cot[M + i], cot[N + i], cot[PATH + i],
            )  # fmt: skip
            cot[X + i] += x
            cot[Y + i] += y
            cot[L + i], cot[M + i], cot[N + i] = l, m, n
            cot[OF_FRONT + i], cot[OF_BEHIND + i], cot[OF_SHIFT + i] = front, behind, zero
        for j in range(SHAPE, q[NUMBERS]):
            of_shape = carray(shifted(cotangents, OF_RECORD + BLOCK * j), BLOCK)
            for i in range(BLOCK):
                of_shape[i] = zero

    return kernel


@cache
def _law_blocks(law: PhaseFunctions | LawFunctions, sizes: tuple[Size, ...]) -> LawBlocks:
    if isinstance(law, LawFunctions):
        return LawBlocks(
            block_factory(law.forward, _law_block, f"{law.name}_forward", sizes),
            block_factory(law.adjoint, _law_adjoint_block, f"{law.name}_adjoint", sizes),
        )
    return LawBlocks(
        phase_forward,
        phase_adjoint,
        block_factory(law.phase, _phase_block, f"{law.name}_phase", sizes),
        block_factory(law.phase_hessian, _hessian_block, f"{law.name}_hessian", sizes),
        block_factory(law.parameters, _parameters_block, f"{law.name}_parameters", sizes),
    )


class LawKernels(NamedTuple):
    """The kernels of a law differ with the lengths of its series, and with its table."""

    law: PhaseFunctions | LawFunctions

    def of(self, row: Row, extras: Row) -> LawBlocks:
        """Return the functions of a step with this row of codes, and the lens's extras."""
        return _law_blocks(self.law, sizes_of(self.law.layout, row, extras, Code.LAW_EXTRAS))


kernels = LawKernels
