"""The renderer's drivers: forward, and back with the same samples traced again.

A block is pixels, and takes their samples in turn: a lane is a pixel, so that sums
over samples need no scatter, and neighbours read neighbouring texels.  All wavelengths share the
samples, and a ray serves every depth and every image.

The renderer's backward driver makes the samples again, traces them, and sweeps back.

Sums are kept for every group of blocks.  Groups do not depend on the number of threads, and each is
one worker's: neither does the result.
"""

from collections.abc import Callable
from functools import cache
from typing import Any

from numba import carray, njit, types

from dolens.kernels.cpu import jobs
from dolens.kernels.cpu.adjoint import sweeps
from dolens.kernels.cpu.compiler import OPTIONS, int64_at, real64_at, shifted
from dolens.kernels.cpu.forward import real_at, streams
from dolens.kernels.cpu.layout import OF_FRONT, STATE, UNBOUNDED, Z
from dolens.kernels.cpu.rendering.layout import (
    ARRIVES,
    BLOCK,
    BLOCKS,
    CHANNELS,
    DEPTHS,
    GROUPS,
    IMAGE,
    IMAGES,
    OF_AXIAL_WEIGHT,
    OF_LENS,
    OF_MAGNIFICATION,
    OF_PUPIL_Z,
    OF_RADIUS,
    OF_ROW,
    OF_SENSOR_Z,
    PIXEL_SUMS,
    PIXELS,
    PLANES,
    SCALE,
    SIDE,
    TEXTURE_HEIGHT,
    TEXTURE_SUMS,
    TEXTURE_WIDTH,
    TEXTURES,
    VIEW_LENGTH,
)
from dolens.kernels.cpu.rendering.lookup import lookup, texel_sums
from dolens.kernels.cpu.rendering.pixel_samples import first_surface, sampler


def render_driver(real: types.Type) -> Callable[..., None]:
    """Compile the driver that renders blocks of pixels `first` to `last`."""
    at = real_at(real)
    step = streams(real).step
    place_pixels, sample, _ = sampler(real)
    arrive, meet, see, _, _ = lookup(real)
    reusable, refract_again = first_surface(real)
    zero = real(0.0)

    def kernel(job_, first, last):  # noqa: ANN001, ANN202
        job = carray(job_, jobs.LENGTH)
        view = carray(int64_at(job[jobs.VIEW]), VIEW_LENGTH)
        lengths = carray(at(job[jobs.LENGTHS]), UNBOUNDED)
        lanes = carray(int64_at(job[jobs.LANES]), BLOCK)
        scratch, work, stack = at(job[jobs.DRIVER_ROWS]), at(job[jobs.WORK]), at(job[jobs.STACK])
        kept = shifted(stack, 3 * STATE)
        sums, exit_z = shifted(scratch, PIXEL_SUMS), carray(at(job[jobs.EXIT_Z]), 1)[0]
        images, depths, channels = view[IMAGES], view[DEPTHS], view[CHANNELS]
        height, width = view[TEXTURE_HEIGHT], view[TEXTURE_WIDTH]
        blocks = carray(int64_at(view[BLOCKS]), UNBOUNDED)
        for block in range(first, last):
            start, count = blocks[2 * block], blocks[2 * block + 1]
            place_pixels(view, start, count, scratch)
            clear = carray(sums, UNBOUNDED)
            for i in range(BLOCK * images * depths * channels):
                clear[i] = zero
            for number in range(view[SIDE] * view[SIDE]):
                sample(view, lengths, number, start, count, stack, scratch)
                shared = False
                for channel in range(channels):
                    job[jobs.WAVELENGTH] = channel + 1
                    before = kept if channel == 0 else shifted(stack, STATE)
                    if shared:
                        refract_again(job, channel, stack, kept, before)
                    else:
                        step(job, 0, lanes, stack, before, before, work)
                    if channel == 0 and channels > 1:
                        shared = reusable(job, stack, kept)
                    for k in range(1, job[jobs.STEPS]):
                        now = shifted(stack, 2 * STATE if k % 2 == 1 else STATE)
                        step(job, k, lanes, before, now, now, work)
                        before = now
                    if arrive(before, scratch) == zero:
                        continue
                    for d in range(depths):
                        depth = lengths[PLANES + 2 * d] + exit_z
                        per_mm = lengths[PLANES + 1 + 2 * d]
                        meet(lengths, depth, per_mm, width, before, scratch, job[jobs.LANES])
                        for b in range(images):
                            texture = shifted(
                                at(view[TEXTURES]), (b * channels + channel) * height * width
                            )
                            pixels = shifted(sums, BLOCK * ((b * depths + d) * channels + channel))
                            see(texture, width, job[jobs.LANES], scratch, pixels)
            for j in range(images * depths * channels):
                out = carray(shifted(at(view[IMAGE]), j * view[PIXELS] + start), BLOCK)
                row = carray(shifted(sums, BLOCK * j), BLOCK)
                for i in range(count):
                    out[i] = row[i]

    return kernel


@cache
def _preparation(real: types.Type) -> tuple[Any, Any, Any, Any]:
    """Compile functions that load the pixels' cotangents, replace failed rays, clear, and copy."""
    at = real_at(real)
    zero = real(0.0)

    @njit(**OPTIONS)
    def load(view, lengths, start, count, scratch):  # noqa: ANN001, ANN202
        """Load the pixels' cotangents, scaled; zero in the lanes beyond `count`."""
        scale = lengths[SCALE]
        for j in range(view[IMAGES] * view[DEPTHS] * view[CHANNELS]):
            source = carray(shifted(at(view[IMAGE]), j * view[PIXELS] + start), BLOCK)
            row = carray(shifted(scratch, PIXEL_SUMS + BLOCK * j), BLOCK)
            for i in range(count):
                row[i] = scale * source[i]
            for i in range(count, BLOCK):
                row[i] = zero

    @njit(**OPTIONS)
    def replace(states, stack, scratch):  # noqa: ANN001, ANN202
        """Put a ray that arrives in the place of those that fail: their numbers may be anything.

        They have no cotangents, so that it adds nothing.
        """
        passes = carray(shifted(scratch, ARRIVES), BLOCK)
        good = 0
        while passes[good] == zero:
            good += 1
        for i in range(BLOCK):
            if passes[i] == zero:
                for j in range(STATE // BLOCK * states):
                    row = carray(shifted(stack, BLOCK * j), BLOCK)
                    row[i] = row[good]

    @njit(**OPTIONS)
    def clear(scratch, cotangents):  # noqa: ANN001, ANN202
        rows, cot = carray(scratch, UNBOUNDED), carray(cotangents, UNBOUNDED)
        for i in range(BLOCK * 3):
            rows[OF_ROW + i] = zero
        for i in range(OF_FRONT):
            cot[i] = zero

    @njit(**OPTIONS)
    def copy(state, to):  # noqa: ANN001, ANN202
        src, dst = carray(state, STATE), carray(to, STATE)
        for i in range(STATE):
            dst[i] = src[i]

    return load, replace, clear, copy


def render_adjoint_driver(real: types.Type) -> Callable[..., None]:
    """Compile the driver that sweeps groups `first` to `last` of blocks back, from pixels to the
    lens and the textures.
    """
    at = real_at(real)
    step = streams(real).step
    sweep = sweeps(real)
    back, add_sums = sweep.back, sweep.add_sums
    reusable, refract_again = first_surface(real)
    place_pixels, sample, of_aim = sampler(real)
    arrive, meet, _, of_texels, of_rays = lookup(real)
    add_texels = texel_sums(real)
    load, replace, clear, copy = _preparation(real)
    zero, full = real(0.0), real(float(BLOCK))

    def kernel(job_, first, last):  # noqa: ANN001, ANN202
        job = carray(job_, jobs.LENGTH)
        view = carray(int64_at(job[jobs.VIEW]), VIEW_LENGTH)
        lengths = carray(at(job[jobs.LENGTHS]), UNBOUNDED)
        lanes = carray(int64_at(job[jobs.LANES]), BLOCK)
        scratch, stack = at(job[jobs.DRIVER_ROWS]), at(job[jobs.STACK])
        cotangents = at(job[jobs.COTANGENTS])
        cot = carray(cotangents, UNBOUNDED)
        work, behind = at(job[jobs.WORK]), shifted(stack, STATE)
        state = shifted(stack, STATE * job[jobs.STEPS])
        kept = shifted(stack, STATE * (job[jobs.STEPS] + 1))
        exit_z = carray(at(job[jobs.EXIT_Z]), 1)[0]
        images, depths, channels = view[IMAGES], view[DEPTHS], view[CHANNELS]
        width, texels = view[TEXTURE_WIDTH], view[TEXTURE_HEIGHT] * view[TEXTURE_WIDTH]
        blocks = carray(int64_at(view[BLOCKS]), UNBOUNDED)
        groups = carray(int64_at(view[GROUPS]), UNBOUNDED)
        of_lens, of_textures = view[OF_LENS] != 0, view[TEXTURE_SUMS] != 0
        for group in range(first, last):
            sums = carray(
                shifted(real64_at(job[jobs.SUMS]), group * job[jobs.SUM_LENGTH]), UNBOUNDED
            )
            for block in range(groups[group], groups[group + 1]):
                start, count = blocks[2 * block], blocks[2 * block + 1]
                place_pixels(view, start, count, scratch)
                load(view, lengths, start, count, scratch)
                whole, shared = True, False
                for turn in range(view[SIDE] * view[SIDE] * channels):
                    number, channel = turn // channels, turn % channels
                    if channel == 0 or not whole:
                        whole = True
                        sample(view, lengths, number, start, count, stack, scratch)
                    job[jobs.WAVELENGTH] = channel + 1
                    if channel > 0 and shared:
                        refract_again(job, channel, stack, kept, behind)
                    else:
                        step(job, 0, lanes, stack, behind, behind, work)
                    if channel == 0 and channels > 1:
                        copy(behind, kept)
                        shared = reusable(job, stack, kept)
                    for k in range(1, job[jobs.STEPS]):
                        now = shifted(stack, STATE * (k + 1))
                        step(job, k, lanes, shifted(stack, STATE * k), now, now, work)
                    arrived = arrive(state, scratch)
                    if arrived == zero:
                        continue
                    if arrived < full:
                        # The next wavelength needs the samples again.
                        whole = False
                        replace(job[jobs.STEPS] + 1, stack, scratch)
                    clear(scratch, cotangents)
                    for d in range(depths):
                        depth = lengths[PLANES + 2 * d] + exit_z
                        per_mm = lengths[PLANES + 1 + 2 * d]
                        meet(lengths, depth, per_mm, width, state, scratch, job[jobs.LANES])
                        for b in range(images):
                            place = (b * channels + channel) * texels
                            pixels = shifted(
                                scratch,
                                PIXEL_SUMS + BLOCK * ((b * depths + d) * channels + channel),
                            )
                            if of_lens:
                                texture = shifted(at(view[TEXTURES]), place)
                                of_texels(texture, width, job[jobs.LANES], scratch, pixels)
                            if of_textures:
                                all_texels = images * channels * texels
                                to = shifted(at(view[TEXTURE_SUMS]), group * all_texels + place)
                                add_texels(to, width, job[jobs.LANES], scratch, pixels)
                        if of_lens:
                            sums[job[jobs.SUM_LENGTH] - OF_MAGNIFICATION - d] += types.float64(
                                of_rays(state, scratch, cotangents)
                            )
                    if not of_lens:
                        continue
                    total = zero
                    for i in range(BLOCK):
                        total += cot[Z + i]
                    sums[job[jobs.VALUES_LENGTH] - 1] += types.float64(total)
                    for k in range(job[jobs.STEPS] - 1, -1, -1):
                        back(job, k, lanes)
                        add_sums(job, k, lanes, sums)
                    aims = of_aim(lengths, stack, cotangents, scratch)
                    sums[job[jobs.SUM_LENGTH] - OF_SENSOR_Z] += types.float64(aims[0])
                    sums[job[jobs.SUM_LENGTH] - OF_PUPIL_Z] += types.float64(aims[1])
                    sums[job[jobs.SUM_LENGTH] - OF_RADIUS] += types.float64(aims[2])
                    sums[job[jobs.SUM_LENGTH] - OF_AXIAL_WEIGHT] += types.float64(aims[3])

    return kernel
