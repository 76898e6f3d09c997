"""A shape's functions are compiled for a block of rays; a series is a pointer and its length."""

from collections.abc import Sequence
from functools import cache
from types import FunctionType
from typing import Any

import triton
import triton.language as tl
from triton.runtime.interpreter import InterpretedFunction

from dolens.kernels import shapes
from dolens.kernels.cuda.functions import SagFunctions
from dolens.kernels.cuda.layout import EXTRAS, SHAPE
from dolens.kernels.cuda.translation import compiled
from dolens.kernels.shapes import Shape, shape_named

# In the place of a layout's None, which Triton does not compare; and a table.
SINGLE, TABLE = tl.constexpr(-2), tl.constexpr(shapes.TABLE)


@triton.jit
def unpacked(place, codes, table, LAYOUT: tl.constexpr):
    """Return p of a `Shape` from the place of its numbers, and that of its table."""
    p = ()
    for k in tl.static_range(len(LAYOUT)):
        if LAYOUT[k] == TABLE:
            p = p + ((table + 1, tl.load(table)),)  # type: ignore[assignment]  # noqa: RUF005
        elif LAYOUT[k] == SINGLE:
            p = p + (tl.load(place),)  # type: ignore[assignment]  # noqa: RUF005
            place += 1
        else:
            count = tl.load(codes + LAYOUT[k])
            p = p + ((place, count),)  # type: ignore[assignment]  # noqa: RUF005
            place += count
    return p


# The names in capitals are bound for each shape.
def _sag(record, codes, extras, x, y):
    return FUNCTION(unpacked(record + SHAPE, codes, extras + tl.load(codes + EXTRAS), LAYOUT), x, y)  # noqa: F821


def _hessian(record, codes, extras, x, y):
    p = unpacked(record + SHAPE, codes, extras + tl.load(codes + EXTRAS), LAYOUT)  # noqa: F821
    sx, sy, sxx, sxy, syy = FUNCTION(p, x, y)  # noqa: F821
    # A derivative may be one for all rays.
    return (
        tl.broadcast_to(sx, x.shape),
        tl.broadcast_to(sy, x.shape),
        tl.broadcast_to(sxx, x.shape),
        tl.broadcast_to(sxy, x.shape),
        tl.broadcast_to(syy, x.shape),
    )


def _add_sums(record, codes, extras, sums, x, y, of_sag, of_x, of_y, alive):
    p = unpacked(record + SHAPE, codes, extras + tl.load(codes + EXTRAS), LAYOUT)  # noqa: F821
    FUNCTION((sums + SHAPE, alive), p, x, y, of_sag, of_x, of_y)  # noqa: F821


def bound(wrapper: Any, name: str, layout: Sequence[int | None], **functions: Any) -> Any:
    """Return a function whose names in capitals are plain functions, compiled, and a layout."""
    places: Any = tuple(SINGLE.value if place is None else int(place) for place in layout)
    if not isinstance(unpacked, InterpretedFunction):
        places = tl.constexpr(places)
    made = {capitals: compiled(function) for capitals, function in functions.items()}
    names = {**wrapper.__globals__, **made, "LAYOUT": places}
    copy = FunctionType(wrapper.__code__, names, wrapper.__name__)
    # Triton tells functions from each other by module and name.
    copy.__module__, copy.__qualname__ = wrapper.__module__, name
    return triton.jit(copy)


@cache
def kernels(shape: Shape) -> SagFunctions:
    """Return the three functions of a shape."""
    name, layout = shape.name, shape.layout
    return SagFunctions(
        bound(_sag, f"{name}_sag", layout, FUNCTION=shape.sag),
        bound(_hessian, f"{name}_hessian", layout, FUNCTION=shape.sag_hessian),
        bound(_add_sums, f"{name}_sums", layout, FUNCTION=shape.parameters),
        starts_on_conic=shape.starts_on_conic,
    )


# The asphere that other shapes add to.
even_asphere_sag, even_asphere_hessian, even_asphere_sums, *_ = kernels(shape_named("even_asphere"))
