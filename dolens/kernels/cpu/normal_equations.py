"""Driver of least squares: JᵀJ, Jᵀr and sums by groups of rays, without storing the Jacobian.

Every chunk of rays has its own sums in double precision:
    0 the number of rays, 1 Σ w·r²; then Jᵀr (P); then JᵀJ, rows of P, of which the lower triangle
    is filled; then for each group: the number of rays, Σ w, Σ w·r (outputs), Σ w·J (outputs, P).

The columns of a block are followed by further rows: P for w·J, then w, then r.
"""

from collections.abc import Callable

from numba import carray, njit, types

from dolens.kernels.cpu.compiler import OPTIONS, int64_at, real64_at, shifted
from dolens.kernels.cpu.forward import real_at
from dolens.kernels.cpu.jacobian import columns


def normal_equations_driver(real: types.Type) -> Callable[..., None]:
    """Add chunks `first` to `last` to their sums."""
    at = real_at(real)
    begin, _, differentiate, wait, resume = columns(real)
    zero, one = real(0.0), real(1.0)

    @njit(**OPTIONS)
    def weigh(job, lanes, count, weights):  # noqa: ANN001, ANN202
        """The rays' weights; zero of those that do not pass, and of lanes beyond `count`."""
        ended = carray(shifted(at(job[15]), 1280 * job[8] + 896), 128)
        given = carray(at(job[58]), 1 << 40)
        out = carray(weights, 128)
        for i in range(128):
            out[i] = zero
        for i in range(count):
            weight = given[lanes[i] * job[59]] if job[58] != 0 else one
            out[i] = weight if ended[i] == zero else zero

    @njit(**OPTIONS)
    def dot(a_, b_):  # noqa: ANN001, ANN202
        a, b = carray(a_, 128), carray(b_, 128)
        total = zero
        for i in range(128):
            total += a[i] * b[i]
        return types.float64(total)

    @njit(**OPTIONS)
    def four_dots(a_, b_):  # noqa: ANN001, ANN202
        """Products of a row with four rows that follow each other."""
        a, b = carray(a_, 128), carray(b_, 512)
        s0 = s1 = s2 = s3 = zero
        for i in range(128):
            s0 += a[i] * b[i]
            s1 += a[i] * b[128 + i]
            s2 += a[i] * b[256 + i]
            s3 += a[i] * b[384 + i]
        return types.float64(s0), types.float64(s1), types.float64(s2), types.float64(s3)

    @njit(**OPTIONS)
    def add_group(job, g, first, last, output, weights, residual, weighted, sums):  # noqa: ANN001, ANN202
        """Add lanes `first` to `last`, which are of group g."""
        p = job[42]
        row = carray(shifted(sums, 2 + p + p * p + g * (2 + job[40] * (1 + p))), 1 << 40)
        w = carray(weights, 128)
        if output == 0:
            ended = carray(shifted(at(job[15]), 1280 * job[8] + 896), 128)
            number, total = 0, zero
            for i in range(first, last):
                number += 1 if ended[i] == zero else 0
                total += w[i]
            row[0] += types.float64(number)
            row[1] += types.float64(total)
        r, total = carray(residual, 128), zero
        for i in range(first, last):
            total += w[i] * r[i]
        row[2 + output] += types.float64(total)
        for c in range(p):
            lane, total = carray(shifted(weighted, 128 * c), 128), zero
            for i in range(first, last):
                total += lane[i]
            row[2 + job[40] + p * output + c] += types.float64(total)

    @njit(**OPTIONS)
    def add_groups(job, lanes, count, output, weights, residual, weighted, sums):  # noqa: ANN001, ANN202
        """Neighbours of one group are added together."""
        group = carray(int64_at(job[60]), 1 << 40)
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
        outputs, p = job[40], job[42]
        weighted = shifted(at(job[49]), 128 * outputs * p)
        weights = shifted(weighted, 128 * p)
        residual = shifted(weights, 128)
        seeds = carray(int64_at(job[41]), 1 << 40)
        total = carray(sums, 1 << 40)
        last = shifted(at(job[15]), 1280 * job[8])
        ended = carray(shifted(last, 896), 128)
        weigh(job, lanes, count, weights)
        w, r = carray(weights, 128), carray(residual, 128)
        number = 0
        for i in range(count):
            number += 1 if ended[i] == zero else 0
        total[0] += types.float64(number)
        for output in range(outputs):
            value = carray(shifted(last, 128 * seeds[output]), 128)
            target = carray(shifted(at(job[55]), output * job[57]), 1 << 40)
            for i in range(128):
                r[i] = value[i] - target[lanes[i] * job[56]] if ended[i] == zero else zero
            square = zero
            for i in range(128):
                square += w[i] * r[i] * r[i]
            total[1] += types.float64(square)
            rows = shifted(at(job[49]), 128 * output * p)
            for c in range(p):
                row = carray(shifted(rows, 128 * c), 128)
                out = carray(shifted(weighted, 128 * c), 128)
                for i in range(128):
                    out[i] = w[i] * row[i]
                total[2 + c] += dot(shifted(weighted, 128 * c), residual)
            for c in range(p):
                a = shifted(weighted, 128 * c)
                place = 2 + p + c * p
                d = 0
                while d + 3 <= c:
                    s0, s1, s2, s3 = four_dots(a, shifted(rows, 128 * d))
                    total[place + d] += s0
                    total[place + d + 1] += s1
                    total[place + d + 2] += s2
                    total[place + d + 3] += s3
                    d += 4
                while d <= c:
                    total[place + d] += dot(a, shifted(rows, 128 * d))
                    d += 1
            if job[61] != 0:
                add_groups(job, lanes, count, output, weights, residual, weighted, sums)

    def kernel(job_, first, last):  # noqa: ANN001, ANN202
        job = carray(job_, 64)
        lanes = carray(int64_at(job[38]), 128)
        for chunk in range(first, last):
            sums = shifted(real64_at(job[34]), chunk * job[35])
            start, end = chunk * job[36], min((chunk + 1) * job[36], job[7])
            waiting = 0
            while start < end or waiting > 0:
                if start < end:
                    count = min(128, end - start)
                    if begin(job, start, count, lanes) >= 72:
                        differentiate(job, lanes, at(job[49]), 128)
                        accumulate(job, lanes, count, sums)
                    else:
                        waiting = wait(job, lanes, count, waiting)
                    start += 128
                if waiting >= 128 or (waiting > 0 and start >= end):
                    count = resume(job, lanes, waiting)
                    differentiate(job, lanes, at(job[49]), 128)
                    accumulate(job, lanes, count, sums)
                    waiting -= count

    return kernel
