"""The renderer's driver traces a ray of each wavelength for every sample of a block of pixels.

A block is pixels, and takes their samples in turn: a lane is a pixel, so that sums
over samples need no scatter, and neighbours read neighbouring texels.  All wavelengths share the
samples, and a ray serves every depth and every image.
"""

from collections.abc import Callable

from numba import carray, types

from dolens.kernels.cpu import jobs
from dolens.kernels.cpu.compiler import int64_at, shifted
from dolens.kernels.cpu.forward import real_at, streams
from dolens.kernels.cpu.layout import STATE, UNBOUNDED
from dolens.kernels.cpu.rendering.first_surface import first_surface
from dolens.kernels.cpu.rendering.layout import (
    BLOCK,
    BLOCKS,
    CHANNELS,
    DEPTHS,
    IMAGE,
    IMAGES,
    PIXEL_SUMS,
    PIXELS,
    PLANES,
    SIDE,
    TEXTURE_HEIGHT,
    TEXTURE_WIDTH,
    TEXTURES,
    VIEW_LENGTH,
)
from dolens.kernels.cpu.rendering.lookup import lookup
from dolens.kernels.cpu.rendering.samples import sampler


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
