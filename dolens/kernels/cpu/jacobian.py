"""Driver of Jacobians: how every ray's outputs move with the lens's variables.

A block is traced once and its states are kept.  Each output (x or y on the sensor, path length) is
then swept back with a cotangent of one; since a ray depends on no other, the cotangents of a step's
numbers are each ray's own derivatives, and are added to the columns of the variables.

A block of which few rays pass is not swept: its valid rays wait until they fill a block with others
and are traced again.  Chunks do not share rays, so that the threads do not matter.
"""

from collections.abc import Callable
from functools import cache
from typing import Any, NamedTuple

from numba import carray, njit, types

from dolens.kernels.cpu.adjoint import sweeps
from dolens.kernels.cpu.compiler import (
    OPTIONS,
    call_block,
    int8_at,
    int64_at,
    real64_at,
    shifted,
)
from dolens.kernels.cpu.forward import real_at, streams


class Columns(NamedTuple):
    """Compiled functions that the drivers of Jacobians share."""

    begin: Any
    trace: Any
    differentiate: Any
    wait: Any
    resume: Any


@cache
def columns(real: types.Type) -> Columns:
    """Functions that trace a block and fill its columns with derivatives, for one real type."""
    at = real_at(real)
    _, load, set_indices, step = streams(real)
    load_lanes, *_ = sweeps(real)
    zero, one = real(0.0), real(1.0)

    @njit(**OPTIONS)
    def end_vignetted(state_):  # noqa: ANN001, ANN202
        state = carray(state_, 1280)
        for i in range(128):
            ended, vignetted = state[896 + i], state[1024 + i]
            state[896 + i] = ended if ended > zero else vignetted

    @njit(**OPTIONS)
    def trace(job, lanes):  # noqa: ANN001, ANN202
        """Trace the loaded block, keeping all states; the number of rays that pass.

        In the last state, row 7 is zero for those.  A vignetted ray need not go on: no Newton
        iteration waits for it.
        """
        stack, work = at(job[15]), at(job[17])
        for k in range(job[8]):
            now, then = shifted(stack, 1280 * k), shifted(stack, 1280 * (k + 1))
            kind = carray(shifted(int64_at(job[9]), 24 * k), 24)[0]
            if kind >= 3 and kind <= 5:
                end_vignetted(now)
            step(job, k, lanes, now, then, then, work)
        end_vignetted(shifted(stack, 1280 * job[8]))
        ended = carray(shifted(stack, 1280 * job[8] + 896), 128)
        passed = 0
        for i in range(128):
            passed += 1 if ended[i] == zero else 0
        return passed

    @njit(**OPTIONS)
    def begin(job, start, count, lanes):  # noqa: ANN001, ANN202
        """Load and trace rays `start` to `start + count`; how many pass, of 128."""
        load(job, start, count, at(job[15]), lanes)
        return trace(job, lanes)

    @njit(**OPTIONS)
    def set_row(target_, source_, ended_, weight):  # noqa: ANN001, ANN202
        target, source, ended = carray(target_, 128), carray(source_, 128), carray(ended_, 128)
        for i in range(128):
            target[i] = weight * source[i] if ended[i] == zero else zero

    @njit(**OPTIONS)
    def add_row(target_, source_, ended_, weight):  # noqa: ANN001, ANN202
        target, source, ended = carray(target_, 128), carray(source_, 128), carray(ended_, 128)
        for i in range(128):
            target[i] += weight * source[i] if ended[i] == zero else zero

    @njit(**OPTIONS)
    def put_entries(job, k, cotangents, columns, stride):  # noqa: ANN001, ANN202
        """Put what step k gives into columns; what comes first to a column overwrites it.

        Entries are taken last first.  After the last step's come columns that begin as zero.
        """
        table = carray(int64_at(job[44]), 1 << 40)
        rows, places = carray(int64_at(job[45]), 1 << 40), carray(int64_at(job[46]), 1 << 40)
        weights = carray(real64_at(job[47]), 1 << 40)
        is_first = carray(int64_at(job[62]), 1 << 40)
        ended = shifted(at(job[15]), 1280 * job[8] + 896)
        for e in range(table[k + 1] - 1, table[k] - 1, -1):
            target = shifted(columns, stride * places[e])
            source = shifted(cotangents, 128 * rows[e])
            if is_first[e] != 0:
                set_row(target, source, ended, real(weights[e]))
            else:
                add_row(target, source, ended, real(weights[e]))

    @njit(**OPTIONS)
    def add_stencil(job, codes, cotangents, columns, stride):  # noqa: ANN001, ANN202
        """Add the coefficients of a spline: each ray has sixteen of them."""
        begins = codes[1] + codes[2] - codes[8] * codes[9]
        column = carray(shifted(int64_at(job[48]), begins), 1 << 40)
        target = carray(columns, 1 << 40)
        place = carray(shifted(cotangents, 7168), 128)
        ended = carray(shifted(at(job[15]), 1280 * job[8] + 896), 128)
        for j in range(4):
            for m in range(4):
                lane = carray(shifted(cotangents, 5120 + 128 * (4 * j + m)), 128)
                for i in range(128):
                    if ended[i] == zero:
                        c = column[types.int64(place[i]) + j * codes[9] + m]
                        if c >= 0:
                            target[stride * c + i] += lane[i]

    @njit(**OPTIONS)
    def differentiate(job, lanes, columns, stride):  # noqa: ANN001, ANN202
        """Sweep the traced block back, once for each output, and fill its columns.

        Columns are `stride` numbers apart, those of an output after those of the one before.
        Derivatives of rays that do not pass are zero.
        """
        outputs, length, span = job[40], job[51], stride * job[42]
        seeds = carray(int64_at(job[41]), 1 << 40)
        work = at(job[17])
        for output in range(outputs):
            cot = carray(shifted(at(job[16]), output * length), 1 << 40)
            for i in range(896):
                cot[i] = zero
            put_entries(job, job[8], at(job[16]), shifted(columns, span * output), stride)
            for i in range(128):
                cot[128 * seeds[output] + i] = one
        for k in range(job[8] - 1, job[43] - 1, -1):
            place = shifted(int64_at(job[9]), 24 * k)
            codes = carray(place, 24)
            now, then = shifted(at(job[15]), 1280 * k), shifted(at(job[15]), 1280 * (k + 1))
            record = shifted(at(job[10]), codes[1])
            set_indices(job, codes, lanes, work)
            for output in range(outputs):
                cotangents = shifted(at(job[16]), output * length)
                target = shifted(columns, span * output)
                call_block(codes[17], now, then, cotangents, record, work, place)
                put_entries(job, k, cotangents, target, stride)
                if codes[0] == 5 and job[48] != 0:
                    add_stencil(job, codes, cotangents, target, stride)

    @njit(**OPTIONS)
    def wait(job, lanes, count, waiting):  # noqa: ANN001, ANN202
        """Put the block's rays that pass behind those that wait; the number that then do."""
        last = carray(shifted(at(job[15]), 1280 * job[8]), 1280)
        pending = carray(int64_at(job[50]), 256)
        for i in range(count):
            if last[896 + i] == zero:
                pending[waiting] = lanes[i]
                waiting += 1
        return waiting

    @njit(**OPTIONS)
    def resume(job, lanes, waiting):  # noqa: ANN001, ANN202
        """Trace up to 128 of the rays that wait; their number."""
        pending = carray(int64_at(job[50]), 256)
        count = min(waiting, 128)
        for i in range(128):
            lanes[i] = pending[min(i, count - 1)]
        for i in range(count, waiting):
            pending[i - count] = pending[i]
        load_lanes(job, lanes)
        trace(job, lanes)
        return count

    return Columns(begin, trace, differentiate, wait, resume)


def jacobian_driver(real: types.Type) -> Callable[..., None]:
    """Write outputs, validity and derivatives of chunks `first` to `last`; zeros where invalid."""
    at = real_at(real)
    begin, _, differentiate, wait, resume = columns(real)
    zero = real(0.0)

    @njit(**OPTIONS)
    def store_outputs(job, start, count):  # noqa: ANN001, ANN202
        """Outputs and validity of rays that follow each other."""
        last = shifted(at(job[15]), 1280 * job[8])
        ended = carray(shifted(last, 896), 128)
        valid = carray(shifted(int8_at(job[52]), start), 128)
        seeds = carray(int64_at(job[41]), 1 << 40)
        for i in range(count):
            valid[i] = 1 if ended[i] == zero else 0
        for output in range(job[40]):
            value = carray(shifted(last, 128 * seeds[output]), 128)
            out = carray(shifted(at(job[53]), output * job[7] + start), 128)
            for i in range(count):
                out[i] = value[i] if ended[i] == zero else zero

    @njit(**OPTIONS)
    def store(job, lanes, count):  # noqa: ANN001, ANN202
        """Copy the columns of the first `count` lanes to their rays' places."""
        for row in range(job[40] * job[42]):
            value = carray(shifted(at(job[49]), 128 * row), 128)
            out = carray(shifted(at(job[54]), row * job[7]), 1 << 40)
            for i in range(count):
                out[lanes[i]] = value[i]

    @njit(**OPTIONS)
    def clear(job, start, count):  # noqa: ANN001, ANN202
        for row in range(job[40] * job[42]):
            out = carray(shifted(at(job[54]), row * job[7] + start), 128)
            for i in range(count):
                out[i] = zero

    def kernel(job_, first, last):  # noqa: ANN001, ANN202
        job = carray(job_, 64)
        lanes = carray(int64_at(job[38]), 128)
        for chunk in range(first, last):
            start, end = chunk * job[36], min((chunk + 1) * job[36], job[7])
            waiting = 0
            while start < end or waiting > 0:
                if start < end:
                    count = min(128, end - start)
                    passed = begin(job, start, count, lanes)
                    store_outputs(job, start, count)
                    # Tracing some rays again costs about as much as sweeping back dead lanes.
                    if passed >= 72 and count == 128:
                        differentiate(job, lanes, shifted(at(job[54]), start), job[7])
                    else:
                        clear(job, start, count)
                        waiting = wait(job, lanes, count, waiting)
                    start += 128
                if waiting >= 128 or (waiting > 0 and start >= end):
                    count = resume(job, lanes, waiting)
                    differentiate(job, lanes, at(job[49]), 128)
                    store(job, lanes, count)
                    waiting -= count

    return kernel
