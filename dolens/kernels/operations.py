"""A shape's functions are written in these operations, once for PyTorch, Numba and Triton.

As they stand here they take tensors.  `dolens.kernels.cpu.translation` and `cuda.translation` have
their counterparts for one ray and for a block of rays; from `by_radius` on, they are written in the
others, and translated as a shape's functions are.
"""

import math
from typing import Any

import torch

from dolens.kernels.table import TINY

Number = Any  # a tensor; in kernels a ray's number
Series = Any  # a tuple of numbers; in kernels, places of numbers


def fma(a: Number, b: Number, c: Number) -> Number:
    """Return a·b + c: of tensors in one pass over memory, and at no cost where a or b is 0.0."""
    if all(isinstance(factor, torch.Tensor) for factor in (a, b, c)):
        return torch.addcmul(c, a, b)
    if _is_zero(a) or _is_zero(b):
        return c
    return a * b if _is_zero(c) else a * b + c


def _is_zero(a: Number) -> bool:
    return not isinstance(a, torch.Tensor) and a == 0.0


def divide(a: Number, b: Number) -> Number:
    """Return a/b, rounded to nearest on GPUs too."""
    return a / b


def sqrt(a: Number) -> Number:
    """Return the square root, rounded to nearest on GPUs too."""
    return torch.sqrt(a) if isinstance(a, torch.Tensor) else math.sqrt(a)


def safe_sqrt(squared: Number) -> Number:
    """Return the square root, with a finite derivative everywhere; exact where its argument is
    positive.
    """
    return torch.sqrt(squared.clamp(min=TINY))


def clamp(a: Number, limit: float) -> Number:
    """Return a number, held within ± a positive limit; NaN stays."""
    return a.clamp(-limit, limit)


def where(condition: Any, a: Number, b: Number) -> Number:
    """Return a where the condition holds, and else b."""
    if isinstance(condition, bool):
        return a if condition else b
    return torch.where(condition, a, b)


def zero(like: Number) -> Number:
    """Return zero, to begin a sum with, of the kind of another number."""
    return 0.0


def number(integer: int, like: Number) -> Number:
    """Return an integer as a number of another's precision; a literal has it by itself."""
    return float(integer)


def length(series: Series) -> int:
    """Return how many numbers a series has."""
    return len(series)


def term(series: Series, i: int) -> Number:
    """Return a number of a series."""
    return series[i]


def entry(table: Any, i: int) -> int:
    """Return an integer of a table, which kernels on the CPU are compiled for."""
    return table[i]


def put(cotangents: Any, place: int, value: Number) -> None:
    """Set the cotangent of the number at a place, in the order of the surface's `packed`."""
    cotangents[place] = value


def by_radius(
    x: Number, y: Number, slope: Number, second: Number
) -> tuple[Number, Number, Number, Number, Number]:
    """Return slopes and second derivatives of f(x² + y²), from f' and f''."""
    bend = 4.0 * second
    return (
        2.0 * x * slope,
        2.0 * y * slope,
        2.0 * slope + x * x * bend,
        x * y * bend,
        2.0 * slope + y * y * bend,
    )


def horner(series: Series, q: Number) -> tuple[Number, Number]:
    """Return the polynomial H = a_0 + a_1·q + ..., and H'."""
    h, d = zero(q), zero(q)
    for i in range(length(series)):
        d = fma(d, q, h)
        h = fma(h, q, term(series, length(series) - 1 - i))
    return h, d


def horner_second(series: Series, q: Number) -> tuple[Number, Number, Number]:
    """Return the polynomial H, H' and H''/2."""
    h, d, e = zero(q), zero(q), zero(q)
    for i in range(length(series)):
        e = fma(e, q, d)
        d = fma(d, q, h)
        h = fma(h, q, term(series, length(series) - 1 - i))
    return h, d, e


def put_powers(
    cotangents: Any, place: int, count: int, lower: Number, q: Number,
    of_value: Number, of_slope: Number, power: int, step: int,
) -> None:  # fmt: skip
    """Set the cotangents of a series's numbers, from `place` on.

    That of number j is of_value·u_(j+1) + (power + step·j)·of_slope·u_j with u_j = lower·q^j.
    """
    for j in range(count):
        upper = lower * q
        weight = number(power + step * j, q) * of_slope
        put(cotangents, place + j, of_value * upper + weight * lower)
        lower = upper


def next_term(
    alpha: Number, beta: Number, gamma: Number, q: Number,
    value: Number, slope: Number, value_below: Number, slope_below: Number,
) -> tuple[Number, Number, Number, Number]:  # fmt: skip
    """Return P_k = (α·q + β)·P_(k-1) - γ·P_(k-2) and its derivative in q, and those of P_(k-1).

    Arguments after q: P_(k-1) and its derivative, and those of P_(k-2).
    """
    factor = fma(alpha, q, beta)
    above = fma(factor, value, -gamma * value_below)
    return above, fma(factor, slope, alpha * value - gamma * slope_below), value, slope


def next_second(
    alpha: Number, beta: Number, gamma: Number, q: Number,
    slope: Number, second: Number, second_below: Number,
) -> tuple[Number, Number]:  # fmt: skip
    """Return the second derivatives of P_k and of P_(k-1), from the derivative of P_(k-1) and the
    second ones of P_(k-1) and P_(k-2); see `next_term`.
    """
    added = 2.0 * alpha * slope - gamma * second_below
    return fma(fma(alpha, q, beta), second, added), second
