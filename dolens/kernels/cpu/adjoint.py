"""Driver of the backward pass: each block is traced again, keeping its states, and swept back.

Only valid rays take part: a block is filled with the next 128 of them, so that rays which fail cost
nothing and cannot spoil a sum.  Sums are kept for every chunk of rays, in double precision, and the
chunks do not depend on the number of threads: neither does the result.
"""

from collections.abc import Callable
from functools import cache
from typing import Any, NamedTuple

from numba import carray, njit, types

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


class Sweeps(NamedTuple):
    """Compiled functions that the drivers of derivatives share."""

    load_lanes: Any
    gather: Any
    forward: Any
    back: Any
    add_sums: Any


@cache
def sweeps(real: types.Type) -> Sweeps:
    """Functions that fill a block with valid rays, trace it, and sweep back, for one real type."""
    at = real_at(real)
    zero = real(0.0)
    find_wavelength, load, set_indices, step = streams(real)

    @njit(**OPTIONS)
    def load_lanes(job, lanes):  # noqa: ANN001, ANN202
        """Load the rays of these numbers into the first state."""
        find_wavelength(job, lanes)
        state = carray(at(job[15]), 1280)
        for k in range(3):
            source = carray(shifted(at(job[0]), k * job[2]), 1 << 40)
            for i in range(128):
                state[128 * k + i] = source[lanes[i] * job[1]]
            source = carray(shifted(at(job[3]), k * job[5]), 1 << 40)
            for i in range(128):
                state[384 + 128 * k + i] = source[lanes[i] * job[4]]
        for i in range(128):
            state[768 + i], state[896 + i], state[1024 + i] = zero, zero, zero

    @njit(**OPTIONS)
    def gather(job, ray, end, lanes):  # noqa: ANN001, ANN202
        """Load the next valid rays from `ray` on; their number, and where to go on."""
        status = carray(int8_at(job[21]), 1 << 40)
        count = 0
        while ray < end and count < 128:
            if status[ray] == 0:
                lanes[count] = ray
                count += 1
            ray += 1
        for i in range(max(count, 1), 128):
            lanes[i] = lanes[0]
        if count == 128 and lanes[127] - lanes[0] == 127:
            load(job, lanes[0], 128, at(job[15]), lanes)
        elif count > 0:
            load_lanes(job, lanes)
        return count, ray

    @njit(**OPTIONS)
    def forward(job, lanes):  # noqa: ANN001, ANN202
        """Trace the block, keeping the state behind every step."""
        stack, work = at(job[15]), at(job[17])
        for k in range(job[8]):
            now, then = shifted(stack, 1280 * k), shifted(stack, 1280 * (k + 1))
            step(job, k, lanes, now, then, then, work)

    @njit(**OPTIONS)
    def back(job, k, lanes):  # noqa: ANN001, ANN202
        """Sweep the cotangents back through step k."""
        place = shifted(int64_at(job[9]), 24 * k)
        codes = carray(place, 24)
        work = at(job[17])
        now, then = shifted(at(job[15]), 1280 * k), shifted(at(job[15]), 1280 * (k + 1))
        set_indices(job, codes, lanes, work)
        record = shifted(at(job[10]), codes[1])
        call_block(codes[17], now, then, at(job[16]), record, work, place)

    @njit(**OPTIONS)
    def add_row(cotangents, row, sums, place):  # noqa: ANN001, ANN202
        lane = carray(shifted(cotangents, 128 * row), 128)
        total = zero
        for i in range(128):
            total += lane[i]
        sums[place] += types.float64(total)

    @njit(**OPTIONS)
    def add_sums(job, k, lanes, sums):  # noqa: ANN001, ANN202
        """Add the cotangents of step k, summed over the block, to a chunk's sums."""
        codes = carray(shifted(int64_at(job[9]), 24 * k), 24)
        cotangents = at(job[16])
        kind, offset, length = codes[0], codes[1], codes[2]
        moved = 12 if kind == 6 or kind == 7 else 1
        for j in range(moved):
            add_row(cotangents, 16 + j, sums, offset + j)
        if kind == 5:
            first = offset + length - codes[8] * codes[9]
            place = carray(shifted(cotangents, 7168), 128)
            for j in range(4):
                for i in range(128):
                    for m in range(4):
                        lane = carray(shifted(cotangents, 5120 + 128 * (4 * j + m)), 128)
                        to = first + types.int64(place[i]) + j * codes[9] + m
                        sums[to] += types.float64(lane[i])
        else:
            for j in range(24, length):
                add_row(cotangents, 16 + j, sums, offset + j)
        if job[39] == 0:
            return
        count, values = job[12], job[37]
        for side in range(2):
            row = values + codes[3 + side] * count
            if count == 1:
                add_row(cotangents, 7 + side, sums, row)
            elif job[63] > 0:
                add_row(cotangents, 7 + side, sums, row + job[63] - 1)
            else:
                which = carray(int32_at(job[6]), 1 << 40)
                lane = carray(shifted(cotangents, 896 + 128 * side), 128)
                for i in range(128):
                    sums[row + which[lanes[i]]] += types.float64(lane[i])

    return Sweeps(load_lanes, gather, forward, back, add_sums)


def adjoint_driver(real: types.Type) -> Callable[..., None]:
    """Sweep chunks `first` to `last` back: gradients of the rays, and sums for each chunk."""
    at = real_at(real)
    _, gather, forward, back, add_sums = sweeps(real)
    zero = real(0.0)

    @njit(**OPTIONS)
    def load_cotangents(job, lanes, count, cot):  # noqa: ANN001, ANN202
        for i in range(128 * 7):
            cot[i] = zero
        for k in range(3):
            if job[24] != 0:
                source = carray(shifted(at(job[24]), k * job[26]), 1 << 40)
                for i in range(count):
                    cot[128 * k + i] = source[lanes[i] * job[25]]
            if job[27] != 0:
                source = carray(shifted(at(job[27]), k * job[29]), 1 << 40)
                for i in range(count):
                    cot[384 + 128 * k + i] = source[lanes[i] * job[28]]
        if job[30] != 0:
            source = carray(at(job[30]), 1 << 40)
            for i in range(count):
                cot[768 + i] = source[lanes[i] * job[31]]

    @njit(**OPTIONS)
    def store(address, lanes, count, cot, row):  # noqa: ANN001, ANN202
        out = carray(at(address), 1 << 40)
        for i in range(count):
            place = 3 * lanes[i]
            out[place] = cot[128 * row + i]
            out[place + 1] = cot[128 * (row + 1) + i]
            out[place + 2] = cot[128 * (row + 2) + i]

    def kernel(job_, first, last):  # noqa: ANN001, ANN202
        job = carray(job_, 64)
        lanes = carray(int64_at(job[38]), 128)
        cot = carray(at(job[16]), 1 << 40)
        for chunk in range(first, last):
            sums = carray(shifted(real64_at(job[34]), chunk * job[35]), 1 << 40)
            ray, end = chunk * job[36], min((chunk + 1) * job[36], job[7])
            while ray < end:
                count, ray = gather(job, ray, end, lanes)
                if count == 0:
                    break
                forward(job, lanes)
                load_cotangents(job, lanes, count, cot)
                total = types.float64(0.0)
                for i in range(count):
                    total += types.float64(cot[256 + i])
                sums[job[37] - 1] += total
                for k in range(job[8] - 1, -1, -1):
                    back(job, k, lanes)
                    add_sums(job, k, lanes, sums)
                if job[32] != 0:
                    store(job[32], lanes, count, cot, 0)
                if job[33] != 0:
                    store(job[33], lanes, count, cot, 3)

    return kernel
