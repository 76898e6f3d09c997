"""The driver of least squares sums JᵀJ, Jᵀr and groups of rays without storing the Jacobian.

Every chunk of rays has its own sums in double precision:
    0 the number of rays, 1 Σ w·r²; then Jᵀr (P); then JᵀJ, rows of P, of which the lower triangle
    is filled; then for each group: the number of rays, Σ w, Σ w·r (outputs), Σ w·J (outputs, P).

The columns of a block are followed by further rows: P for w·J, then w, then r.
"""

from collections.abc import Callable

from numba import carray, njit, types

from dolens.kernels.cpu import jobs
from dolens.kernels.cpu.compiler import OPTIONS, int64_at, real64_at, shifted
from dolens.kernels.cpu.forward import real_at
from dolens.kernels.cpu.jacobian import ENOUGH, columns
from dolens.kernels.cpu.layout import BLOCK, ENDED, INDEX, STATE, UNBOUNDED

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
