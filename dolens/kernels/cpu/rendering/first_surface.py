"""The first surface that rays meet: at the same points, whatever their wavelength.

Only refraction differs.  With d' = μ·d + Γ·N a known refraction gives the normal, N ∥ d' - μ·d;
another wavelength's differs by (Δμ)·d + (ΔΓ)·N: no second search for the intersection.
"""

import math
from functools import cache
from typing import Any, NamedTuple

from numba import carray, njit, types

from dolens.kernels.cpu.compiler import OPTIONS, int64_at, real64_at, shifted
from dolens.kernels.cpu.forward import real_at


class FirstSurface(NamedTuple):
    """Compiled functions that reuse the first step of a block's rays."""

    reusable: Any
    refract_again: Any


@cache
def first_surface(real: types.Type) -> FirstSurface:
    """The functions for one real type.

    What they keep: the state behind the first step at the first wavelength, with Γ in the row of
    the path, which a renderer has no use for; then a row of d·N and three of N.
    """
    at = real_at(real)
    zero, one, two, tiny = real(0.0), real(1.0), real(2.0), real(1e-18)
    # Γ² of a refraction too weak to give the normal.
    weak = real(1e-4)

    @njit(**OPTIONS)
    def ratio(job, codes, wavelength):  # noqa: ANN001, ANN202
        """Index in front of the step over that behind it."""
        count = job[12]
        indices = carray(real64_at(job[11]), 1 << 40)
        return real(indices[codes[3] * count + wavelength] / indices[codes[4] * count + wavelength])

    @njit(**OPTIONS)
    def reusable(job, before, kept):  # noqa: ANN001, ANN202
        """Whether the first wavelength's step serves the others: no ray of the block ended.

        N is taken along d' - μ·d, so that Γ is positive.
        """
        src, dst = carray(before, 1280), carray(kept, 1792)
        codes = carray(int64_at(job[9]), 24)
        refracts, mu = codes[5] != 0, ratio(job, codes, 0)
        good = zero
        for i in range(128):
            l, m, n = src[384 + i], src[512 + i], src[640 + i]  # noqa: E741
            x, y, z = dst[384 + i] - mu * l, dst[512 + i] - mu * m, dst[640 + i] - mu * n
            squared = x * x + y * y + z * z
            good += one if squared > weak and dst[896 + i] == zero else zero
            size = math.sqrt(squared if squared > tiny else tiny)
            inverse = one / size
            x, y, z = x * inverse, y * inverse, z * inverse
            dst[768 + i], dst[1280 + i] = size, l * x + m * y + n * z
            dst[1408 + i], dst[1536 + i], dst[1664 + i] = x, y, z
        return good == real(128.0) or not refracts

    @njit(**OPTIONS)
    def refract_again(job, wavelength, before, kept, after):  # noqa: ANN001, ANN202
        """The state behind the first step at another wavelength, but for its path."""
        src, old, dst = carray(before, 1280), carray(kept, 1792), carray(after, 1280)
        codes = carray(int64_at(job[9]), 24)
        record = carray(shifted(at(job[10]), codes[1]), 32)
        for i in range(128):
            dst[i], dst[128 + i], dst[256 + i] = old[i], old[128 + i], old[256 + i]
            dst[768 + i], dst[896 + i] = zero, old[896 + i]
            dst[1024 + i], dst[1152 + i] = old[1024 + i], old[1152 + i]
        if codes[5] == 0:
            for i in range(128 * 3):
                dst[384 + i] = old[384 + i]
            return
        total_reflection = record[19] + two
        known, mu = ratio(job, codes, 0), ratio(job, codes, wavelength)
        change, constant, square = mu - known, one - mu * mu, mu * mu
        # s·cos t = μ·d·N + Γ has the same sign at all wavelengths.
        for i in range(128):
            size, cosine = old[768 + i], old[1280 + i]
            squared = constant + square * (cosine * cosine)
            root = math.copysign(
                math.sqrt(squared if squared > tiny else tiny), known * cosine + size
            )
            # Small changes: the normal's rounding does not count.
            more = (root - mu * cosine) - size
            dst[384 + i] = old[384 + i] + (change * src[384 + i] + more * old[1408 + i])
            dst[512 + i] = old[512 + i] + (change * src[512 + i] + more * old[1536 + i])
            dst[640 + i] = old[640 + i] + (change * src[640 + i] + more * old[1664 + i])
            dst[896 + i] = zero if squared > zero else total_reflection

    return FirstSurface(reusable, refract_again)
