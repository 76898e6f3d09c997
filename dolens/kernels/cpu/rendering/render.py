"""Driver of the renderer: for every sample of a block of pixels, a ray of each wavelength.

A block is 128 neighbouring pixels, and takes their samples in turn: a lane is a pixel, so that sums
over samples need no scatter, and neighbours read neighbouring texels.  All wavelengths share the
samples, and a ray serves every depth and every image.
"""

from collections.abc import Callable

from numba import carray, types

from dolens.kernels.cpu.compiler import int64_at, shifted
from dolens.kernels.cpu.forward import real_at, streams
from dolens.kernels.cpu.rendering.lookup import lookup
from dolens.kernels.cpu.rendering.samples import sampler


def render_driver(real: types.Type) -> Callable[..., None]:
    """Render blocks of pixels `first` to `last`."""
    at = real_at(real)
    step = streams(real).step
    place_pixels, sample, _ = sampler(real)
    arrive, meet, see, _, _ = lookup(real)
    zero = real(0.0)

    def kernel(job_, first, last):  # noqa: ANN001, ANN202
        job = carray(job_, 72)
        view, lengths = carray(int64_at(job[64]), 24), carray(at(job[65]), 1 << 40)
        lanes = carray(int64_at(job[38]), 128)
        scratch, work, stack = at(job[49]), at(job[17]), at(job[15])
        sums, exit_z = shifted(scratch, 2048), carray(at(job[13]), 1)[0]
        images, depths, channels = view[6], view[7], view[8]
        height, width = view[9], view[10]
        blocks = carray(int64_at(view[12]), 1 << 40)
        for block in range(first, last):
            start, count = blocks[2 * block], blocks[2 * block + 1]
            place_pixels(view, start, count, scratch)
            clear = carray(sums, 1 << 40)
            for i in range(128 * images * depths * channels):
                clear[i] = zero
            for number in range(view[1] * view[1]):
                sample(view, lengths, number, start, count, stack, scratch)
                for channel in range(channels):
                    job[63] = channel + 1
                    before, now = stack, shifted(stack, 1280)
                    for k in range(job[8]):
                        step(job, k, lanes, before, now, now, work)
                        before, now = now, shifted(stack, 2560 if k % 2 == 0 else 1280)
                    if arrive(before, scratch) == zero:
                        continue
                    for d in range(depths):
                        depth, per_mm = lengths[16 + 2 * d] + exit_z, lengths[17 + 2 * d]
                        meet(lengths, depth, per_mm, width, before, scratch, job[38])
                        for b in range(images):
                            texture = shifted(
                                at(view[14]), (b * channels + channel) * height * width
                            )
                            pixels = shifted(sums, 128 * ((b * depths + d) * channels + channel))
                            see(texture, width, job[38], scratch, pixels)
            for j in range(images * depths * channels):
                out = carray(shifted(at(view[15]), j * view[5] + start), 128)
                row = carray(shifted(sums, 128 * j), 128)
                for i in range(count):
                    out[i] = row[i]

    return kernel
