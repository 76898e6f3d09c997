"""The paraboloid's GPU kernels."""

import triton
import triton.language as tl

from dolens.kernels.cuda.arithmetic import add_sum
from dolens.kernels.cuda.functions import SagFunctions
from dolens.kernels.cuda.layout import SHAPE


@triton.jit
def _numbers(record):
    return tl.load(record + SHAPE), tl.load(record + SHAPE + 1), tl.load(record + SHAPE + 2)


@triton.jit
def sag(record, codes, extras, x, y):
    cx, cy, twist = _numbers(record)
    value = 0.5 * (cx * x * x + cy * y * y) + twist * x * y
    return value, cx * x + twist * y, cy * y + twist * x, 1.0 + tl.zeros_like(x)


@triton.jit
def sag_hessian(record, codes, extras, x, y):
    cx, cy, twist = _numbers(record)
    zero = tl.zeros_like(x)
    return cx * x + twist * y, cy * y + twist * x, cx + zero, twist + zero, cy + zero


@triton.jit
def add_sums(record, codes, extras, sums, x, y, of_sag, of_x, of_y, alive):
    add_sum(sums + SHAPE, 0.5 * of_sag * x * x + of_x * x, alive)
    add_sum(sums + SHAPE + 1, 0.5 * of_sag * y * y + of_y * y, alive)
    add_sum(sums + SHAPE + 2, of_sag * x * y + of_x * y + of_y * x, alive)


KERNELS = SagFunctions(sag, sag_hessian, add_sums)
