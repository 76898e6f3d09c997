"""Damped steps of many lenses within their boxes, each the minimum of a convex quadratic.

A step δ minimises 2gᵀδ + δᵀ(H + diag(d))δ with lower ≤ δ ≤ upper.  Which variables end on a bound
is found by block principal pivoting (Júdice and Pires, Comput. Oper. Res. 21, 587, 1994): guess the
set, solve for the rest by Cholesky's factors, and exchange every variable that contradicts the
guess; after some turns only the last one of them (Murty's rule).
"""

import math
from collections.abc import Callable

import numpy as np
import torch
from numba import carray, njit, types
from torch import Tensor

from dolens.kernels.cpu import compiler
from dolens.kernels.cpu.compiler import OPTIONS, int64_at, real64_at, shifted
from dolens.kernels.cpu.layout import UNBOUNDED
from dolens.kernels.cpu.threads import scratch, spread, thread_count

# Turns that exchange whole blocks of variables with their bounds, and all turns.
_BLOCKS, _TURNS = 3, 400
# A slope of this part of the greatest gradient is rounding.
_ROUNDING = 1e-12
# Fewer lenses than these are done sooner than another thread is woken.
_SMALL = 16

# Places in the job.
_HESSIAN, _GRADIENT, _DAMPING, _LOWER, _UPPER, _STEP, _COUNT, _WORK = range(8)


@njit(**OPTIONS)
def _factorised(u, n):  # noqa: ANN001, ANN202
    """Replace the upper triangle of a matrix, at the pointer `u`, by U with UᵀU equal to it; return
    whether it is positive definite.
    """
    for i in range(n):
        row = carray(shifted(u, i * n), UNBOUNDED)
        k = 0
        while k + 4 <= i:
            # Four rows at a time, so that row i is loaded and stored a quarter as often.
            r0 = carray(shifted(u, k * n), UNBOUNDED)
            r1 = carray(shifted(u, (k + 1) * n), UNBOUNDED)
            r2 = carray(shifted(u, (k + 2) * n), UNBOUNDED)
            r3 = carray(shifted(u, (k + 3) * n), UNBOUNDED)
            f0, f1, f2, f3 = r0[i], r1[i], r2[i], r3[i]
            for j in range(i, n):
                row[j] -= f0 * r0[j] + f1 * r1[j] + f2 * r2[j] + f3 * r3[j]
            k += 4
        while k < i:
            r0 = carray(shifted(u, k * n), UNBOUNDED)
            f0 = r0[i]
            for j in range(i, n):
                row[j] -= f0 * r0[j]
            k += 1
        if not row[i] > 0.0 or row[i] == math.inf:
            return False
        inverse = 1.0 / math.sqrt(row[i])
        for j in range(i, n):
            row[j] *= inverse
    return True


@njit(**OPTIONS)
def _solved(u, n, x):  # noqa: ANN001, ANN202
    """Replace a right side x by the solution of UᵀU·x = x."""
    for i in range(n):
        row = carray(shifted(u, i * n), UNBOUNDED)
        x[i] /= row[i]
        for j in range(i + 1, n):
            x[j] -= row[j] * x[i]
    for i in range(n - 1, -1, -1):
        row = carray(shifted(u, i * n), UNBOUNDED)
        total = 0.0
        for j in range(i + 1, n):
            total += row[j] * x[j]
        x[i] = (x[i] - total) / row[i]


@njit(**OPTIONS)
def _with_held(h, g, d, low, high, side, step, free, u, x, n):  # noqa: ANN001, ANN202
    """Find the step that minimises with some variables held; side: -1, 1 held on a bound, 0 free.

    Free variables stay where they are where the matrix is not positive definite.
    """
    count = 0
    for i in range(n):
        if side[i] == 0:
            step[i] = 0.0
            free[count] = i
            count += 1
        else:
            step[i] = low[i] if side[i] < 0 else high[i]
    for a in range(count):
        i = free[a]
        own, row = carray(shifted(h, i * n), UNBOUNDED), carray(shifted(u, a * count), UNBOUNDED)
        total = g[i]
        if count < n:
            for j in range(n):
                total += own[j] * step[j]
        x[a] = -total
        for b in range(a, count):
            row[b] = own[free[b]]
        row[a] += d[i]
    if _factorised(u, count):
        _solved(u, count, x)
        for a in range(count):
            step[free[a]] = x[a]


@njit(**OPTIONS)
def _bounded_step(h, g, d, low, high, step, side, free, u, x, n):  # noqa: ANN001, ANN202
    """Find the step of one lens; `h` and `u` are pointers, the others arrays."""
    greatest = 0.0
    for i in range(n):
        greatest = max(greatest, math.fabs(g[i]))
        side[i] = 0
        if low[i] >= 0.0 and g[i] > 0.0:
            side[i] = -1
        elif high[i] <= 0.0 and g[i] < 0.0:
            side[i] = 1
    for turn in range(_TURNS):
        _with_held(h, g, d, low, high, side, step, free, u, x, n)
        settled = True
        for i in range(n - 1, -1, -1):
            if side[i] == 0:
                other = -1 if step[i] < low[i] else (1 if step[i] > high[i] else 0)
            else:
                own = carray(shifted(h, i * n), UNBOUNDED)
                slope = g[i] + d[i] * step[i]
                for j in range(n):
                    slope += own[j] * step[j]
                # On its lower bound a variable wants to go on down, on its upper one up.
                other = 0 if side[i] * slope > _ROUNDING * greatest else side[i]
            if other != side[i]:
                settled = False
                side[i] = other
                if turn >= _BLOCKS:
                    break
        if settled:
            break
    for i in range(n):
        step[i] = min(max(step[i], low[i]), high[i])


def steps_driver(real: types.Type) -> Callable[..., None]:
    """Compile the steps of lenses `first` to `last`; double precision alone."""

    def kernel(job_, first, last):  # noqa: ANN001, ANN202
        job = carray(job_, _WORK + 1)
        n, work = job[_COUNT], job[_WORK]
        u, x = real64_at(work), carray(real64_at(work + 8 * n * n), UNBOUNDED)
        side = carray(int64_at(work + 8 * n * (n + 1)), UNBOUNDED)
        free = carray(int64_at(work + 8 * n * (n + 2)), UNBOUNDED)
        for lens in range(first, last):
            h, at = real64_at(job[_HESSIAN] + 8 * lens * n * n), 8 * lens * n
            g = carray(real64_at(job[_GRADIENT] + at), UNBOUNDED)
            d = carray(real64_at(job[_DAMPING] + at), UNBOUNDED)
            low = carray(real64_at(job[_LOWER] + at), UNBOUNDED)
            high = carray(real64_at(job[_UPPER] + at), UNBOUNDED)
            step = carray(real64_at(job[_STEP] + at), UNBOUNDED)
            _bounded_step(h, g, d, low, high, step, side, free, u, x, n)

    return kernel


def bounded_steps(
    hessian: Tensor, gradient: Tensor, damping: Tensor, lower: Tensor, upper: Tensor
) -> Tensor:
    """Return damped steps within their boxes, (n, P); the rare problem that is not solved within
    the turns that are allowed has its step put back into the box.

    Args:
        hessian: H of n problems, (n, P, P), symmetric; all are float64 on the CPU.
        gradient: g, (n, P).
        damping: d, (n, P).
        lower: of the steps, (n, P), at most 0.
        upper: likewise, at least 0.
    """
    problems, size = gradient.shape
    step = torch.empty((problems, size), dtype=torch.float64)
    if not step.numel():
        return step
    given = [t.double().contiguous() for t in (hessian, gradient, damping, lower, upper)]
    threads = min(thread_count(problems, _SMALL), problems)
    # Memories are held until the last share is done.
    memories = [scratch(8 * size * (size + 3), worker) for worker in range(threads)]
    shared = [*(t.data_ptr() for t in given), step.data_ptr(), size]
    own = [np.array([*shared, memory.address], dtype=np.int64) for memory in memories]
    driver = compiler.compile_driver(steps_driver, "float64")
    spread(driver, [job.ctypes.data for job in own], problems)
    return step
