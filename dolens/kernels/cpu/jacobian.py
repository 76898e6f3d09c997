"""The driver of Jacobians gives the derivatives of every ray's outputs with respect to the
variables.

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

from dolens.kernels.cpu import jobs
from dolens.kernels.cpu.adjoint import sweeps
from dolens.kernels.cpu.compiler import (
    OPTIONS,
    call_block,
    int8_at,
    int32_at,
    int64_at,
    real64_at,
    shifted,
)
from dolens.kernels.cpu.forward import real_at, streams
from dolens.kernels.cpu.layout import (
    ADJOINT,
    BEFORE,
    BLOCK,
    CODE_ROW,
    COLUMNS,
    COUNT,
    ENDED,
    LENGTH,
    OF_FRONT,
    OF_SHAPE,
    OFFSET,
    SAG_AND_SLOPES,
    STATE,
    STENCIL,
    STENCIL_PLACE,
    UNBOUNDED,
    VIGNETTED,
)

# Rays of a block that must pass for it to be swept as it is: tracing some rays again costs about as
# much as sweeping back dead lanes.
ENOUGH = 72


class Columns(NamedTuple):
    """These compiled functions are shared by the drivers of Jacobians."""

    begin: Any
    trace: Any
    differentiate: Any
    wait: Any
    resume: Any


@cache
def columns(real: types.Type) -> Columns:
    """Compile functions that trace a block and fill its columns with derivatives, for one real
    type.
    """
    at = real_at(real)
    _, load, set_indices, step, _ = streams(real)
    load_lanes, *_ = sweeps(real)
    zero, one = real(0.0), real(1.0)

    @njit(**OPTIONS)
    def end_vignetted(state_):  # noqa: ANN001, ANN202
        state = carray(state_, STATE)
        for i in range(BLOCK):
            ended, vignetted = state[ENDED + i], state[VIGNETTED + i]
            state[ENDED + i] = ended if ended > zero else vignetted

    @njit(**OPTIONS)
    def trace(job, lanes):  # noqa: ANN001, ANN202
        """Trace the loaded block, keeping all states; return the number of rays that pass.

        In the last state, row 7 is zero for those.  A vignetted ray need not go on: no Newton
        iteration waits for it.
        """
        stack, work = at(job[jobs.STACK]), at(job[jobs.WORK])
        for k in range(job[jobs.STEPS]):
            now, then = shifted(stack, STATE * k), shifted(stack, STATE * (k + 1))
            codes = carray(shifted(int64_at(job[jobs.CODES]), CODE_ROW * k), CODE_ROW)
            if codes[SAG_AND_SLOPES] != 0:
                end_vignetted(now)
            step(job, k, lanes, now, then, then, work)
        end_vignetted(shifted(stack, STATE * job[jobs.STEPS]))
        ended = carray(shifted(stack, STATE * job[jobs.STEPS] + ENDED), BLOCK)
        passed = 0
        for i in range(BLOCK):
            passed += 1 if ended[i] == zero else 0
        return passed

    @njit(**OPTIONS)
    def begin(job, start, count, lanes):  # noqa: ANN001, ANN202
        """Load and trace rays `start` to `start + count`; return how many of a whole block pass."""
        load(job, start, count, at(job[jobs.STACK]), lanes)
        return trace(job, lanes)

    @njit(**OPTIONS)
    def set_row(target_, source_, ended_, weight):  # noqa: ANN001, ANN202
        target, source = carray(target_, BLOCK), carray(source_, BLOCK)
        ended = carray(ended_, BLOCK)
        for i in range(BLOCK):
            target[i] = weight * source[i] if ended[i] == zero else zero

    @njit(**OPTIONS)
    def add_row(target_, source_, ended_, weight):  # noqa: ANN001, ANN202
        target, source = carray(target_, BLOCK), carray(source_, BLOCK)
        ended = carray(ended_, BLOCK)
        for i in range(BLOCK):
            target[i] += weight * source[i] if ended[i] == zero else zero

    @njit(**OPTIONS)
    def put_entries(job, k, cotangents, columns, stride):  # noqa: ANN001, ANN202
        """Put the derivatives of step k into columns; the first that comes to a column overwrites
        it.

        Entries are taken last first.  After the last step's come columns that begin as zero.
        """
        table = carray(int64_at(job[jobs.ENTRIES]), UNBOUNDED)
        rows = carray(int64_at(job[jobs.ENTRY_ROWS]), UNBOUNDED)
        places = carray(int64_at(job[jobs.ENTRY_COLUMNS]), UNBOUNDED)
        weights = carray(real64_at(job[jobs.ENTRY_WEIGHTS]), UNBOUNDED)
        is_first = carray(int64_at(job[jobs.ENTRY_FIRST]), UNBOUNDED)
        ended = shifted(at(job[jobs.STACK]), STATE * job[jobs.STEPS] + ENDED)
        for e in range(table[k + 1] - 1, table[k] - 1, -1):
            target = shifted(columns, stride * places[e])
            source = shifted(cotangents, BLOCK * rows[e])
            if is_first[e] != 0:
                set_row(target, source, ended, real(weights[e]))
            else:
                add_row(target, source, ended, real(weights[e]))

    @njit(**OPTIONS)
    def put_index_entries(job, codes, lanes, cotangents, columns, stride):  # noqa: ANN001, ANN202
        """Add the derivatives of a step with respect to what the indices around it depend on."""
        rows = carray(int64_at(job[jobs.INDEX_ROWS]), UNBOUNDED)
        places = carray(int64_at(job[jobs.INDEX_COLUMNS]), UNBOUNDED)
        which = carray(int32_at(job[jobs.WHICH]), UNBOUNDED)
        count = job[jobs.WAVELENGTHS]
        ended = shifted(at(job[jobs.STACK]), STATE * job[jobs.STEPS] + ENDED)
        failed = carray(ended, BLOCK)
        for e in range(job[jobs.INDEX_ENTRIES]):
            weights = carray(shifted(real64_at(job[jobs.INDEX_WEIGHTS]), e * count), UNBOUNDED)
            target = shifted(columns, stride * places[e])
            for side in range(2):
                if rows[e] != codes[BEFORE + side]:
                    continue
                source = shifted(cotangents, OF_FRONT + BLOCK * side)
                if job[jobs.WAVELENGTH] > 0:
                    add_row(target, source, ended, real(weights[job[jobs.WAVELENGTH] - 1]))
                else:
                    out, lane = carray(target, BLOCK), carray(source, BLOCK)
                    for i in range(BLOCK):
                        if failed[i] == zero:
                            out[i] += real(weights[which[lanes[i]]]) * lane[i]

    @njit(**OPTIONS)
    def add_stencil(job, codes, cotangents, columns, stride):  # noqa: ANN001, ANN202
        """Add the coefficients of a spline: each ray has sixteen of them."""
        begins = codes[OFFSET] + codes[LENGTH] - codes[COUNT] * codes[COLUMNS]
        column = carray(shifted(int64_at(job[jobs.SPLINE_COLUMNS]), begins), UNBOUNDED)
        target = carray(columns, UNBOUNDED)
        place = carray(shifted(cotangents, STENCIL_PLACE), BLOCK)
        ended = carray(shifted(at(job[jobs.STACK]), STATE * job[jobs.STEPS] + ENDED), BLOCK)
        for j in range(4):
            for m in range(4):
                lane = carray(shifted(cotangents, OF_SHAPE + BLOCK * (4 * j + m)), BLOCK)
                for i in range(BLOCK):
                    if ended[i] == zero:
                        c = column[types.int64(place[i]) + j * codes[COLUMNS] + m]
                        if c >= 0:
                            target[stride * c + i] += lane[i]

    @njit(**OPTIONS)
    def differentiate(job, lanes, columns, stride):  # noqa: ANN001, ANN202
        """Sweep the traced block back, once for each output, and fill its columns.

        Columns are `stride` numbers apart, those of an output after those of the one before.
        Derivatives of rays that do not pass are zero.
        """
        outputs, length = job[jobs.OUTPUTS], job[jobs.COTANGENT_LENGTH]
        span = stride * job[jobs.VARIABLES]
        seeds = carray(int64_at(job[jobs.OUTPUT_ROWS]), UNBOUNDED)
        work = at(job[jobs.WORK])
        for output in range(outputs):
            cot = carray(shifted(at(job[jobs.COTANGENTS]), output * length), UNBOUNDED)
            for i in range(OF_FRONT):
                cot[i] = zero
            put_entries(
                job,
                job[jobs.STEPS],
                at(job[jobs.COTANGENTS]),
                shifted(columns, span * output),
                stride,
            )
            for i in range(BLOCK):
                cot[BLOCK * seeds[output] + i] = one
        for k in range(job[jobs.STEPS] - 1, job[jobs.FIRST_STEP] - 1, -1):
            place = shifted(int64_at(job[jobs.CODES]), CODE_ROW * k)
            codes = carray(place, CODE_ROW)
            now = shifted(at(job[jobs.STACK]), STATE * k)
            then = shifted(at(job[jobs.STACK]), STATE * (k + 1))
            record = shifted(at(job[jobs.VALUES]), codes[OFFSET])
            set_indices(job, codes, lanes, work)
            for output in range(outputs):
                cotangents = shifted(at(job[jobs.COTANGENTS]), output * length)
                target = shifted(columns, span * output)
                call_block(codes[ADJOINT], now, then, cotangents, record, work, place)
                put_entries(job, k, cotangents, target, stride)
                if job[jobs.INDEX_ENTRIES] != 0:
                    put_index_entries(job, codes, lanes, cotangents, target, stride)
                if codes[STENCIL] != 0 and job[jobs.SPLINE_COLUMNS] != 0:
                    add_stencil(job, codes, cotangents, target, stride)

    @njit(**OPTIONS)
    def wait(job, lanes, count, waiting):  # noqa: ANN001, ANN202
        """Put the block's rays that pass behind those that wait; return the number that then do."""
        last = carray(shifted(at(job[jobs.STACK]), STATE * job[jobs.STEPS]), STATE)
        pending = carray(int64_at(job[jobs.PENDING]), 2 * BLOCK)
        for i in range(count):
            if last[ENDED + i] == zero:
                pending[waiting] = lanes[i]
                waiting += 1
        return waiting

    @njit(**OPTIONS)
    def resume(job, lanes, waiting):  # noqa: ANN001, ANN202
        """Trace rays that wait, a block at most; return their number."""
        pending = carray(int64_at(job[jobs.PENDING]), 2 * BLOCK)
        count = min(waiting, BLOCK)
        for i in range(BLOCK):
            lanes[i] = pending[min(i, count - 1)]
        for i in range(count, waiting):
            pending[i - count] = pending[i]
        load_lanes(job, lanes)
        trace(job, lanes)
        return count

    return Columns(begin, trace, differentiate, wait, resume)


def jacobian_driver(real: types.Type) -> Callable[..., None]:
    """Compile the driver that writes outputs, validity and derivatives of chunks `first` to `last`;
    zeros where invalid.
    """
    at = real_at(real)
    begin, _, differentiate, wait, resume = columns(real)
    zero = real(0.0)

    @njit(**OPTIONS)
    def store_outputs(job, start, count):  # noqa: ANN001, ANN202
        """Store outputs and validity of rays that follow each other."""
        last = shifted(at(job[jobs.STACK]), STATE * job[jobs.STEPS])
        ended = carray(shifted(last, ENDED), BLOCK)
        valid = carray(shifted(int8_at(job[jobs.OUT_VALID]), start), BLOCK)
        seeds = carray(int64_at(job[jobs.OUTPUT_ROWS]), UNBOUNDED)
        for i in range(count):
            valid[i] = 1 if ended[i] == zero else 0
        for output in range(job[jobs.OUTPUTS]):
            value = carray(shifted(last, BLOCK * seeds[output]), BLOCK)
            out = carray(shifted(at(job[jobs.OUT_VALUES]), output * job[jobs.RAYS] + start), BLOCK)
            for i in range(count):
                out[i] = value[i] if ended[i] == zero else zero

    @njit(**OPTIONS)
    def store(job, lanes, count):  # noqa: ANN001, ANN202
        """Copy the columns of the first `count` lanes to their rays' places."""
        for row in range(job[jobs.OUTPUTS] * job[jobs.VARIABLES]):
            value = carray(shifted(at(job[jobs.DRIVER_ROWS]), BLOCK * row), BLOCK)
            out = carray(shifted(at(job[jobs.OUT_JACOBIAN]), row * job[jobs.RAYS]), UNBOUNDED)
            for i in range(count):
                out[lanes[i]] = value[i]

    @njit(**OPTIONS)
    def clear(job, start, count):  # noqa: ANN001, ANN202
        for row in range(job[jobs.OUTPUTS] * job[jobs.VARIABLES]):
            out = carray(shifted(at(job[jobs.OUT_JACOBIAN]), row * job[jobs.RAYS] + start), BLOCK)
            for i in range(count):
                out[i] = zero

    def kernel(job_, first, last):  # noqa: ANN001, ANN202
        job = carray(job_, jobs.LENGTH)
        lanes = carray(int64_at(job[jobs.LANES]), BLOCK)
        for chunk in range(first, last):
            start, end = chunk * job[jobs.CHUNK], min((chunk + 1) * job[jobs.CHUNK], job[jobs.RAYS])
            waiting = 0
            while start < end or waiting > 0:
                if start < end:
                    count = min(BLOCK, end - start)
                    passed = begin(job, start, count, lanes)
                    store_outputs(job, start, count)
                    if passed >= ENOUGH and count == BLOCK:
                        differentiate(
                            job, lanes, shifted(at(job[jobs.OUT_JACOBIAN]), start), job[jobs.RAYS]
                        )
                    else:
                        clear(job, start, count)
                        waiting = wait(job, lanes, count, waiting)
                    start += BLOCK
                if waiting >= BLOCK or (waiting > 0 and start >= end):
                    count = resume(job, lanes, waiting)
                    differentiate(job, lanes, at(job[jobs.DRIVER_ROWS]), BLOCK)
                    store(job, lanes, count)
                    waiting -= count

    return kernel
