"""Driver of the forward trace: blocks of rays through all steps, in cache."""

import math
from collections.abc import Callable
from functools import cache
from typing import Any, NamedTuple

import numpy as np
from numba import carray, njit, types

from dolens.kernels.cpu import compiler
from dolens.kernels.cpu.compiler import (
    OPTIONS,
    call_block,
    int8_at,
    int16_at,
    int32_at,
    int64_at,
    real64_at,
    shifted,
)


class Streams(NamedTuple):
    """Compiled functions that drivers share."""

    find_wavelength: Any
    load: Any
    set_indices: Any
    step: Any


def real_at(real: types.Type) -> Any:
    """The intrinsic that makes an address a pointer to this type."""
    return compiler.real32_at if real is types.float32 else compiler.real64_at


@cache
def streams(real: types.Type) -> Streams:
    """Functions that load rays, fill in the indices, and run a step, for one real type."""
    at = real_at(real)
    zero = real(0.0)

    @njit(**OPTIONS)
    def find_wavelength(job, lanes):  # noqa: ANN001, ANN202
        """Note whether the rays of these numbers have one wavelength."""
        job[63] = 1
        if job[12] > 1:
            which = carray(int32_at(job[6]), 1 << 40)
            first = which[lanes[0]]
            different = 0
            for i in range(128):
                different += 1 if which[lanes[i]] != first else 0
            job[63] = 0 if different > 0 else types.int64(first) + 1

    @njit(**OPTIONS)
    def load(job, start, count, state, lanes):  # noqa: ANN001, ANN202
        """Rays `start` to `start + count` into a block; the lanes beyond repeat its first ray."""
        for i in range(128):
            lanes[i] = start + (i if i < count else 0)
        find_wavelength(job, lanes)
        out = carray(state, 1280)
        row, column = job[1], job[2]
        first = shifted(at(job[0]), start * row)
        if row == 3 and column == 1:
            packed = carray(first, 384)
            for i in range(count):
                out[i], out[128 + i], out[256 + i] = (
                    packed[3 * i],
                    packed[3 * i + 1],
                    packed[3 * i + 2],
                )
        else:
            for k in range(3):
                source = carray(shifted(first, k * column), 1 << 40)
                target = carray(shifted(state, 128 * k), 128)
                for i in range(count):
                    target[i] = source[i * row]
        row, column = job[4], job[5]
        first = shifted(at(job[3]), start * row)
        if row == 3 and column == 1:
            packed = carray(first, 384)
            for i in range(count):
                out[384 + i] = packed[3 * i]
                out[512 + i] = packed[3 * i + 1]
                out[640 + i] = packed[3 * i + 2]
        else:
            for k in range(3):
                source = carray(shifted(first, k * column), 1 << 40)
                target = carray(shifted(state, 384 + 128 * k), 128)
                for i in range(count):
                    target[i] = source[i * row]
        for i in range(128):
            out[768 + i] = zero
            out[896 + i] = zero
            out[1024 + i] = zero
        for k in range(6):
            lane = carray(shifted(state, 128 * k), 128)
            for i in range(count, 128):
                lane[i] = lane[0]

    @njit(**OPTIONS)
    def set_indices(job, codes, lanes, work):  # noqa: ANN001, ANN202
        """The index in front and the ratio of a step; `lanes` are the rays' numbers."""
        w = carray(work, 6144)
        count = job[12]
        before = carray(shifted(real64_at(job[11]), codes[3] * count), 1 << 40)
        after = carray(shifted(real64_at(job[11]), codes[4] * count), 1 << 40)
        if job[63] > 0:
            common = job[63] - 1
            index, ratio = real(before[common]), real(before[common] / after[common])
            inverse = real(types.float64(1.0) / before[common])
            for i in range(128):
                w[i] = index
                w[128 + i] = ratio
                w[3072 + i] = inverse
        else:
            which = carray(int32_at(job[6]), 1 << 40)
            for i in range(128):
                wavelength = which[lanes[i]]
                w[i] = real(before[wavelength])
                w[128 + i] = real(before[wavelength] / after[wavelength])
                w[3072 + i] = real(types.float64(1.0) / before[wavelength])

    @njit(**OPTIONS)
    def step(job, k, lanes, before, after, cotangents, work):  # noqa: ANN001, ANN202
        """Carry a block through step k."""
        place = shifted(int64_at(job[9]), 24 * k)
        codes = carray(place, 24)
        record = shifted(at(job[10]), codes[1])
        set_indices(job, codes, lanes, work)
        call_block(codes[16], before, after, cotangents, record, work, place)
        if codes[6] == 2 or codes[7] != 0:
            call_block(job[14], before, after, cotangents, record, work, place)

    return Streams(find_wavelength, load, set_indices, step)


def forward_driver(real: types.Type) -> Callable[..., None]:
    """Trace blocks `first` to `last` and write the rays behind the last step."""
    at = real_at(real)
    _, load, _, step = streams(real)
    zero = real(0.0)
    largest = real(np.finfo(str(real)).max)

    @njit(**OPTIONS)
    def finite(value):  # noqa: ANN001, ANN202
        """The number, or zero: rays that are not valid may overflow."""
        return value if math.fabs(value) <= largest else zero

    def kernel(job_, first, last):  # noqa: ANN001, ANN202
        job = carray(job_, 64)
        rays, steps = job[7], job[8]
        lanes = carray(int64_at(job[38]), 128)
        work = at(job[17])
        exit_z = carray(at(job[13]), 1)[0]
        for block in range(first, last):
            start = 128 * block
            count = min(128, rays - start)
            now, then = at(job[15]), shifted(at(job[15]), 1280)
            load(job, start, count, now, lanes)
            for k in range(steps):
                step(job, k, lanes, now, then, then, work)
                now, then = then, now
            state = carray(now, 1280)
            position = carray(shifted(at(job[18]), 3 * start), 384)
            direction = carray(shifted(at(job[19]), 3 * start), 384)
            for i in range(count):
                position[3 * i] = finite(state[i])
                position[3 * i + 1] = finite(state[128 + i])
                position[3 * i + 2] = finite(state[256 + i] + exit_z)
            for i in range(count):
                direction[3 * i] = finite(state[384 + i])
                direction[3 * i + 1] = finite(state[512 + i])
                direction[3 * i + 2] = finite(state[640 + i])
            path = carray(shifted(at(job[20]), start), 128)
            status = carray(shifted(int8_at(job[21]), start), 128)
            surface = carray(shifted(int16_at(job[22]), start), 128)
            for i in range(count):
                path[i] = finite(state[768 + i])
            for i in range(count):
                ended, vignetted = state[896 + i], state[1024 + i]
                code = types.int64(ended if ended > zero else vignetted)
                surface[i] = code >> 2
                status[i] = code & 3

    return kernel
