"""The forward driver carries blocks of rays through all steps, in cache."""

import math
from collections.abc import Callable
from functools import cache
from typing import Any, NamedTuple

import numpy as np
from numba import carray, njit, types

from dolens.kernels.cpu import compiler, jobs
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
from dolens.kernels.cpu.layout import (
    AFTER,
    BEFORE,
    BLOCK,
    CODE_ROW,
    ENDED,
    FORWARD,
    HOLE,
    INDEX,
    INVERSE_INDEX,
    OFFSET,
    OUTLINE,
    PATH,
    PER_RADIAN,
    RATIO,
    RECTANGLE,
    STATE,
    STATUS_BITS,
    STATUS_MASK,
    UNBOUNDED,
    VIGNETTED,
    WAVE,
    WORK_SIZE,
    L,
    M,
    N,
    X,
    Y,
    Z,
)
from dolens.kernels.table import FARTHEST, LONGEST


class Streams(NamedTuple):
    """These compiled functions are shared by the drivers."""

    find_wavelength: Any
    load: Any
    set_indices: Any
    step: Any
    store: Any


def real_at(real: types.Type) -> Any:
    """Return the intrinsic that makes an address a pointer to this type."""
    return compiler.real32_at if real is types.float32 else compiler.real64_at


@cache
def streams(real: types.Type) -> Streams:
    """Compile functions that load rays, fill in the indices, and run a step, for one real type."""
    at = real_at(real)
    zero, longest, farthest = real(0.0), real(LONGEST), real(FARTHEST)
    largest = real(np.finfo(str(real)).max)

    @njit(**OPTIONS)
    def find_wavelength(job, lanes):  # noqa: ANN001, ANN202
        """Note whether the rays of these numbers have one wavelength."""
        job[jobs.WAVELENGTH] = 1
        if job[jobs.WAVELENGTHS] > 1:
            which = carray(int32_at(job[jobs.WHICH]), UNBOUNDED)
            first = which[lanes[0]]
            different = 0
            for i in range(BLOCK):
                different += 1 if which[lanes[i]] != first else 0
            job[jobs.WAVELENGTH] = 0 if different > 0 else types.int64(first) + 1

    @njit(**OPTIONS)
    def stop_unphysical(state):  # noqa: ANN001, ANN202
        """Let rays that are none of light stand still at 0, as `finite_rays` does."""
        out, stopped = carray(state, STATE), 0
        for i in range(BLOCK):
            x, y, z = math.fabs(out[X + i]), math.fabs(out[Y + i]), math.fabs(out[Z + i])
            l, m, n = math.fabs(out[L + i]), math.fabs(out[M + i]), math.fabs(out[N + i])  # noqa: E741
            known = (x <= farthest) & (y <= farthest) & (z <= farthest)
            known &= (l <= longest) & (m <= longest) & (n <= longest)
            stopped += 0 if known else 1
        if stopped == 0:
            return
        for i in range(BLOCK):
            known = True
            for k in range(3):
                known &= math.fabs(out[X + BLOCK * k + i]) <= farthest
                known &= math.fabs(out[L + BLOCK * k + i]) <= longest
            for k in range(6):
                out[BLOCK * k + i] = out[BLOCK * k + i] if known else zero

    @njit(**OPTIONS)
    def load(job, start, count, state, lanes):  # noqa: ANN001, ANN202
        """Load rays `start` to `start + count` into a block; lanes beyond repeat its first ray."""
        for i in range(BLOCK):
            lanes[i] = start + (i if i < count else 0)
        find_wavelength(job, lanes)
        out = carray(state, STATE)
        row, column = job[jobs.POSITION_ROW], job[jobs.POSITION_COLUMN]
        first = shifted(at(job[jobs.POSITION]), start * row)
        if row == 3 and column == 1:
            packed = carray(first, 3 * BLOCK)
            for i in range(count):
                x, y, z = packed[3 * i], packed[3 * i + 1], packed[3 * i + 2]
                out[X + i], out[Y + i], out[Z + i] = x, y, z
        else:
            for k in range(3):
                source = carray(shifted(first, k * column), UNBOUNDED)
                target = carray(shifted(state, X + BLOCK * k), BLOCK)
                for i in range(count):
                    target[i] = source[i * row]
        row, column = job[jobs.DIRECTION_ROW], job[jobs.DIRECTION_COLUMN]
        first = shifted(at(job[jobs.DIRECTION]), start * row)
        if row == 3 and column == 1:
            packed = carray(first, 3 * BLOCK)
            for i in range(count):
                out[L + i] = packed[3 * i]
                out[M + i] = packed[3 * i + 1]
                out[N + i] = packed[3 * i + 2]
        else:
            for k in range(3):
                source = carray(shifted(first, k * column), UNBOUNDED)
                target = carray(shifted(state, L + BLOCK * k), BLOCK)
                for i in range(count):
                    target[i] = source[i * row]
        for i in range(BLOCK):
            out[PATH + i] = zero
            out[ENDED + i] = zero
            out[VIGNETTED + i] = zero
        for k in range(6):
            lane = carray(shifted(state, BLOCK * k), BLOCK)
            for i in range(count, BLOCK):
                lane[i] = lane[0]
        stop_unphysical(state)

    @njit(**OPTIONS)
    def set_indices(job, codes, lanes, work):  # noqa: ANN001, ANN202
        """Fill the rows of the index in front and of the ratio of a step; `lanes` are the rays'
        numbers.
        """
        w = carray(work, WORK_SIZE)
        count = job[jobs.WAVELENGTHS]
        before = carray(shifted(real64_at(job[jobs.INDICES]), codes[BEFORE] * count), UNBOUNDED)
        after = carray(shifted(real64_at(job[jobs.INDICES]), codes[AFTER] * count), UNBOUNDED)
        if job[jobs.WAVELENGTH] > 0:
            common = job[jobs.WAVELENGTH] - 1
            index, ratio = real(before[common]), real(before[common] / after[common])
            inverse = real(types.float64(1.0) / before[common])
            for i in range(BLOCK):
                w[INDEX + i] = index
                w[RATIO + i] = ratio
                w[INVERSE_INDEX + i] = inverse
            if codes[WAVE] != 0:
                waves = carray(
                    shifted(real64_at(job[jobs.INDICES]), codes[WAVE] * count), UNBOUNDED
                )
                for i in range(BLOCK):
                    w[PER_RADIAN + i] = real(waves[common])
        else:
            which = carray(int32_at(job[jobs.WHICH]), UNBOUNDED)
            for i in range(BLOCK):
                wavelength = which[lanes[i]]
                w[INDEX + i] = real(before[wavelength])
                w[RATIO + i] = real(before[wavelength] / after[wavelength])
                w[INVERSE_INDEX + i] = real(types.float64(1.0) / before[wavelength])
            if codes[WAVE] != 0:
                waves = carray(
                    shifted(real64_at(job[jobs.INDICES]), codes[WAVE] * count), UNBOUNDED
                )
                for i in range(BLOCK):
                    w[PER_RADIAN + i] = real(waves[which[lanes[i]]])

    @njit(**OPTIONS)
    def step(job, k, lanes, before, after, cotangents, work):  # noqa: ANN001, ANN202
        """Carry a block through step k."""
        place = shifted(int64_at(job[jobs.CODES]), CODE_ROW * k)
        codes = carray(place, CODE_ROW)
        record = shifted(at(job[jobs.VALUES]), codes[OFFSET])
        set_indices(job, codes, lanes, work)
        call_block(codes[FORWARD], before, after, cotangents, record, work, place)
        if codes[OUTLINE] >= RECTANGLE or codes[HOLE] != 0:
            call_block(job[jobs.CLIP], before, after, cotangents, record, work, place)

    @njit(**OPTIONS)
    def finite(value):  # noqa: ANN001, ANN202
        """Return the number, or zero: rays that are not valid may overflow."""
        return value if math.fabs(value) <= largest else zero

    @njit(**OPTIONS)
    def store(job, start, count, state_):  # noqa: ANN001, ANN202
        """Write rays `start` to `start + count` as they are behind the last step."""
        exit_z = carray(at(job[jobs.EXIT_Z]), 1)[0]
        state = carray(state_, STATE)
        position = carray(shifted(at(job[jobs.OUT_POSITION]), 3 * start), 3 * BLOCK)
        direction = carray(shifted(at(job[jobs.OUT_DIRECTION]), 3 * start), 3 * BLOCK)
        for i in range(count):
            position[3 * i] = finite(state[X + i])
            position[3 * i + 1] = finite(state[Y + i])
            position[3 * i + 2] = finite(state[Z + i] + exit_z)
        for i in range(count):
            direction[3 * i] = finite(state[L + i])
            direction[3 * i + 1] = finite(state[M + i])
            direction[3 * i + 2] = finite(state[N + i])
        path = carray(shifted(at(job[jobs.OUT_PATH]), start), BLOCK)
        status = carray(shifted(int8_at(job[jobs.OUT_STATUS]), start), BLOCK)
        surface = carray(shifted(int16_at(job[jobs.OUT_SURFACE]), start), BLOCK)
        for i in range(count):
            path[i] = finite(state[PATH + i])
        for i in range(count):
            ended, vignetted = state[ENDED + i], state[VIGNETTED + i]
            code = types.int64(ended if ended > zero else vignetted)
            surface[i] = code >> STATUS_BITS
            status[i] = code & STATUS_MASK

    return Streams(find_wavelength, load, set_indices, step, store)


def forward_driver(real: types.Type, losses: Any = None) -> Callable[..., None]:
    """Compile the trace of blocks `first` to `last`, which writes the rays behind the last step.

    Args:
        real: the precision.
        losses: `PassedLight`, where the share of light that is left is asked for.
    """
    at = real_at(real)
    _, load, _, step, store = streams(real)
    lossy = losses is not None
    begin, go_on, store_share = losses[:3] if lossy else (None, None, None)

    def kernel(job_, first, last):  # noqa: ANN001, ANN202
        job = carray(job_, jobs.LENGTH)
        rays, steps = job[jobs.RAYS], job[jobs.STEPS]
        lanes = carray(int64_at(job[jobs.LANES]), BLOCK)
        work = at(job[jobs.WORK])
        for block in range(first, last):
            start = BLOCK * block
            count = min(BLOCK, rays - start)
            now, then = at(job[jobs.STACK]), shifted(at(job[jobs.STACK]), STATE)
            load(job, start, count, now, lanes)
            if lossy:
                begin(job)
            for k in range(steps):
                step(job, k, lanes, now, then, then, work)
                if lossy:
                    go_on(job, k, lanes, now, then)
                now, then = then, now
            store(job, start, count, now)
            if lossy:
                store_share(job, start, count)

    return kernel
