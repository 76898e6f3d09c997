"""Functions that all backends share are compiled for a block of rays."""

from collections.abc import Callable
from typing import Any

import triton
import triton.language as tl

from dolens.kernels import operations
from dolens.kernels.cuda.arithmetic import add_sum, clamp, divide, safe_sqrt
from dolens.kernels.shapes import translated


@triton.jit
def fma(a, b, c):
    """Return a·b + c."""
    return a * b + c


@triton.jit
def sqrt(a):
    """Return the square root, rounded to nearest."""
    if a.dtype == tl.float64:
        return tl.sqrt(a)
    else:
        return tl.sqrt_rn(a)


@triton.jit
def where(condition, a, b):
    """Return a where the condition holds, and else b."""
    return tl.where(condition, a, b)


@triton.jit
def zero(like):
    """Return zero for each ray."""
    return tl.zeros_like(like)


@triton.jit
def number(integer, like):
    """Return an integer as a number of another's precision; with a literal it would be single."""
    return integer + tl.zeros_like(like)


@triton.jit
def length(series):
    """Return how many numbers a series has."""
    return series[1]


@triton.jit
def term(series, i):
    """Return a number of a series."""
    return tl.load(series[0] + i)


@triton.jit
def entry(table, i):
    """Return an integer of a table."""
    return tl.load(table[0] + i)


@triton.jit
def put(cotangents, place, value):
    """Add a number's cotangents to its sum; see `add_sum`."""
    add_sum(cotangents[0] + place, value, cotangents[1])


_OPERATIONS = {
    getattr(operations, name): made
    for name, made in {
        "fma": fma, "divide": divide, "sqrt": sqrt, "safe_sqrt": safe_sqrt, "clamp": clamp,
        "where": where, "zero": zero, "number": number, "length": length, "term": term,
        "entry": entry, "put": put,
    }.items()
}  # fmt: skip


def _constant(value: Any) -> Any:
    """Return a number as Triton takes it; any other thing is the type of an argument."""
    return tl.constexpr(value) if isinstance(value, int | float) else tl.tensor


def compiled(function: Callable[..., Any]) -> Any:
    """Return a shape's function, compiled by Triton where it is called."""
    return translated(function, _OPERATIONS, triton.jit, lambda literal: literal, _constant)
