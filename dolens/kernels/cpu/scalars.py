"""Three functions of one point make a surface's kernels: the simplest way to a fast surface.

The functions are inlined in the loops over a block's rays, which LLVM then vectorises.
"""

from collections.abc import Callable
from functools import wraps
from typing import Any

from numba import carray, types
from numba.np.unsafe.ndarray import to_fixed_tuple

from dolens.errors import InputError
from dolens.kernels.cpu.compiler import OPTIONS, Factory, shifted
from dolens.kernels.cpu.explicit import given_by_sag
from dolens.kernels.cpu.functions import StepFunctions
from dolens.kernels.cpu.layout import (
    BLOCK,
    MARGIN,
    OF_SAG,
    OF_SHAPE,
    OF_SLOPE_X,
    OF_SLOPE_Y,
    POINT_X,
    POINT_Y,
    SAG,
    SAG_XX,
    SAG_XY,
    SAG_YY,
    SLOPE_X,
    SLOPE_Y,
    UNBOUNDED,
    WORK_SIZE,
)
from dolens.kernels.cpu.records import SHAPE

__all__ = ["OPTIONS", "given_by_scalars"]

Functions = Callable[[types.Type], tuple[Any, Any, Any]]


def given_by_scalars(functions: Functions, numbers: int) -> StepFunctions:
    """Return the kernels of a surface that is given by its sag, from scalar functions.

    Args:
        functions: of a real type; it returns three functions compiled with `njit(**OPTIONS)`:
            `sag(p, x, y)` gives sag (mm), ∂s/∂x, ∂s/∂y, and a margin that is positive where the
            sag exists; where it does not, the numbers must be finite;
            `sag_hessian(p, x, y)` gives ∂²s/∂x², ∂²s/∂x∂y and ∂²s/∂y² (1/mm);
            `parameters(p, x, y, of_sag, of_x, of_y)` gives a tuple of one number for each of p:
            of_sag·∂s/∂p + of_x·∂²s/∂x∂p + of_y·∂²s/∂y∂p.
            p is a tuple of the numbers that the surface's `packed` gives, in their order, and all
            numbers are of the real type: write `half = real(0.5)` before the functions, since a
            literal 0.5 would promote single precision to double.  The kernels on disk follow the
            file that `functions` stands in, and no other that it imports.
        numbers: how many numbers `packed` gives.

    Raises:
        InputError: no number.
    """
    if numbers < 1:
        raise InputError(f"given_by_scalars: `numbers` must be 1 or more, not {numbers}")

    def sag_block(real: types.Type) -> Callable[..., None]:
        sag, _, _ = functions(real)

        def kernel(before, after, cotangents, record, work, codes):  # noqa: ANN001, ANN202
            w = carray(work, WORK_SIZE)
            p = to_fixed_tuple(carray(shifted(record, SHAPE), numbers), numbers)
            for i in range(BLOCK):
                s, sx, sy, margin = sag(p, w[POINT_X + i], w[POINT_Y + i])
                w[SAG + i], w[SLOPE_X + i], w[SLOPE_Y + i] = s, sx, sy
                w[MARGIN + i] = margin

        return kernel

    def hessian_block(real: types.Type) -> Callable[..., None]:
        sag, sag_hessian, _ = functions(real)

        def kernel(before, after, cotangents, record, work, codes):  # noqa: ANN001, ANN202
            w = carray(work, WORK_SIZE)
            p = to_fixed_tuple(carray(shifted(record, SHAPE), numbers), numbers)
            for i in range(BLOCK):
                x, y = w[POINT_X + i], w[POINT_Y + i]
                _, sx, sy, _ = sag(p, x, y)
                sxx, sxy, syy = sag_hessian(p, x, y)
                w[SLOPE_X + i], w[SLOPE_Y + i] = sx, sy
                w[SAG_XX + i], w[SAG_XY + i], w[SAG_YY + i] = sxx, sxy, syy

        return kernel

    def parameters_block(real: types.Type) -> Callable[..., None]:
        _, _, parameters = functions(real)

        def kernel(before, after, cotangents, record, work, codes):  # noqa: ANN001, ANN202
            w, cot = carray(work, WORK_SIZE), carray(cotangents, UNBOUNDED)
            p = to_fixed_tuple(carray(shifted(record, SHAPE), numbers), numbers)
            for i in range(BLOCK):
                of_p = parameters(
                    p,
                    w[POINT_X + i],
                    w[POINT_Y + i],
                    w[OF_SAG + i],
                    w[OF_SLOPE_X + i],
                    w[OF_SLOPE_Y + i],
                )
                for j in range(numbers):
                    cot[OF_SHAPE + BLOCK * j + i] = of_p[j]

        return kernel

    return given_by_sag(
        _named(sag_block, functions, "sag"),
        _named(hessian_block, functions, "hessian"),
        _named(parameters_block, functions, "parameters"),
        numbers=numbers,
    )


def _named(block: Factory, functions: Functions, part: str) -> Factory:
    """Name a factory after the functions that it inlines: the kernel on disk is theirs."""
    named = wraps(functions)(block)
    named.__name__ = f"{functions.__name__}_{part}"
    return named
