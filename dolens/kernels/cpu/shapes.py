"""A shape's functions are compiled for a precision, and inlined in the loop over a block's rays.

Numba inlines them, before LLVM sees them: the loops over a series, whose length is then a constant,
are unrolled (up to 120 numbers), and the loop over rays is vectorised.
"""

from collections.abc import Callable, Sequence
from functools import cache
from typing import Any, NamedTuple

from llvmlite import ir
from numba import carray, types
from numba.core import cgutils
from numba.extending import intrinsic

from dolens.kernels.cpu.compiler import (
    INTEGERS,
    Factory,
    Row,
    StepFunctions,
    pointer,
    shifted,
)
from dolens.kernels.cpu.explicit import given_by_sag
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
    SHAPE,
    SLOPE_X,
    SLOPE_Y,
    WORK_SIZE,
)
from dolens.kernels.cpu.translation import scalar
from dolens.kernels.shapes import TABLE, Shape, functions_within
from dolens.kernels.table import Code

_INTEGER = ir.IntType(64)


Size = int | tuple[int, ...] | None


def _unpacked(real: types.Type, sizes: Sequence[Size]) -> Any:
    """Return the function of a pointer that reads a shape's numbers: p of `Shape`.

    A series is a place on the stack and its length: LLVM keeps it in registers.  A table is a
    constant.

    Args:
        real: the precision.
        sizes: of each part: None of a single number, the length of a series, or a table.
    """
    series = types.Tuple((pointer(real), types.int64))
    table = types.Tuple((INTEGERS, types.int64))
    kinds = {type(None): real, int: series, tuple: table}
    parts = types.Tuple([kinds[type(size)] for size in sizes])

    def generate(context, builder, signature, given):  # noqa: ANN001, ANN202
        place, values = 0, []

        def following():  # noqa: ANN202
            nonlocal place
            place += 1
            return builder.load(builder.gep(given[0], [_INTEGER(place - 1)]))

        for size in sizes:
            if size is None:
                values.append(following())
                continue
            if isinstance(size, tuple):
                held = ir.Constant(ir.ArrayType(_INTEGER, len(size)), size)
                slot = cgutils.global_constant(builder, "table", held)
                first = builder.gep(slot, [_INTEGER(0), _INTEGER(0)])
                values.append(context.make_tuple(builder, table, [first, _INTEGER(len(size))]))
                continue
            kind = ir.ArrayType(context.get_value_type(real), max(size, 1))
            slot = builder.gep(cgutils.alloca_once(builder, kind), [_INTEGER(0), _INTEGER(0)])
            for k in range(size):
                builder.store(following(), builder.gep(slot, [_INTEGER(k)]))
            values.append(context.make_tuple(builder, series, [slot, _INTEGER(size)]))
        return context.make_tuple(builder, parts, values)

    @intrinsic
    def unpacked(context, base):  # noqa: ANN001, ANN202
        return parts(base), generate

    return unpacked


def block_factory(
    function: Callable[..., Any],
    block: Callable[[types.Type, Any, Any], Callable[..., None]],
    name: str,
    sizes: tuple[Size, ...],
) -> Factory:
    """Return the factory of a block function that inlines a shape's function.

    Args:
        function: the shape's.
        block: makes the block function from the real type, the compiled function and what reads p.
        name: of the kernel.
        sizes: of the parts of p.
    """

    def factory(real: types.Type) -> Callable[..., None]:
        return block(real, scalar(function, real, "always"), _unpacked(real, sizes))

    factory.__name__, factory.__qualname__ = name, f"{name}{sizes}"
    factory.within = functions_within(function)  # type: ignore[attr-defined]
    factory.longest = max((n for n in sizes if isinstance(n, int)), default=0)  # type: ignore[attr-defined]
    return factory


def _sag_block(real: types.Type, sag: Any, unpacked: Any) -> Callable[..., None]:
    def kernel(before, after, cotangents, record, work, codes):  # noqa: ANN001, ANN202
        w, p = carray(work, WORK_SIZE), unpacked(shifted(record, SHAPE))
        for i in range(BLOCK):
            s, sx, sy, margin = sag(p, w[POINT_X + i], w[POINT_Y + i])
            w[SAG + i], w[SLOPE_X + i], w[SLOPE_Y + i], w[MARGIN + i] = s, sx, sy, margin

    return kernel


def _hessian_block(real: types.Type, sag_hessian: Any, unpacked: Any) -> Callable[..., None]:
    def kernel(before, after, cotangents, record, work, codes):  # noqa: ANN001, ANN202
        w, p = carray(work, WORK_SIZE), unpacked(shifted(record, SHAPE))
        for i in range(BLOCK):
            sx, sy, sxx, sxy, syy = sag_hessian(p, w[POINT_X + i], w[POINT_Y + i])
            w[SLOPE_X + i], w[SLOPE_Y + i] = sx, sy
            w[SAG_XX + i], w[SAG_XY + i], w[SAG_YY + i] = sxx, sxy, syy

    return kernel


def _parameters_block(real: types.Type, parameters: Any, unpacked: Any) -> Callable[..., None]:
    def kernel(before, after, cotangents, record, work, codes):  # noqa: ANN001, ANN202
        w, p = carray(work, WORK_SIZE), unpacked(shifted(record, SHAPE))
        for i in range(BLOCK):
            parameters(
                shifted(cotangents, OF_SHAPE + i), p, w[POINT_X + i], w[POINT_Y + i],
                w[OF_SAG + i], w[OF_SLOPE_X + i], w[OF_SLOPE_Y + i],
            )  # fmt: skip

    return kernel


@cache
def _step_functions(shape: Shape, sizes: tuple[Size, ...]) -> StepFunctions:
    made = (
        block_factory(shape.sag, _sag_block, f"{shape.name}_sag", sizes),
        block_factory(shape.sag_hessian, _hessian_block, f"{shape.name}_hessian", sizes),
        block_factory(shape.parameters, _parameters_block, f"{shape.name}_parameters", sizes),
    )
    numbers = sum(1 if size is None else size for size in sizes if not isinstance(size, tuple))
    return given_by_sag(*made, starts_on_conic=shape.starts_on_conic, numbers=numbers)


def sizes_of(
    layout: Sequence[int | None], row: Row, extras: Row, table: int = Code.EXTRAS
) -> tuple[Size, ...]:
    """Return the sizes of the parts of a layout; see `_unpacked`.

    Args:
        layout: of a shape or a law.
        row: the step's codes.
        extras: the lens's.
        table: the place in the row of the offset of the table.
    """

    def size(place: int | None) -> Size:
        if place != TABLE:
            return None if place is None else int(row[place])
        first = int(row[table])
        return tuple(map(int, extras[first + 1 : first + 1 + int(extras[first])]))

    return tuple(map(size, layout))


class ShapeKernels(NamedTuple):
    """The kernels of a shape differ with the lengths of its series, and with its table."""

    shape: Shape
    stencil: bool = False

    def of(self, row: Row, extras: Row) -> StepFunctions:
        """Return the functions of a step with this row of codes, and the lens's extras."""
        return _step_functions(self.shape, sizes_of(self.shape.layout, row, extras))


kernels = ShapeKernels
