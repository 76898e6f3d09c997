"""The share of light that a surface passes is summed as a series in the cosine of incidence."""

import math
from functools import cache
from typing import Any, NamedTuple

from numba import carray, njit, types

from dolens.kernels.conic import conic_gradient
from dolens.kernels.cpu import jobs
from dolens.kernels.cpu.compiler import OPTIONS, int32_at, int64_at, real64_at, shifted
from dolens.kernels.cpu.forward import real_at
from dolens.kernels.cpu.layout import (
    ARGUMENT,
    BEFORE_SUM,
    BLOCK,
    CODE_ROW,
    CONIC,
    COSINE,
    ENDED,
    FACTORS,
    KIND,
    LOSS,
    NEAR,
    OFFSET,
    ROWS_OF_A_SERIES,
    SAG_AND_SLOPES,
    SENSE,
    SENSE_BEHIND,
    SHAPE,
    SHARES,
    SHORT_RECORD,
    SLOPE_X,
    SLOPE_Y,
    SLOPES,
    SPHERE,
    STATE,
    SUM,
    SUMMED,
    UNBOUNDED,
    WORK_SIZE,
    L,
    M,
    N,
    X,
    Y,
    Z,
)
from dolens.kernels.cpu.translation import scalar
from dolens.kernels.table import TINY, Cosine

# A call between functions takes as long as a loop over a block; what is rare is not inlined.
INLINED = {**OPTIONS, "forceinline": True}
NEXT = ROWS_OF_A_SERIES * BLOCK  # from the rows of a series to those of the next
LEAVING, BEYOND = int(Cosine.LEAVING), int(Cosine.BEYOND)


class CosineSeries(NamedTuple):
    """These compiled functions fill rows of a block with cosines, arguments and series.

    Attributes:
        codes_of: the codes of a step.
        numbers_at: the numbers of losses from a place on.
        coefficients_at: where those of a step's series begin.
        scale_of: of a step's series; see `LossTable`.
        set_by_wavelength: each ray's number of a table's row.
        set_ratios: each ray's ratio of indices.
        set_cosine: cosines and arguments.
        set_argument: arguments from cosines.
        multiply: the shares by a step's series.
        keep: a step's series, its slope, and the shares behind it.
    """

    codes_of: Any
    numbers_at: Any
    coefficients_at: Any
    scale_of: Any
    set_by_wavelength: Any
    set_ratios: Any
    set_cosine: Any
    set_argument: Any
    multiply: Any
    keep: Any


@cache
def cosine_series(real: types.Type) -> CosineSeries:
    """Compile the functions for one real type."""
    at = real_at(real)
    gradient = scalar(conic_gradient, real)
    zero, one, two, tiny = real(0.0), real(1.0), real(2.0), real(TINY)
    least = real(1e-3)  # that x is taken for positive from; 2x - 1 > -1 then

    @njit(**INLINED)
    def codes_of(job, k):  # noqa: ANN001, ANN202
        return carray(shifted(int64_at(job[jobs.CODES]), CODE_ROW * k), CODE_ROW)

    @njit(**INLINED)
    def numbers_at(job, place):  # noqa: ANN001, ANN202
        return carray(shifted(real64_at(job[jobs.LOSSES]), place), UNBOUNDED)

    @njit(**INLINED)
    def held(cosine):  # noqa: ANN001, ANN202
        """Return a number from 0 to 1; rays that failed may have any, and NaN."""
        cosine = cosine if cosine > zero else zero
        return cosine if cosine < one else one

    @njit(**INLINED)
    def scale_of(job, codes):  # noqa: ANN001, ANN202
        """Return 2/(1 - lowest cosine) of a step's series."""
        place = job[jobs.COEFFICIENTS] - job[jobs.SERIES] + codes[LOSS] - 1
        return real(numbers_at(job, place)[0])

    @njit(**INLINED)
    def argument(cosine, scale, lowest):  # noqa: ANN001, ANN202
        """Return x, from -1 at the lowest cosine to 1; those below it are held there."""
        return one - scale * (one - (cosine if cosine > lowest else lowest))

    @njit(**OPTIONS)
    def set_by_wavelength(job, numbers, lanes, row_):  # noqa: ANN001, ANN202
        """Fill a row with each ray's number of a table's row."""
        row = carray(row_, BLOCK)
        if job[jobs.WAVELENGTH] > 0:
            number = real(numbers[job[jobs.WAVELENGTH] - 1])
            for i in range(BLOCK):
                row[i] = number
        else:
            which = carray(int32_at(job[jobs.WHICH]), UNBOUNDED)
            for i in range(BLOCK):
                row[i] = real(numbers[which[lanes[i]]])

    @njit(**OPTIONS)
    def set_ratios(job, codes, lanes, row_):  # noqa: ANN001, ANN202
        place = job[jobs.RATIOS] + (codes[LOSS] - 1) * job[jobs.WAVELENGTHS]
        set_by_wavelength(job, numbers_at(job, place), lanes, row_)

    @njit(**OPTIONS)
    def go_beyond(job, codes, lanes, cosine_, x_):  # noqa: ANN001, ANN202
        """Fill the row of arguments from cosines beyond a mirror."""
        set_ratios(job, codes, lanes, x_)
        u, x, scale = carray(cosine_, BLOCK), carray(x_, BLOCK), scale_of(job, codes)
        lowest = one - two / scale
        for i in range(BLOCK):
            ratio = x[i]
            squared = (one - ratio * ratio) + (ratio * ratio) * (u[i] * u[i])
            x[i] = argument(math.sqrt(squared if squared > tiny else zero), scale, lowest)

    @njit(**INLINED)
    def set_cosine(job, codes, lanes, before, after, cosine_, x_):  # noqa: ANN001, ANN202
        """Fill the rows of cosines and of arguments of a step that has been taken."""
        work = at(job[jobs.WORK])
        leaving = codes[COSINE] == LEAVING
        record = shifted(at(job[jobs.VALUES]), codes[OFFSET])
        d, there = carray(after if leaving else before, STATE), carray(after, STATE)
        p, w = carray(record, SHORT_RECORD), carray(work, WORK_SIZE)
        u, x = carray(cosine_, BLOCK), carray(x_, BLOCK)
        sense, c = p[SENSE_BEHIND] if leaving else p[SENSE], p[SHAPE]
        scale = scale_of(job, codes)
        lowest = one - two / scale
        if codes[SAG_AND_SLOPES] != 0:
            for i in range(BLOCK):
                sx, sy = w[SLOPE_X + i], w[SLOPE_Y + i]
                along = d[N + i] - sx * d[L + i] - sy * d[M + i]
                u[i] = held(sense * along / math.sqrt(one + sx * sx + sy * sy))
                x[i] = argument(u[i], scale, lowest)
        elif codes[KIND] == SPHERE:
            for i in range(BLOCK):
                gx, gy, gz = gradient(c, zero, there[X + i], there[Y + i], there[Z + i])
                u[i] = held(sense * (gx * d[L + i] + gy * d[M + i] + gz * d[N + i]))
                x[i] = argument(u[i], scale, lowest)
        elif codes[KIND] == CONIC:
            k = p[SHAPE + 1]
            for i in range(BLOCK):
                gx, gy, gz = gradient(c, k, there[X + i], there[Y + i], there[Z + i])
                along = sense * (gx * d[L + i] + gy * d[M + i] + gz * d[N + i])
                u[i] = held(along / math.sqrt(gx * gx + gy * gy + gz * gz))
                x[i] = argument(u[i], scale, lowest)
        else:
            for i in range(BLOCK):
                u[i] = held(sense * d[N + i])
                x[i] = argument(u[i], scale, lowest)
        if codes[COSINE] == BEYOND:
            go_beyond(job, codes, lanes, cosine_, x_)

    @njit(**INLINED)
    def set_argument(job, codes, lanes, cosine_, x_):  # noqa: ANN001, ANN202
        """Fill the row of arguments from that of cosines."""
        if codes[COSINE] == BEYOND:
            go_beyond(job, codes, lanes, cosine_, x_)
            return
        u, x, scale = carray(cosine_, BLOCK), carray(x_, BLOCK), scale_of(job, codes)
        lowest = one - two / scale
        for i in range(BLOCK):
            x[i] = argument(u[i], scale, lowest)

    @njit(**INLINED)
    def coefficients_at(job, codes):  # noqa: ANN001, ANN202
        """Return where the coefficients of a step begin, of the first wavelength."""
        series = (codes[LOSS] - 1) * job[jobs.WAVELENGTHS]
        return job[jobs.COEFFICIENTS] + series * job[jobs.TERMS]

    @njit(**INLINED)
    def eight_at(job, place):  # noqa: ANN001, ANN202
        c = numbers_at(job, place)
        upper = real(c[7]), real(c[6]), real(c[5]), real(c[4])
        return upper, (real(c[3]), real(c[2]), real(c[1]), real(c[0]))

    @njit(**INLINED)
    def four_more(c, x, b):  # noqa: ANN001, ANN202
        """Go on with Horner's rule by four coefficients."""
        return (((b * x + c[0]) * x + c[1]) * x + c[2]) * x + c[3]

    @njit(**INLINED)
    def four_slopes(c, x, b, d):  # noqa: ANN001, ANN202
        """Go on with value and slope by four coefficients."""
        d = d * x + b
        b = b * x + c[0]
        d = d * x + b
        b = b * x + c[1]
        d = d * x + b
        b = b * x + c[2]
        return b * x + c[3], d * x + b

    @njit(**INLINED)
    def multiply_by_powers(job, first, terms, rows):  # noqa: ANN001, ANN202
        """Multiply the row of shares by a polynomial, by Horner's rule."""
        x, b = carray(shifted(rows, ARGUMENT), BLOCK), carray(shifted(rows, SUM), BLOCK)
        share, last = carray(shifted(rows, SHARES), BLOCK), first + terms - 8
        for i in range(BLOCK):
            b[i] = zero
        while last > first:
            upper, lower = eight_at(job, last)
            for i in range(BLOCK):
                b[i] = four_more(lower, x[i], four_more(upper, x[i], b[i]))
            last -= 8
        upper, lower = eight_at(job, first)
        for i in range(BLOCK):
            share[i] *= four_more(lower, x[i], four_more(upper, x[i], b[i]))

    @njit(**INLINED)
    def keep_powers(job, first, terms, scale, rows, own):  # noqa: ANN001, ANN202
        """Fill the rows of a polynomial, of its slope with respect to the cosine, and of the share
        that is left behind it.
        """
        x, b = carray(shifted(rows, ARGUMENT), BLOCK), carray(shifted(rows, SUM), BLOCK)
        d, last = carray(shifted(rows, BEFORE_SUM), BLOCK), first + terms - 8
        s = carray(own, UNBOUNDED)
        for i in range(BLOCK):
            b[i], d[i] = zero, zero
        while last > first:
            upper, lower = eight_at(job, last)
            for i in range(BLOCK):
                b0, d0 = four_slopes(upper, x[i], b[i], d[i])
                b[i], d[i] = four_slopes(lower, x[i], b0, d0)
            last -= 8
        upper, lower = eight_at(job, first)
        for i in range(BLOCK):
            b0, d0 = four_slopes(upper, x[i], b[i], d[i])
            b0, d0 = four_slopes(lower, x[i], b0, d0)
            # Below the lowest cosine the share is the same.
            s[SLOPES + i] = scale * d0 if x[i] > -one else zero
            s[FACTORS + i], s[SHARES + NEXT + i] = b0, s[SHARES + i] * b0

    @njit(**OPTIONS)
    def sum_chebyshev(job, first, terms, x_, sum_, before_):  # noqa: ANN001, ANN202
        """Fill a row with a series by Clenshaw's sums b_k = c_k + 2x·b_(k+1) - b_(k+2)."""
        x, b, e = carray(x_, BLOCK), carray(sum_, BLOCK), carray(before_, BLOCK)
        for i in range(BLOCK):
            b[i], e[i] = zero, zero
        for j in range(terms - 4, -1, -4):
            c = numbers_at(job, first + j)
            c3, c2, c1, c0 = real(c[3]), real(c[2]), real(c[1]), real(c[0])
            for i in range(BLOCK):
                t, b0, e0 = two * x[i], b[i], e[i]
                e0 = (c3 + t * b0) - e0
                b0 = (c2 + t * e0) - b0
                e0 = (c1 + t * b0) - e0
                b[i], e[i] = (c0 + t * e0) - b0, e0
        for i in range(BLOCK):
            b[i] -= x[i] * e[i]

    @njit(**OPTIONS)
    def sum_mixed(job, first, summed, lanes, x_, sum_, before_):  # noqa: ANN001, ANN202
        """Fill a row with either, of rays of several wavelengths."""
        x, b, e = carray(x_, BLOCK), carray(sum_, BLOCK), carray(before_, BLOCK)
        which, terms = carray(int32_at(job[jobs.WHICH]), UNBOUNDED), job[jobs.TERMS]
        powers = summed > 0
        for i in range(BLOCK):
            b[i], e[i] = zero, zero
        for j in range(abs(summed) - 1, -1, -1):
            c = numbers_at(job, first + j)
            if powers:
                for i in range(BLOCK):
                    b[i] = b[i] * x[i] + real(c[terms * which[lanes[i]]])
            else:
                for i in range(BLOCK):
                    own = real(c[terms * which[lanes[i]]])
                    b[i], e[i] = (own + two * x[i] * b[i]) - e[i], b[i]
        for i in range(BLOCK):
            b[i] -= x[i] * e[i]

    @njit(**INLINED)
    def place_of(job, codes, part):  # noqa: ANN001, ANN202
        """Return where a step's coefficients begin as they are summed (part 1), those of its slope
        (part 2), or the powers of 2x - 1 (part 3): of the rays' wavelength, or of the first where
        they differ.
        """
        all_ = job[jobs.SERIES] * job[jobs.WAVELENGTHS] * job[jobs.TERMS]
        common = job[jobs.WAVELENGTH] - 1
        first = coefficients_at(job, codes) + part * all_
        return first + (common if common > 0 else 0) * job[jobs.TERMS]

    @njit(**OPTIONS)
    def sum_other(job, codes, part, lanes, rows, sum_):  # noqa: ANN001, ANN202
        """Fill a row with a series of many terms, or of several wavelengths."""
        x, before = shifted(rows, ARGUMENT), shifted(rows, BEFORE_SUM)
        if job[jobs.WAVELENGTH] == 0:
            sum_mixed(job, place_of(job, codes, part), codes[SUMMED], lanes, x, sum_, before)
        else:
            sum_chebyshev(job, place_of(job, codes, part), -codes[SUMMED], x, sum_, before)

    @njit(**INLINED)
    def is_near(job, codes, after, rows):  # noqa: ANN001, ANN202
        """Return whether x > 0 for all rays of a block, which have one wavelength; the arguments
        are then turned to 2x - 1.
        """
        if job[jobs.WAVELENGTH] == 0 or codes[NEAR] == 0:
            return False
        x, state = carray(shifted(rows, ARGUMENT), BLOCK), carray(after, STATE)
        steep = zero
        for i in range(BLOCK):
            steep += one if (x[i] < least) & (state[ENDED + i] == zero) else zero
        if steep > zero:
            return False
        for i in range(BLOCK):
            near = two * x[i] - one
            x[i] = near if near > -one else -one
        return True

    @njit(**INLINED)
    def multiply(job, codes, lanes, after, rows):  # noqa: ANN001, ANN202
        """Multiply the row of shares by a step's series."""
        if is_near(job, codes, after, rows):
            multiply_by_powers(job, place_of(job, codes, 3), codes[NEAR], rows)
            return
        if job[jobs.WAVELENGTH] > 0 and codes[SUMMED] > 0:
            multiply_by_powers(job, place_of(job, codes, 1), codes[SUMMED], rows)
            return
        sum_other(job, codes, 1, lanes, rows, shifted(rows, SUM))
        r = carray(rows, UNBOUNDED)
        for i in range(BLOCK):
            r[SHARES + i] *= r[SUM + i]

    @njit(**INLINED)
    def keep(job, codes, lanes, after, rows, own):  # noqa: ANN001, ANN202
        """Fill the rows of a step's series, of its slope, and of the share behind it."""
        if is_near(job, codes, after, rows):
            scale = two * scale_of(job, codes)
            keep_powers(job, place_of(job, codes, 3), codes[NEAR], scale, rows, own)
            return
        if job[jobs.WAVELENGTH] > 0 and codes[SUMMED] > 0:
            scale = scale_of(job, codes)
            keep_powers(job, place_of(job, codes, 1), codes[SUMMED], scale, rows, own)
            return
        sum_other(job, codes, 1, lanes, rows, shifted(own, FACTORS))
        sum_other(job, codes, 2, lanes, rows, shifted(own, SLOPES))
        x, s = carray(shifted(rows, ARGUMENT), BLOCK), carray(own, UNBOUNDED)
        for i in range(BLOCK):
            slope = s[SLOPES + i]
            s[SLOPES + i] = slope if x[i] > -one else zero
            s[SHARES + NEXT + i] = s[SHARES + i] * s[FACTORS + i]

    return CosineSeries(
        codes_of,
        numbers_at,
        coefficients_at,
        scale_of,
        set_by_wavelength,
        set_ratios,
        set_cosine,
        set_argument,
        multiply,
        keep,
    )
