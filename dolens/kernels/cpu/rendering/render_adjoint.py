"""Driver of the renderer's backward pass: samples are made again, traced, and swept back.

Sums are kept for every group of blocks.  Groups do not depend on the number of threads, and each is
one worker's: neither does the result.
"""

from collections.abc import Callable
from functools import cache
from typing import Any

from numba import carray, njit, types

from dolens.kernels.cpu.adjoint import sweeps
from dolens.kernels.cpu.compiler import OPTIONS, int64_at, real64_at, shifted
from dolens.kernels.cpu.forward import real_at, streams
from dolens.kernels.cpu.rendering.first_surface import first_surface
from dolens.kernels.cpu.rendering.lookup import lookup, texel_sums
from dolens.kernels.cpu.rendering.samples import sampler


@cache
def _preparation(real: types.Type) -> tuple[Any, Any, Any, Any]:
    """Compiled: load the pixels' cotangents, replace rays that fail, clear cotangents, copy."""
    at = real_at(real)
    zero = real(0.0)

    @njit(**OPTIONS)
    def load(view, lengths, start, count, scratch):  # noqa: ANN001, ANN202
        """The pixels' cotangents, scaled; zero in the lanes beyond `count`."""
        scale = lengths[11]
        for j in range(view[6] * view[7] * view[8]):
            source = carray(shifted(at(view[15]), j * view[5] + start), 128)
            row = carray(shifted(scratch, 2048 + 128 * j), 128)
            for i in range(count):
                row[i] = scale * source[i]
            for i in range(count, 128):
                row[i] = zero

    @njit(**OPTIONS)
    def replace(states, stack, scratch):  # noqa: ANN001, ANN202
        """Put a ray that arrives in the place of those that fail: their numbers may be anything.

        They have no cotangents, so that it adds nothing.
        """
        passes = carray(shifted(scratch, 384), 128)
        good = 0
        while passes[good] == zero:
            good += 1
        for i in range(128):
            if passes[i] == zero:
                for j in range(10 * states):
                    row = carray(shifted(stack, 128 * j), 128)
                    row[i] = row[good]

    @njit(**OPTIONS)
    def clear(scratch, cotangents):  # noqa: ANN001, ANN202
        rows, cot = carray(scratch, 1664), carray(cotangents, 896)
        for i in range(128 * 3):
            rows[1280 + i] = zero
        for i in range(128 * 7):
            cot[i] = zero

    @njit(**OPTIONS)
    def copy(state, to):  # noqa: ANN001, ANN202
        src, dst = carray(state, 1280), carray(to, 1280)
        for i in range(1280):
            dst[i] = src[i]

    return load, replace, clear, copy


def render_adjoint_driver(real: types.Type) -> Callable[..., None]:
    """Sweep groups `first` to `last` of blocks back, from pixels to the lens and the textures."""
    at = real_at(real)
    step = streams(real).step
    sweep = sweeps(real)
    back, add_sums = sweep.back, sweep.add_sums
    reusable, refract_again = first_surface(real)
    place_pixels, sample, of_aim = sampler(real)
    arrive, meet, _, of_texels, of_rays = lookup(real)
    add_texels = texel_sums(real)
    load, replace, clear, copy = _preparation(real)
    zero, full = real(0.0), real(128.0)

    def kernel(job_, first, last):  # noqa: ANN001, ANN202
        job = carray(job_, 72)
        view, lengths = carray(int64_at(job[64]), 24), carray(at(job[65]), 1 << 40)
        lanes = carray(int64_at(job[38]), 128)
        scratch, stack, cotangents = at(job[49]), at(job[15]), at(job[16])
        cot = carray(cotangents, 896)
        work, behind = at(job[17]), shifted(stack, 1280)
        state, kept = shifted(stack, 1280 * job[8]), shifted(stack, 1280 * (job[8] + 1))
        exit_z = carray(at(job[13]), 1)[0]
        images, depths, channels = view[6], view[7], view[8]
        width, texels = view[10], view[9] * view[10]
        blocks, groups = carray(int64_at(view[12]), 1 << 40), carray(int64_at(view[13]), 1 << 40)
        of_lens, of_textures = view[17] != 0, view[16] != 0
        for group in range(first, last):
            sums = carray(shifted(real64_at(job[34]), group * job[35]), 1 << 40)
            for block in range(groups[group], groups[group + 1]):
                start, count = blocks[2 * block], blocks[2 * block + 1]
                place_pixels(view, start, count, scratch)
                load(view, lengths, start, count, scratch)
                whole, shared = True, False
                for turn in range(view[1] * view[1] * channels):
                    number, channel = turn // channels, turn % channels
                    if channel == 0 or not whole:
                        whole = True
                        sample(view, lengths, number, start, count, stack, scratch)
                    job[63] = channel + 1
                    if channel > 0 and shared:
                        refract_again(job, channel, stack, kept, behind)
                    else:
                        step(job, 0, lanes, stack, behind, behind, work)
                    if channel == 0 and channels > 1:
                        copy(behind, kept)
                        shared = reusable(job, stack, kept)
                    for k in range(1, job[8]):
                        now = shifted(stack, 1280 * (k + 1))
                        step(job, k, lanes, shifted(stack, 1280 * k), now, now, work)
                    arrived = arrive(state, scratch)
                    if arrived == zero:
                        continue
                    if arrived < full:
                        # The next wavelength needs the samples again.
                        whole = False
                        replace(job[8] + 1, stack, scratch)
                    clear(scratch, cotangents)
                    for d in range(depths):
                        depth, per_mm = lengths[16 + 2 * d] + exit_z, lengths[17 + 2 * d]
                        meet(lengths, depth, per_mm, width, state, scratch, job[38])
                        for b in range(images):
                            place = (b * channels + channel) * texels
                            pixels = shifted(
                                scratch, 2048 + 128 * ((b * depths + d) * channels + channel)
                            )
                            if of_lens:
                                texture = shifted(at(view[14]), place)
                                of_texels(texture, width, job[38], scratch, pixels)
                            if of_textures:
                                all_texels = images * channels * texels
                                to = shifted(at(view[16]), group * all_texels + place)
                                add_texels(to, width, job[38], scratch, pixels)
                        if of_lens:
                            # Behind the cotangents of the aim, one of each plane's magnification.
                            sums[job[35] - 5 - d] += types.float64(
                                of_rays(state, scratch, cotangents)
                            )
                    if not of_lens:
                        continue
                    total = zero
                    for i in range(128):
                        total += cot[256 + i]
                    sums[job[37] - 1] += types.float64(total)
                    for k in range(job[8] - 1, -1, -1):
                        back(job, k, lanes)
                        add_sums(job, k, lanes, sums)
                    aims = of_aim(lengths, stack, cotangents, scratch)
                    sums[job[35] - 1] += types.float64(aims[0])
                    sums[job[35] - 2] += types.float64(aims[1])
                    sums[job[35] - 3] += types.float64(aims[2])
                    sums[job[35] - 4] += types.float64(aims[3])

    return kernel
