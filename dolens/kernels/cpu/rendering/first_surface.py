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
    """The functions for one real type; wavelengths are columns of the indices."""
    at = real_at(real)
    zero, one, two, tiny = real(0.0), real(1.0), real(2.0), real(1e-18)
    # (Γ² of a refraction too weak to give the normal.)
    weak = real(1e-4)

    @njit(**OPTIONS)
    def ratio(job, codes, wavelength):  # noqa: ANN001, ANN202
        """Index in front of the step over that behind it."""
        count = job[12]
        indices = carray(real64_at(job[11]), 1 << 40)
        return real(indices[codes[3] * count + wavelength] / indices[codes[4] * count + wavelength])

    @njit(**OPTIONS)
    def reusable(job, before, after):  # noqa: ANN001, ANN202
        """Whether the first wavelength's step serves the others: no ray of the block ended."""
        src, dst = carray(before, 1280), carray(after, 1280)
        codes = carray(int64_at(job[9]), 24)
        refracts, mu = codes[5] != 0, ratio(job, codes, 0)
        good = zero
        for i in range(128):
            x = dst[384 + i] - mu * src[384 + i]
            y = dst[512 + i] - mu * src[512 + i]
            z = dst[640 + i] - mu * src[640 + i]
            strong = not refracts or x * x + y * y + z * z > weak
            good += one if strong and dst[896 + i] == zero else zero
        return good == real(128.0)

    @njit(**OPTIONS)
    def refract_again(job, wavelength, before, known, after):  # noqa: ANN001, ANN202
        """The state behind the first step from that of the first wavelength.

        The optical path is not carried on.
        """
        src, old, dst = carray(before, 1280), carray(known, 1280), carray(after, 1280)
        codes = carray(int64_at(job[9]), 24)
        record = carray(shifted(at(job[10]), codes[1]), 32)
        for i in range(1280):
            dst[i] = old[i]
        if codes[5] == 0:
            return
        total_reflection = record[19] + two
        mu_known, mu = ratio(job, codes, 0), ratio(job, codes, wavelength)
        for i in range(128):
            l, m, n = src[384 + i], src[512 + i], src[640 + i]  # noqa: E741
            a, b, c = dst[384 + i], dst[512 + i], dst[640 + i]
            x, y, z = a - mu_known * l, b - mu_known * m, c - mu_known * n
            size = math.sqrt(x * x + y * y + z * z)
            inverse = one / size
            x, y, z = x * inverse, y * inverse, z * inverse
            cosine, inside = l * x + m * y + n * z, a * x + b * y + c * z
            squared = (one - mu * mu) + (mu * mu) * (cosine * cosine)
            root = math.sqrt(squared if squared > tiny else tiny)
            # Small changes: the normal's rounding does not count.
            more = ((root if inside > zero else -root) - mu * cosine) - size
            dst[384 + i] = a + ((mu - mu_known) * l + more * x)
            dst[512 + i] = b + ((mu - mu_known) * m + more * y)
            dst[640 + i] = c + ((mu - mu_known) * n + more * z)
            dst[896 + i] = zero if squared > zero else total_reflection

    return FirstSurface(reusable, refract_again)
