"""The share of its power that is left to a ray is carried through all steps, and back.

A surface passes a share that is a Chebyshev series in the cosine of incidence, and a medium of
absorption α leaves exp(-α·t) over a distance t.  All cosines and products of a block are
kept, so that no derivative divides by a share, which may be zero.
"""

import math
from collections.abc import Callable
from functools import cache
from typing import Any, NamedTuple

from llvmlite import ir
from numba import carray, njit, types
from numba.extending import intrinsic

from dolens.kernels.conic import conic_gradient
from dolens.kernels.cpu import jobs
from dolens.kernels.cpu.adjoint import adjoint_driver
from dolens.kernels.cpu.compiler import OPTIONS, int32_at, int64_at, real64_at, shifted
from dolens.kernels.cpu.forward import forward_driver, real_at, streams
from dolens.kernels.cpu.layout import (
    ARGUMENT,
    BEFORE,
    BEFORE_SUM,
    BLOCK,
    CODE_ROW,
    CONIC,
    COSINE,
    COSINES,
    DEFLECT,
    DEPTH,
    FACTORS,
    KIND,
    LENS_AXES,
    LOSS,
    OF_ARRIVING,
    OF_DEPTH,
    OF_FRONT,
    OF_LEAVING,
    OF_PATH,
    OF_SHARE,
    OFFSET,
    PATH,
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
    TRAVELLED,
    UNBOUNDED,
    WEIGHT,
    WORK_SIZE,
    L,
    M,
    N,
    X,
    Y,
    Z,
)
from dolens.kernels.cpu.translation import scalar
from dolens.kernels.table import POWERS, TINY, Cosine

# A call between functions takes as long as a loop over a block; what is rare is not inlined.
_INLINED = {**OPTIONS, "forceinline": True}
_LEAVING, _BEYOND = int(Cosine.LEAVING), int(Cosine.BEYOND)
_NEXT = ROWS_OF_A_SERIES * BLOCK  # from the rows of a series to those of the next


class PassedLight(NamedTuple):
    """These compiled functions join the drivers of a trace and of its adjoint.

    Attributes:
        begin: all of the light is there.
        go_on: lose what a step that has been taken loses.
        store_share: write the shares that are left.
        keep: trace the block as `Sweeps.forward` does, and keep cosines and shares.
        turn_round: load the cotangents of the shares that are left.
        prepare: before the adjoint of a step: cotangents of its cosine and its distance.
        finish: after it: what these took the place of.
    """

    begin: Any
    go_on: Any
    store_share: Any
    keep: Any
    turn_round: Any
    prepare: Any
    finish: Any


@cache
def _exponential(real: types.Type) -> Any:
    """Compile exp(-depth), of depths within ±80: by 2^k·exp(r), |r| ≤ ln 2 / 2, which LLVM
    vectorises, as it does no function of the system's library.
    """
    single = real is types.float32
    bits, bias = (23, 127) if single else (52, 1023)
    width = ir.IntType(32 if single else 64)

    @intrinsic
    def power_of_two(context, exponent):  # noqa: ANN001, ANN202
        def generate(context, builder, signature, given):  # noqa: ANN001, ANN202
            whole = builder.fptosi(given[0], width)
            whole = builder.shl(builder.add(whole, width(bias)), width(bits))
            return builder.bitcast(whole, given[0].type)

        return real(real), generate

    @intrinsic
    def rounded(context, number):  # noqa: ANN001, ANN202
        def generate(context, builder, signature, given):  # noqa: ANN001, ANN202
            nearest = builder.module.declare_intrinsic("llvm.rint", [given[0].type])
            return builder.call(nearest, given)

        return real(real), generate

    zero, one, largest = real(0.0), real(1.0), real(80.0)
    per_octave, octave = real(1.0 / math.log(2.0)), real(math.log(2.0))
    terms = tuple(real(1.0 / math.factorial(k)) for k in range(8 if single else 14, 0, -1))

    @njit(**_INLINED)
    def exponential(depth):  # noqa: ANN001, ANN202
        power = -depth if math.fabs(depth) < largest else (largest if depth < zero else -largest)
        octaves = rounded(power * per_octave)
        rest = power - octaves * octave
        total = zero
        for term in terms:
            total = total * rest + term
        return (one + total * rest) * power_of_two(octaves)

    return exponential


@cache
def passed_light(real: types.Type) -> PassedLight:
    """Compile the functions for one real type."""
    at = real_at(real)
    step = streams(real).step
    gradient, exponential = scalar(conic_gradient, real), _exponential(real)
    zero, one, two, tiny = real(0.0), real(1.0), real(2.0), real(TINY)

    @njit(**_INLINED)
    def codes_of(job, k):  # noqa: ANN001, ANN202
        return carray(shifted(int64_at(job[jobs.CODES]), CODE_ROW * k), CODE_ROW)

    @njit(**_INLINED)
    def numbers_at(job, place):  # noqa: ANN001, ANN202
        return carray(shifted(real64_at(job[jobs.LOSSES]), place), UNBOUNDED)

    @njit(**_INLINED)
    def held(cosine):  # noqa: ANN001, ANN202
        """Return a number from 0 to 1; rays that failed may have any, and NaN."""
        cosine = cosine if cosine > zero else zero
        return cosine if cosine < one else one

    @njit(**_INLINED)
    def scale_of(job, codes):  # noqa: ANN001, ANN202
        """Return 2/(1 - lowest cosine) of a step's series."""
        place = job[jobs.COEFFICIENTS] - job[jobs.SERIES] + codes[LOSS] - 1
        return real(numbers_at(job, place)[0])

    @njit(**_INLINED)
    def argument(cosine, scale, lowest):  # noqa: ANN001, ANN202
        """Return x, from -1 at the lowest cosine to 1; those below it are held there."""
        return one - scale * (one - (cosine if cosine > lowest else lowest))

    @njit(**_INLINED)
    def set_cosine(job, codes, before, after, work, cosine_, x_):  # noqa: ANN001, ANN202
        """Fill the rows of cosines and of arguments of a step that has been taken."""
        leaving = codes[COSINE] == _LEAVING
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

    @njit(**_INLINED)
    def coefficients_at(job, codes):  # noqa: ANN001, ANN202
        """Return where the coefficients of a step begin, of the first wavelength."""
        series = (codes[LOSS] - 1) * job[jobs.WAVELENGTHS]
        return job[jobs.COEFFICIENTS] + series * job[jobs.TERMS]

    @njit(**_INLINED)
    def sum_powers(job, first, x_, sum_):  # noqa: ANN001, ANN202
        """Fill a row with a polynomial by Horner's rule, four terms at once."""
        x, b = carray(x_, BLOCK), carray(sum_, BLOCK)
        last = first + job[jobs.TERMS] - 4
        c = numbers_at(job, last)
        c3, c2, c1, c0 = real(c[3]), real(c[2]), real(c[1]), real(c[0])
        for i in range(BLOCK):
            b[i] = ((c3 * x[i] + c2) * x[i] + c1) * x[i] + c0
        while last > first:
            last -= 4
            c = numbers_at(job, last)
            c3, c2, c1, c0 = real(c[3]), real(c[2]), real(c[1]), real(c[0])
            for i in range(BLOCK):
                b[i] = (((b[i] * x[i] + c3) * x[i] + c2) * x[i] + c1) * x[i] + c0

    @njit(**OPTIONS)
    def sum_chebyshev(job, first, x_, sum_, before_):  # noqa: ANN001, ANN202
        """Fill a row with a series by Clenshaw's sums b_k = c_k + 2x·b_(k+1) - b_(k+2)."""
        x, b, e = carray(x_, BLOCK), carray(sum_, BLOCK), carray(before_, BLOCK)
        for i in range(BLOCK):
            b[i], e[i] = zero, zero
        for j in range(job[jobs.TERMS] - 4, -1, -4):
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
    def sum_mixed(job, first, lanes, x_, sum_, before_):  # noqa: ANN001, ANN202
        """Fill a row with either, of rays of several wavelengths."""
        x, b, e = carray(x_, BLOCK), carray(sum_, BLOCK), carray(before_, BLOCK)
        which, terms = carray(int32_at(job[jobs.WHICH]), UNBOUNDED), job[jobs.TERMS]
        powers = terms <= POWERS
        for i in range(BLOCK):
            b[i], e[i] = zero, zero
        for j in range(terms - 1, -1, -1):
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

    @njit(**_INLINED)
    def sum_series(job, codes, part, lanes, rows, sum_):  # noqa: ANN001, ANN202
        """Fill a row with the series at its arguments (part 1) or its slope (part 2)."""
        x, before = shifted(rows, ARGUMENT), shifted(rows, BEFORE_SUM)
        all_ = job[jobs.SERIES] * job[jobs.WAVELENGTHS] * job[jobs.TERMS]
        first = coefficients_at(job, codes) + part * all_
        common = job[jobs.WAVELENGTH] - 1
        if common < 0:
            sum_mixed(job, first, lanes, x, sum_, before)
        elif job[jobs.TERMS] <= POWERS:
            sum_powers(job, first + common * job[jobs.TERMS], x, sum_)
        else:
            sum_chebyshev(job, first + common * job[jobs.TERMS], x, sum_, before)

    @njit(**_INLINED)
    def is_clear(job, codes):  # noqa: ANN001, ANN202
        """Return whether a step is known to absorb nothing."""
        common = job[jobs.WAVELENGTH] - 1
        if job[jobs.ABSORBS] == 0:
            return True
        place = codes[BEFORE] * job[jobs.WAVELENGTHS] + common
        return common >= 0 and numbers_at(job, place)[0] == types.float64(0.0)

    @njit(**OPTIONS)
    def begin(job):  # noqa: ANN001, ANN202
        rows = carray(at(job[jobs.DRIVER_ROWS]), UNBOUNDED)
        for i in range(BLOCK):
            rows[DEPTH + i], rows[SHARES + i] = zero, one

    @njit(**_INLINED)
    def absorb(job, codes, lanes, after, rows):  # noqa: ANN001, ANN202
        """Add what a step adds to the depth."""
        absorption = numbers_at(job, codes[BEFORE] * job[jobs.WAVELENGTHS])
        r, state = carray(rows, UNBOUNDED), carray(after, STATE)
        if job[jobs.WAVELENGTH] > 0:
            alpha = real(absorption[job[jobs.WAVELENGTH] - 1])
            for i in range(BLOCK):
                r[DEPTH + i] += alpha * state[TRAVELLED + i]
        else:
            set_by_wavelength(job, absorption, lanes, shifted(rows, ARGUMENT))
            for i in range(BLOCK):
                r[DEPTH + i] += r[ARGUMENT + i] * state[TRAVELLED + i]

    @njit(**_INLINED)
    def go_on(job, k, lanes, before, after):  # noqa: ANN001, ANN202
        codes, rows = codes_of(job, k), at(job[jobs.DRIVER_ROWS])
        if not is_clear(job, codes):
            absorb(job, codes, lanes, after, rows)
        if codes[LOSS] == 0:
            return
        cosine, x = shifted(rows, COSINES), shifted(rows, ARGUMENT)
        set_cosine(job, codes, before, after, at(job[jobs.WORK]), cosine, x)
        if codes[COSINE] == _BEYOND:
            go_beyond(job, codes, lanes, cosine, x)
        sum_series(job, codes, 1, lanes, rows, shifted(rows, FACTORS))
        r = carray(rows, UNBOUNDED)
        for i in range(BLOCK):
            r[SHARES + i] *= r[FACTORS + i]

    @njit(**_INLINED)
    def store_share(job, start, count):  # noqa: ANN001, ANN202
        rows = carray(at(job[jobs.DRIVER_ROWS]), UNBOUNDED)
        out = carray(shifted(at(job[jobs.OUT_TRANSMISSION]), start), BLOCK)
        for i in range(count):
            out[i] = rows[SHARES + i] * exponential(rows[DEPTH + i])

    @njit(**_INLINED)
    def keep_series(job, codes, lanes, before, after, rows):  # noqa: ANN001, ANN202
        """Fill the rows of a step's series, and that of the share in front of the next."""
        own = shifted(rows, _NEXT * (codes[LOSS] - 1))
        cosine, x = shifted(own, COSINES), shifted(rows, ARGUMENT)
        set_cosine(job, codes, before, after, at(job[jobs.WORK]), cosine, x)
        if codes[COSINE] == _BEYOND:
            go_beyond(job, codes, lanes, cosine, x)
        sum_series(job, codes, 1, lanes, rows, shifted(own, FACTORS))
        sum_series(job, codes, 2, lanes, rows, shifted(own, SLOPES))
        r, s = carray(rows, UNBOUNDED), carray(own, UNBOUNDED)
        for i in range(BLOCK):
            # Below the lowest cosine the share is the same.
            slope = s[SLOPES + i]
            s[SLOPES + i] = slope if r[ARGUMENT + i] > -one else zero
            s[SHARES + _NEXT + i] = s[SHARES + i] * s[FACTORS + i]

    @njit(**OPTIONS)
    def keep(job, lanes):  # noqa: ANN001, ANN202
        begin(job)
        stack, work, rows = at(job[jobs.STACK]), at(job[jobs.WORK]), at(job[jobs.DRIVER_ROWS])
        for k in range(job[jobs.STEPS]):
            now, then = shifted(stack, STATE * k), shifted(stack, STATE * (k + 1))
            step(job, k, lanes, now, then, then, work)
            codes = codes_of(job, k)
            if not is_clear(job, codes):
                absorb(job, codes, lanes, then, rows)
            if codes[LOSS] != 0:
                keep_series(job, codes, lanes, now, then, rows)

    @njit(**OPTIONS)
    def turn_round(job, lanes, count):  # noqa: ANN001, ANN202
        rows = carray(at(job[jobs.DRIVER_ROWS]), UNBOUNDED)
        left = carray(shifted(at(job[jobs.DRIVER_ROWS]), SHARES + _NEXT * job[jobs.SERIES]), BLOCK)
        path = carray(shifted(at(job[jobs.COTANGENTS]), PATH), BLOCK)
        for i in range(BLOCK):
            rows[OF_SHARE + i], rows[OF_PATH + i] = zero, path[i]
        if job[jobs.TRANSMISSION_COTANGENT] != 0:
            given = carray(at(job[jobs.TRANSMISSION_COTANGENT]), UNBOUNDED)
            for i in range(count):
                rows[OF_SHARE + i] = given[lanes[i] * job[jobs.TRANSMISSION_COTANGENT_ROW]]
        for i in range(BLOCK):
            of_share = rows[OF_SHARE + i] * exponential(rows[DEPTH + i])
            rows[OF_SHARE + i], rows[OF_DEPTH + i] = of_share, -of_share * left[i]

    @njit(**_INLINED)
    def add_by_wavelength(job, row_, lanes, sums, place):  # noqa: ANN001, ANN202
        """Add a row to the sums of the rays' wavelengths."""
        row = carray(row_, BLOCK)
        if job[jobs.WAVELENGTH] > 0:
            total = zero
            for i in range(BLOCK):
                total += row[i]
            sums[place + job[jobs.WAVELENGTH] - 1] += types.float64(total)
        else:
            which = carray(int32_at(job[jobs.WHICH]), UNBOUNDED)
            for i in range(BLOCK):
                sums[place + which[lanes[i]]] += types.float64(row[i])

    @njit(**OPTIONS)
    def add_coefficients(job, codes, lanes, rows, sums):  # noqa: ANN001, ANN202
        """Add the cotangents h·T_k(x) of the coefficients; h is in the row SUM, h·x in the next."""
        x = carray(shifted(rows, ARGUMENT), BLOCK)
        b, e = carray(shifted(rows, SUM), BLOCK), carray(shifted(rows, BEFORE_SUM), BLOCK)
        place, terms = job[jobs.LOSS_SUMS] + coefficients_at(job, codes), job[jobs.TERMS]
        if job[jobs.WAVELENGTH] > 0:
            place += (job[jobs.WAVELENGTH] - 1) * terms
            for j in range(0, terms, 4):
                s0 = s1 = s2 = s3 = zero
                for i in range(BLOCK):
                    t, t0, t1 = two * x[i], b[i], e[i]
                    t2 = t * t1 - t0
                    t3 = t * t2 - t1
                    s0 += t0
                    s1 += t1
                    s2 += t2
                    s3 += t3
                    t0 = t * t3 - t2
                    b[i], e[i] = t0, t * t0 - t3
                sums[place + j] += types.float64(s0)
                sums[place + j + 1] += types.float64(s1)
                sums[place + j + 2] += types.float64(s2)
                sums[place + j + 3] += types.float64(s3)
        else:
            which = carray(int32_at(job[jobs.WHICH]), UNBOUNDED)
            for j in range(terms):
                for i in range(BLOCK):
                    sums[place + j + terms * which[lanes[i]]] += types.float64(b[i])
                    b[i], e[i] = e[i], two * x[i] * e[i] - b[i]

    @njit(**OPTIONS)
    def come_back(job, codes, lanes, cosine_, rows, sums):  # noqa: ANN001, ANN202
        """Turn the cotangents of a cosine beyond a mirror into those of the arriving one, and add
        those of the ratios.
        """
        set_ratios(job, codes, lanes, shifted(rows, WEIGHT))
        r, u = carray(rows, UNBOUNDED), carray(cosine_, BLOCK)
        w = carray(at(job[jobs.WORK]), WORK_SIZE)
        sense = carray(shifted(at(job[jobs.VALUES]), codes[OFFSET]), SHORT_RECORD)[SENSE]
        scale = scale_of(job, codes)
        for i in range(BLOCK):
            ratio, beyond = r[WEIGHT + i], one - (one - r[ARGUMENT + i]) / scale
            per_beyond = w[OF_ARRIVING + i] / beyond if beyond > zero else zero
            w[OF_ARRIVING + i] = per_beyond * ratio * ratio * u[i]
            r[WEIGHT + i] = sense * per_beyond * ratio * (u[i] * u[i] - one)
        if job[jobs.LOSS_SUMS] != 0:
            place = job[jobs.RATIOS] + (codes[LOSS] - 1) * job[jobs.WAVELENGTHS]
            place += job[jobs.LOSS_SUMS]
            add_by_wavelength(job, shifted(rows, WEIGHT), lanes, sums, place)

    @njit(**_INLINED)
    def pass_back(job, codes, lanes, rows, sums):  # noqa: ANN001, ANN202
        """Take the cotangents of the share back through a surface, and leave that of its cosine."""
        own = shifted(rows, _NEXT * (codes[LOSS] - 1))
        r, s, w = (
            carray(rows, UNBOUNDED),
            carray(own, UNBOUNDED),
            carray(at(job[jobs.WORK]), WORK_SIZE),
        )
        p = carray(shifted(at(job[jobs.VALUES]), codes[OFFSET]), SHORT_RECORD)
        leaving, beyond = codes[COSINE] == _LEAVING, codes[COSINE] == _BEYOND
        sense, sense_behind = p[SENSE], p[SENSE_BEHIND]
        arriving = zero if leaving else sense
        departing = sense_behind if leaving else zero
        for i in range(BLOCK):
            h, share = r[OF_SHARE + i], s[SHARES + i]
            r[OF_SHARE + i], r[SUM + i] = h * s[FACTORS + i], h * share
            of_cosine = h * share * s[SLOPES + i]
            w[OF_ARRIVING + i], w[OF_LEAVING + i] = arriving * of_cosine, departing * of_cosine
        if beyond:
            cosine = shifted(own, COSINES)
            go_beyond(job, codes, lanes, cosine, shifted(rows, ARGUMENT))
            come_back(job, codes, lanes, cosine, rows, sums)
        elif job[jobs.LOSS_SUMS] != 0:
            scale = scale_of(job, codes)
            lowest = one - two / scale
            for i in range(BLOCK):
                r[ARGUMENT + i] = argument(s[COSINES + i], scale, lowest)
        if job[jobs.LOSS_SUMS] != 0:
            for i in range(BLOCK):
                r[BEFORE_SUM + i] = r[SUM + i] * r[ARGUMENT + i]
            add_coefficients(job, codes, lanes, rows, sums)

    @njit(**_INLINED)
    def moves(codes):  # noqa: ANN001, ANN202
        """Return whether rays travel at a step, so that its adjoint takes a path's cotangent in."""
        return codes[KIND] != DEFLECT and codes[KIND] != LENS_AXES

    @njit(**OPTIONS)
    def prepare(job, k, lanes, sums):  # noqa: ANN001, ANN202
        """Where a medium absorbs, what t brings to the depth joins the cotangent of the path, n·t:
        by α/n of that of the depth.
        """
        codes, rows = codes_of(job, k), at(job[jobs.DRIVER_ROWS])
        if codes[LOSS] != 0:
            pass_back(job, codes, lanes, rows, sums)
        if job[jobs.ABSORBS] == 0 or not moves(codes):
            return
        r, count = carray(rows, UNBOUNDED), job[jobs.WAVELENGTHS]
        if job[jobs.LOSS_SUMS] != 0:
            then = carray(shifted(at(job[jobs.STACK]), STATE * (k + 1)), STATE)
            for i in range(BLOCK):
                r[WEIGHT + i] = r[OF_DEPTH + i] * then[TRAVELLED + i]
            place = job[jobs.LOSS_SUMS] + codes[BEFORE] * count
            add_by_wavelength(job, shifted(rows, WEIGHT), lanes, sums, place)
        if is_clear(job, codes):
            return
        indices = carray(shifted(real64_at(job[jobs.INDICES]), codes[BEFORE] * count), UNBOUNDED)
        absorption = numbers_at(job, codes[BEFORE] * count)
        path = carray(shifted(at(job[jobs.COTANGENTS]), PATH), BLOCK)
        if job[jobs.WAVELENGTH] > 0:
            common = job[jobs.WAVELENGTH] - 1
            weight = real(absorption[common] / indices[common])
            for i in range(BLOCK):
                more = weight * r[OF_DEPTH + i]
                r[SUM + i], path[i] = more, r[OF_PATH + i] + more
        else:
            set_by_wavelength(job, absorption, lanes, shifted(rows, SUM))
            set_by_wavelength(job, indices, lanes, shifted(rows, WEIGHT))
            for i in range(BLOCK):
                more = r[SUM + i] / r[WEIGHT + i] * r[OF_DEPTH + i]
                r[SUM + i], path[i] = more, r[OF_PATH + i] + more

    @njit(**OPTIONS)
    def finish(job, k):  # noqa: ANN001, ANN202
        """The path has its own cotangent again, and the index that of the path alone."""
        codes = codes_of(job, k)
        if is_clear(job, codes) or not moves(codes):
            return
        r = carray(at(job[jobs.DRIVER_ROWS]), UNBOUNDED)
        cot = carray(at(job[jobs.COTANGENTS]), UNBOUNDED)
        then = carray(shifted(at(job[jobs.STACK]), STATE * (k + 1)), STATE)
        for i in range(BLOCK):
            cot[PATH + i] = r[OF_PATH + i]
            cot[OF_FRONT + i] -= r[SUM + i] * then[TRAVELLED + i]

    return PassedLight(begin, go_on, store_share, keep, turn_round, prepare, finish)


def lossy_forward_driver(real: types.Type) -> Callable[..., None]:
    """Compile the forward driver of rays that lose light."""
    return forward_driver(real, passed_light(real))


def lossy_adjoint_driver(real: types.Type) -> Callable[..., None]:
    """Compile the backward driver of rays that lose light."""
    return adjoint_driver(real, passed_light(real))
