"""The backward driver traces each block again, keeps its states, and sweeps cotangents back.

Only valid rays take part: a block is filled with the next of them, so that rays which fail cost
nothing and cannot spoil a sum.  Sums are kept for every chunk of rays, in double precision, and the
chunks do not depend on the number of threads: neither does the result.
"""

from collections.abc import Callable
from functools import cache
from typing import Any, NamedTuple

from numba import carray, njit, types

from dolens.kernels.cpu import jobs
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
    CHANGE_AXES,
    CODE_ROW,
    COLUMNS,
    COUNT,
    ENDED,
    KIND,
    LENGTH,
    LENS_AXES,
    OF_FRONT,
    OF_RECORD,
    OF_SHAPE,
    OFFSET,
    PATH,
    POSE,
    SHAPE,
    STATE,
    STENCIL,
    STENCIL_PLACE,
    UNBOUNDED,
    VIGNETTED,
    L,
    X,
    Z,
)


class Sweeps(NamedTuple):
    """These compiled functions are shared by the drivers of derivatives."""

    load_lanes: Any
    gather: Any
    forward: Any
    back: Any
    add_sums: Any
    load_cotangents: Any
    store: Any


@cache
def sweeps(real: types.Type) -> Sweeps:
    """Compile functions that fill a block with valid rays, trace it, and sweep back, for one real
    type.
    """
    at = real_at(real)
    zero = real(0.0)
    find_wavelength, load, set_indices, step, _ = streams(real)

    @njit(**OPTIONS)
    def load_lanes(job, lanes):  # noqa: ANN001, ANN202
        """Load the rays of these numbers into the first state."""
        find_wavelength(job, lanes)
        state = carray(at(job[jobs.STACK]), STATE)
        for k in range(3):
            source = carray(
                shifted(at(job[jobs.POSITION]), k * job[jobs.POSITION_COLUMN]), UNBOUNDED
            )
            for i in range(BLOCK):
                state[X + BLOCK * k + i] = source[lanes[i] * job[jobs.POSITION_ROW]]
            source = carray(
                shifted(at(job[jobs.DIRECTION]), k * job[jobs.DIRECTION_COLUMN]), UNBOUNDED
            )
            for i in range(BLOCK):
                state[L + BLOCK * k + i] = source[lanes[i] * job[jobs.DIRECTION_ROW]]
        for i in range(BLOCK):
            state[PATH + i], state[ENDED + i], state[VIGNETTED + i] = zero, zero, zero

    @njit(**OPTIONS)
    def gather(job, ray, end, lanes):  # noqa: ANN001, ANN202
        """Load the next valid rays from `ray` on; return their number, and the ray behind them."""
        status = carray(int8_at(job[jobs.OUT_STATUS]), UNBOUNDED)
        count = 0
        while ray < end and count < BLOCK:
            if status[ray] == 0:
                lanes[count] = ray
                count += 1
            ray += 1
        for i in range(max(count, 1), BLOCK):
            lanes[i] = lanes[0]
        if count == BLOCK and lanes[BLOCK - 1] - lanes[0] == BLOCK - 1:
            load(job, lanes[0], BLOCK, at(job[jobs.STACK]), lanes)
        elif count > 0:
            load_lanes(job, lanes)
        return count, ray

    @njit(**OPTIONS)
    def forward(job, lanes):  # noqa: ANN001, ANN202
        """Trace the block, keeping the state behind every step."""
        stack, work = at(job[jobs.STACK]), at(job[jobs.WORK])
        for k in range(job[jobs.STEPS]):
            now, then = shifted(stack, STATE * k), shifted(stack, STATE * (k + 1))
            step(job, k, lanes, now, then, then, work)

    @njit(**OPTIONS)
    def back(job, k, lanes):  # noqa: ANN001, ANN202
        """Sweep the cotangents back through step k."""
        place = shifted(int64_at(job[jobs.CODES]), CODE_ROW * k)
        codes = carray(place, CODE_ROW)
        work = at(job[jobs.WORK])
        now = shifted(at(job[jobs.STACK]), STATE * k)
        then = shifted(at(job[jobs.STACK]), STATE * (k + 1))
        set_indices(job, codes, lanes, work)
        record = shifted(at(job[jobs.VALUES]), codes[OFFSET])
        call_block(codes[ADJOINT], now, then, at(job[jobs.COTANGENTS]), record, work, place)

    @njit(**OPTIONS)
    def add_row(cotangents, row, sums, place):  # noqa: ANN001, ANN202
        lane = carray(shifted(cotangents, row), BLOCK)
        total = zero
        for i in range(BLOCK):
            total += lane[i]
        sums[place] += types.float64(total)

    @njit(**OPTIONS)
    def add_sums(job, k, lanes, sums):  # noqa: ANN001, ANN202
        """Add the cotangents of step k, summed over the block, to a chunk's sums."""
        codes = carray(shifted(int64_at(job[jobs.CODES]), CODE_ROW * k), CODE_ROW)
        cotangents = at(job[jobs.COTANGENTS])
        kind, offset, length = codes[KIND], codes[OFFSET], codes[LENGTH]
        moved = POSE if kind in (CHANGE_AXES, LENS_AXES) else 1
        for j in range(moved):
            add_row(cotangents, OF_RECORD + BLOCK * j, sums, offset + j)
        if codes[STENCIL] != 0:
            first = offset + length - codes[COUNT] * codes[COLUMNS]
            place = carray(shifted(cotangents, STENCIL_PLACE), BLOCK)
            for j in range(4):
                for i in range(BLOCK):
                    for m in range(4):
                        lane = carray(shifted(cotangents, OF_SHAPE + BLOCK * (4 * j + m)), BLOCK)
                        to = first + types.int64(place[i]) + j * codes[COLUMNS] + m
                        sums[to] += types.float64(lane[i])
        else:
            for j in range(SHAPE, length):
                add_row(cotangents, OF_RECORD + BLOCK * j, sums, offset + j)
        if job[jobs.INDEX_SUMS] == 0:
            return
        count, values = job[jobs.WAVELENGTHS], job[jobs.VALUES_LENGTH]
        for side in range(2):
            row = values + codes[BEFORE + side] * count
            if count == 1:
                add_row(cotangents, OF_FRONT + BLOCK * side, sums, row)
            elif job[jobs.WAVELENGTH] > 0:
                add_row(cotangents, OF_FRONT + BLOCK * side, sums, row + job[jobs.WAVELENGTH] - 1)
            else:
                which = carray(int32_at(job[jobs.WHICH]), UNBOUNDED)
                lane = carray(shifted(cotangents, OF_FRONT + BLOCK * side), BLOCK)
                for i in range(BLOCK):
                    sums[row + which[lanes[i]]] += types.float64(lane[i])

    @njit(**OPTIONS)
    def load_cotangents(job, lanes, count, cot):  # noqa: ANN001, ANN202
        for i in range(OF_FRONT):
            cot[i] = zero
        for k in range(3):
            if job[jobs.POSITION_COTANGENT] != 0:
                first = shifted(
                    at(job[jobs.POSITION_COTANGENT]), k * job[jobs.POSITION_COTANGENT_COLUMN]
                )
                source = carray(first, UNBOUNDED)
                for i in range(count):
                    cot[X + BLOCK * k + i] = source[lanes[i] * job[jobs.POSITION_COTANGENT_ROW]]
            if job[jobs.DIRECTION_COTANGENT] != 0:
                first = shifted(
                    at(job[jobs.DIRECTION_COTANGENT]), k * job[jobs.DIRECTION_COTANGENT_COLUMN]
                )
                source = carray(first, UNBOUNDED)
                for i in range(count):
                    cot[L + BLOCK * k + i] = source[lanes[i] * job[jobs.DIRECTION_COTANGENT_ROW]]
        if job[jobs.PATH_COTANGENT] != 0:
            source = carray(at(job[jobs.PATH_COTANGENT]), UNBOUNDED)
            for i in range(count):
                cot[PATH + i] = source[lanes[i] * job[jobs.PATH_COTANGENT_ROW]]

    @njit(**OPTIONS)
    def store(address, lanes, count, cot, row):  # noqa: ANN001, ANN202
        out = carray(at(address), UNBOUNDED)
        for i in range(count):
            place = 3 * lanes[i]
            out[place] = cot[row + i]
            out[place + 1] = cot[row + BLOCK + i]
            out[place + 2] = cot[row + 2 * BLOCK + i]

    return Sweeps(load_lanes, gather, forward, back, add_sums, load_cotangents, store)


def adjoint_driver(real: types.Type, losses: Any = None) -> Callable[..., None]:
    """Compile the sweep of chunks `first` to `last`: gradients of the rays, and sums for each
    chunk.

    Args:
        real: the precision.
        losses: `PassedLight`, where the share of light that is left is asked for.
    """
    at = real_at(real)
    _, gather, forward, back, add_sums, load_cotangents, store = sweeps(real)
    lossy = losses is not None
    keep, turn_round, prepare, finish = losses[3:] if lossy else (None, None, None, None)

    def kernel(job_, first, last):  # noqa: ANN001, ANN202
        job = carray(job_, jobs.LENGTH)
        lanes = carray(int64_at(job[jobs.LANES]), BLOCK)
        cot = carray(at(job[jobs.COTANGENTS]), UNBOUNDED)
        for chunk in range(first, last):
            sums = carray(
                shifted(real64_at(job[jobs.SUMS]), chunk * job[jobs.SUM_LENGTH]), UNBOUNDED
            )
            ray, end = chunk * job[jobs.CHUNK], min((chunk + 1) * job[jobs.CHUNK], job[jobs.RAYS])
            while ray < end:
                count, ray = gather(job, ray, end, lanes)
                if count == 0:
                    break
                if lossy:
                    keep(job, lanes)
                else:
                    forward(job, lanes)
                load_cotangents(job, lanes, count, cot)
                if lossy:
                    turn_round(job, lanes, count)
                total = types.float64(0.0)
                for i in range(count):
                    total += types.float64(cot[Z + i])
                sums[job[jobs.VALUES_LENGTH] - 1] += total
                for k in range(job[jobs.STEPS] - 1, -1, -1):
                    if lossy:
                        prepare(job, k, lanes, sums)
                    back(job, k, lanes)
                    if lossy:
                        finish(job, k)
                    add_sums(job, k, lanes, sums)
                if job[jobs.POSITION_GRADIENT] != 0:
                    store(job[jobs.POSITION_GRADIENT], lanes, count, cot, X)
                if job[jobs.DIRECTION_GRADIENT] != 0:
                    store(job[jobs.DIRECTION_GRADIENT], lanes, count, cot, L)

    return kernel
