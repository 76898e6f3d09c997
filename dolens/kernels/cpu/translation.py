"""Functions that all backends share are compiled for one ray, in one precision."""

import math
from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np
from llvmlite import ir
from numba import njit, types
from numba.core.errors import TypingError
from numba.extending import intrinsic

from dolens.kernels import operations
from dolens.kernels.cpu.compiler import OPTIONS
from dolens.kernels.cpu.layout import BLOCK
from dolens.kernels.shapes import translated
from dolens.kernels.table import TINY

_INTEGER = ir.IntType(64)
_AS_REAL = {types.float32: np.float32, types.float64: np.float64}


@cache
def operations_of(real: types.Type) -> dict[Any, Any]:
    """Return what takes the place of `dolens.kernels.operations`: single instructions, mostly."""

    def require(name: str, *kinds: types.Type) -> None:
        if any(kind != real for kind in kinds):
            raise TypingError(f"{name} takes numbers of {real}, not {kinds}: write 2.0 for 2")

    @intrinsic
    def fma(context, a, b, c):  # noqa: ANN001, ANN202
        require("fma", a, b, c)
        return real(a, b, c), lambda _, builder, __, given: builder.fadd(
            builder.fmul(given[0], given[1]), given[2]
        )

    @intrinsic
    def divide(context, a, b):  # noqa: ANN001, ANN202
        require("divide", a, b)
        return real(a, b), lambda _, builder, __, given: builder.fdiv(*given)

    @intrinsic
    def sqrt(context, a):  # noqa: ANN001, ANN202
        require("sqrt", a)

        def generate(context, builder, signature, given):  # noqa: ANN001, ANN202
            kind = given[0].type
            root = builder.module.declare_intrinsic("llvm.sqrt", [kind])
            return builder.call(root, given)

        return real(a), generate

    @intrinsic
    def where(context, condition, a, b):  # noqa: ANN001, ANN202
        require("where", a, b)
        return real(condition, a, b), lambda _, builder, __, given: builder.select(*given)

    @intrinsic
    def zero(context, like):  # noqa: ANN001, ANN202
        return real(like), lambda context, *_: context.get_constant(real, 0.0)

    @intrinsic
    def number(context, integer, like):  # noqa: ANN001, ANN202
        return real(types.int64, like), lambda context, builder, _, given: builder.sitofp(
            given[0], context.get_value_type(real)
        )

    @intrinsic
    def length(context, series):  # noqa: ANN001, ANN202
        return types.int64(series), lambda _, builder, __, given: builder.extract_value(given[0], 1)

    @intrinsic
    def term(context, series, i):  # noqa: ANN001, ANN202
        return real(series, types.int64), lambda _, builder, __, given: builder.load(
            builder.gep(builder.extract_value(given[0], 0), [given[1]])
        )

    @intrinsic
    def entry(context, table, i):  # noqa: ANN001, ANN202
        return types.int64(table, types.int64), lambda _, builder, __, given: builder.load(
            builder.gep(builder.extract_value(given[0], 0), [given[1]])
        )

    @intrinsic
    def put(context, cotangents, place, value):  # noqa: ANN001, ANN202
        require("put", value)

        def generate(context, builder, signature, given):  # noqa: ANN001, ANN202
            place = builder.mul(given[1], _INTEGER(BLOCK))
            builder.store(given[2], builder.gep(given[0], [place]))
            return context.get_dummy_value()

        return types.void(cotangents, types.int64, value), generate

    tiny = real(TINY)

    @njit(**OPTIONS)
    def safe_sqrt(squared):  # noqa: ANN001, ANN202
        """Return the square root; an argument that is not positive counts as 1e-18."""
        return math.sqrt(squared if squared > tiny else tiny)

    @njit(**OPTIONS)
    def clamp(value, limit):  # noqa: ANN001, ANN202
        """Return the value, held within ± limit; NaN stays."""
        low = -limit
        value = low if value < low else value
        return limit if value > limit else value

    own = (
        *(fma, divide, sqrt, where, zero, number, length, term, entry, put),
        *(safe_sqrt, clamp),
    )
    return {getattr(operations, one.__name__): one for one in own}


@cache
def _translations(real: types.Type, inline: str) -> dict[Any, Any]:
    return dict(operations_of(real))


def scalar(function: Callable[..., Any], real: types.Type, inline: str = "never") -> Any:
    """Return a function of one ray's numbers for a precision, with those that it calls; see
    `translated`.

    Args:
        function: written in `dolens.kernels.operations`.
        real: the precision.
        inline: `never`: compiled by itself; `always`: Numba inlines it where it is called.
    """
    literal = _AS_REAL[real]
    return translated(
        function,
        _translations(real, inline),
        njit(inline=inline, **OPTIONS),
        literal,
        lambda value: literal(value) if isinstance(value, float) else value,
    )
