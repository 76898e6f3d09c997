"""Least squares: sums over rays for the normal equations, and damped steps within bounds.

The driver of least squares sums JᵀJ, Jᵀr and groups of rays without storing the Jacobian.

Every chunk of rays has its own sums in double precision:
    0 the number of rays, 1 Σ w·r²; then Jᵀr (P); then JᵀJ, rows of P, of which the lower triangle
    is filled; then for each group: the number of rays, Σ w, Σ w·r (outputs), Σ w·J (outputs, P).

The columns of a block are followed by further rows: P for w·J, then w, then r.

Damped steps of many lenses within their boxes, each the minimum of a convex quadratic.

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

from dolens.kernels.cpu import compiler, jobs
from dolens.kernels.cpu.compiler import OPTIONS, int64_at, real64_at, shifted
from dolens.kernels.cpu.forward import real_at
from dolens.kernels.cpu.jacobian import ENOUGH, columns
from dolens.kernels.cpu.layout import BLOCK, ENDED, INDEX, STATE, UNBOUNDED
from dolens.kernels.cpu.threads import scratch, spread, thread_count

# Places in a chunk's sums, and in those of a group, which begin with its number of rays as well.
NUMBER, SQUARES, RIGHT = range(3)
GROUP_WEIGHT, GROUP_RESIDUAL = range(1, 3)


def normal_equations_driver(real: types.Type) -> Callable[..., None]:
    """Compile the driver that adds chunks `first` to `last` to their sums."""
    at = real_at(real)
    begin, _, differentiate, wait, resume = columns(real)
    zero, one = real(0.0), real(1.0)

    @njit(**OPTIONS)
    def weigh(job, lanes, count, weights):  # noqa: ANN001, ANN202
        """Set the rays' weights; zero for those that do not pass, and for lanes beyond `count`."""
        ended = carray(shifted(at(job[jobs.STACK]), STATE * job[jobs.STEPS] + ENDED), BLOCK)
        given = carray(at(job[jobs.WEIGHT]), UNBOUNDED)
        out = carray(weights, BLOCK)
        for i in range(BLOCK):
            out[i] = zero
        for i in range(count):
            weight = given[lanes[i] * job[jobs.WEIGHT_ROW]] if job[jobs.WEIGHT] != 0 else one
            out[i] = weight if ended[i] == zero else zero

    @njit(**OPTIONS)
    def dot(a_, b_):  # noqa: ANN001, ANN202
        a, b = carray(a_, BLOCK), carray(b_, BLOCK)
        total = zero
        for i in range(BLOCK):
            total += a[i] * b[i]
        return types.float64(total)

    @njit(**OPTIONS)
    def four_dots(a_, b_):  # noqa: ANN001, ANN202
        """Return the products of a row with four rows that follow each other."""
        a, b = carray(a_, BLOCK), carray(b_, 4 * BLOCK)
        s0 = s1 = s2 = s3 = zero
        for i in range(BLOCK):
            s0 += a[i] * b[i]
            s1 += a[i] * b[BLOCK + i]
            s2 += a[i] * b[2 * BLOCK + i]
            s3 += a[i] * b[3 * BLOCK + i]
        return types.float64(s0), types.float64(s1), types.float64(s2), types.float64(s3)

    @njit(**OPTIONS)
    def add_group(job, g, first, last, output, weights, residual, weighted, sums):  # noqa: ANN001, ANN202
        """Add lanes `first` to `last`, which are of group g."""
        p = job[jobs.VARIABLES]
        row = carray(
            shifted(sums, RIGHT + p + p * p + g * (GROUP_RESIDUAL + job[jobs.OUTPUTS] * (1 + p))),
            UNBOUNDED,
        )
        w = carray(weights, BLOCK)
        if output == 0:
            ended = carray(shifted(at(job[jobs.STACK]), STATE * job[jobs.STEPS] + ENDED), BLOCK)
            number, total = 0, zero
            for i in range(first, last):
                number += 1 if ended[i] == zero else 0
                total += w[INDEX + i]
            row[NUMBER] += types.float64(number)
            row[GROUP_WEIGHT] += types.float64(total)
        r, total = carray(residual, BLOCK), zero
        for i in range(first, last):
            total += w[INDEX + i] * r[i]
        row[GROUP_RESIDUAL + output] += types.float64(total)
        for c in range(p):
            lane, total = carray(shifted(weighted, BLOCK * c), BLOCK), zero
            for i in range(first, last):
                total += lane[i]
            row[GROUP_RESIDUAL + job[jobs.OUTPUTS] + p * output + c] += types.float64(total)

    @njit(**OPTIONS)
    def add_groups(job, lanes, count, output, weights, residual, weighted, sums):  # noqa: ANN001, ANN202
        """Add neighbours of one group together."""
        group = carray(int64_at(job[jobs.GROUP]), UNBOUNDED)
        first = 0
        while first < count:
            g, last = group[lanes[first]], first + 1
            while last < count and group[lanes[last]] == g:
                last += 1
            add_group(job, g, first, last, output, weights, residual, weighted, sums)
            first = last

    @njit(**OPTIONS)
    def accumulate(job, lanes, count, sums):  # noqa: ANN001, ANN202
        """Add a traced and differentiated block to the chunk's sums."""
        outputs, p = job[jobs.OUTPUTS], job[jobs.VARIABLES]
        weighted = shifted(at(job[jobs.DRIVER_ROWS]), BLOCK * outputs * p)
        weights = shifted(weighted, BLOCK * p)
        residual = shifted(weights, BLOCK)
        seeds = carray(int64_at(job[jobs.OUTPUT_ROWS]), UNBOUNDED)
        total = carray(sums, UNBOUNDED)
        last = shifted(at(job[jobs.STACK]), STATE * job[jobs.STEPS])
        ended = carray(shifted(last, ENDED), BLOCK)
        weigh(job, lanes, count, weights)
        w, r = carray(weights, BLOCK), carray(residual, BLOCK)
        number = 0
        for i in range(count):
            number += 1 if ended[i] == zero else 0
        total[NUMBER] += types.float64(number)
        for output in range(outputs):
            value = carray(shifted(last, BLOCK * seeds[output]), BLOCK)
            target = carray(
                shifted(at(job[jobs.TARGET]), output * job[jobs.TARGET_COLUMN]), UNBOUNDED
            )
            for i in range(BLOCK):
                wanted = target[lanes[i] * job[jobs.TARGET_ROW]]
                r[i] = value[i] - wanted if ended[i] == zero else zero
            square = zero
            for i in range(BLOCK):
                square += w[INDEX + i] * r[i] * r[i]
            total[SQUARES] += types.float64(square)
            rows = shifted(at(job[jobs.DRIVER_ROWS]), BLOCK * output * p)
            for c in range(p):
                row = carray(shifted(rows, BLOCK * c), BLOCK)
                out = carray(shifted(weighted, BLOCK * c), BLOCK)
                for i in range(BLOCK):
                    out[i] = w[INDEX + i] * row[i]
                total[RIGHT + c] += dot(shifted(weighted, BLOCK * c), residual)
            for c in range(p):
                a = shifted(weighted, BLOCK * c)
                place = RIGHT + p + c * p
                d = 0
                while d + 3 <= c:
                    s0, s1, s2, s3 = four_dots(a, shifted(rows, BLOCK * d))
                    total[place + d] += s0
                    total[place + d + 1] += s1
                    total[place + d + 2] += s2
                    total[place + d + 3] += s3
                    d += 4
                while d <= c:
                    total[place + d] += dot(a, shifted(rows, BLOCK * d))
                    d += 1
            if job[jobs.GROUPS] != 0:
                add_groups(job, lanes, count, output, weights, residual, weighted, sums)

    def kernel(job_, first, last):  # noqa: ANN001, ANN202
        job = carray(job_, jobs.LENGTH)
        lanes = carray(int64_at(job[jobs.LANES]), BLOCK)
        for chunk in range(first, last):
            sums = shifted(real64_at(job[jobs.SUMS]), chunk * job[jobs.SUM_LENGTH])
            start, end = chunk * job[jobs.CHUNK], min((chunk + 1) * job[jobs.CHUNK], job[jobs.RAYS])
            waiting = 0
            while start < end or waiting > 0:
                if start < end:
                    count = min(BLOCK, end - start)
                    if begin(job, start, count, lanes) >= ENOUGH:
                        differentiate(job, lanes, at(job[jobs.DRIVER_ROWS]), BLOCK)
                        accumulate(job, lanes, count, sums)
                    else:
                        waiting = wait(job, lanes, count, waiting)
                    start += BLOCK
                if waiting >= BLOCK or (waiting > 0 and start >= end):
                    count = resume(job, lanes, waiting)
                    differentiate(job, lanes, at(job[jobs.DRIVER_ROWS]), BLOCK)
                    accumulate(job, lanes, count, sums)
                    waiting -= count

    return kernel


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
