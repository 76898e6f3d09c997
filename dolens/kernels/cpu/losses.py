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

from dolens.kernels.cpu import jobs
from dolens.kernels.cpu.adjoint import adjoint_driver
from dolens.kernels.cpu.compiler import OPTIONS, int32_at, real64_at, shifted
from dolens.kernels.cpu.cosine_series import BEYOND, INLINED, LEAVING, NEXT, cosine_series
from dolens.kernels.cpu.forward import forward_driver, real_at, streams
from dolens.kernels.cpu.layout import (
    ARGUMENT,
    BEFORE,
    BEFORE_SUM,
    BLOCK,
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
    SENSE,
    SENSE_BEHIND,
    SHARES,
    SHORT_RECORD,
    SLOPES,
    STATE,
    SUM,
    TRAVELLED,
    UNBOUNDED,
    WEIGHT,
    WORK_SIZE,
)


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

    @njit(**INLINED)
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
    step, exponential = streams(real).step, _exponential(real)
    codes_of, numbers_at, coefficients_at, scale_of, *others = cosine_series(real)
    set_by_wavelength, set_ratios, set_cosine, set_argument, multiply, keep_series = others
    zero, one, two = real(0.0), real(1.0), real(2.0)

    @njit(**INLINED)
    def is_clear(job, codes):  # noqa: ANN001, ANN202
        """Return whether a step is known to absorb nothing."""
        common = job[jobs.WAVELENGTH] - 1
        if job[jobs.ABSORBS] == 0:
            return True
        place = codes[BEFORE] * job[jobs.WAVELENGTHS] + common
        return common >= 0 and numbers_at(job, place)[0] == types.float64(0.0)

    @njit(**INLINED)
    def begin(job):  # noqa: ANN001, ANN202
        rows = carray(at(job[jobs.DRIVER_ROWS]), UNBOUNDED)
        for i in range(BLOCK):
            rows[DEPTH + i], rows[SHARES + i] = zero, one

    @njit(**INLINED)
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

    @njit(**INLINED)
    def go_on(job, k, lanes, before, after):  # noqa: ANN001, ANN202
        codes, rows = codes_of(job, k), at(job[jobs.DRIVER_ROWS])
        if not is_clear(job, codes):
            absorb(job, codes, lanes, after, rows)
        if codes[LOSS] == 0:
            return
        cosine, x = shifted(rows, COSINES), shifted(rows, ARGUMENT)
        set_cosine(job, codes, lanes, before, after, cosine, x)
        multiply(job, codes, lanes, after, rows)

    @njit(**INLINED)
    def store_share(job, start, count):  # noqa: ANN001, ANN202
        rows = carray(at(job[jobs.DRIVER_ROWS]), UNBOUNDED)
        out = carray(shifted(at(job[jobs.OUT_TRANSMISSION]), start), BLOCK)
        for i in range(count):
            out[i] = rows[SHARES + i] * exponential(rows[DEPTH + i])

    @njit(**INLINED)
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
                own = shifted(rows, NEXT * (codes[LOSS] - 1))
                cosine, x = shifted(own, COSINES), shifted(rows, ARGUMENT)
                set_cosine(job, codes, lanes, now, then, cosine, x)
                keep_series(job, codes, lanes, then, rows, own)

    @njit(**INLINED)
    def turn_round(job, lanes, count):  # noqa: ANN001, ANN202
        rows = carray(at(job[jobs.DRIVER_ROWS]), UNBOUNDED)
        left = carray(shifted(at(job[jobs.DRIVER_ROWS]), SHARES + NEXT * job[jobs.SERIES]), BLOCK)
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

    @njit(**INLINED)
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

    @njit(**INLINED)
    def pass_back(job, codes, lanes, rows, sums):  # noqa: ANN001, ANN202
        """Take the cotangents of the share back through a surface, and leave that of its cosine."""
        own = shifted(rows, NEXT * (codes[LOSS] - 1))
        r, s, w = (
            carray(rows, UNBOUNDED),
            carray(own, UNBOUNDED),
            carray(at(job[jobs.WORK]), WORK_SIZE),
        )
        p = carray(shifted(at(job[jobs.VALUES]), codes[OFFSET]), SHORT_RECORD)
        leaving, beyond = codes[COSINE] == LEAVING, codes[COSINE] == BEYOND
        sense, sense_behind = p[SENSE], p[SENSE_BEHIND]
        arriving = zero if leaving else sense
        departing = sense_behind if leaving else zero
        for i in range(BLOCK):
            h, share = r[OF_SHARE + i], s[SHARES + i]
            r[OF_SHARE + i], r[SUM + i] = h * s[FACTORS + i], h * share
            of_cosine = h * share * s[SLOPES + i]
            w[OF_ARRIVING + i], w[OF_LEAVING + i] = arriving * of_cosine, departing * of_cosine
        if beyond or job[jobs.LOSS_SUMS] != 0:
            set_argument(job, codes, lanes, shifted(own, COSINES), shifted(rows, ARGUMENT))
        if beyond:
            come_back(job, codes, lanes, shifted(own, COSINES), rows, sums)
        if job[jobs.LOSS_SUMS] != 0:
            for i in range(BLOCK):
                r[BEFORE_SUM + i] = r[SUM + i] * r[ARGUMENT + i]
            add_coefficients(job, codes, lanes, rows, sums)

    @njit(**INLINED)
    def moves(codes):  # noqa: ANN001, ANN202
        """Return whether rays travel at a step, so that its adjoint takes a path's cotangent in."""
        return codes[KIND] != DEFLECT and codes[KIND] != LENS_AXES

    @njit(**INLINED)
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

    @njit(**INLINED)
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
