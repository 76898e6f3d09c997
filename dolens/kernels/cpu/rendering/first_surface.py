"""Rays of all wavelengths meet the first surface at the same points.

Only refraction differs.  With d' = μ·d + Γ·N a known refraction gives the normal, N ∥ d' - μ·d;
another wavelength's differs by (Δμ)·d + (ΔΓ)·N: no second search for the intersection.
"""

import math
from functools import cache
from typing import Any, NamedTuple

from numba import carray, njit, types

from dolens.kernels.cpu import jobs
from dolens.kernels.cpu.compiler import OPTIONS, int64_at, real64_at, shifted
from dolens.kernels.cpu.forward import real_at
from dolens.kernels.cpu.layout import (
    ENDED,
    PATH,
    STATE,
    TRAVELLED,
    UNBOUNDED,
    VIGNETTED,
    L,
    M,
    N,
    X,
    Y,
    Z,
)
from dolens.kernels.cpu.records import (
    AFTER,
    BEFORE,
    CODE_ROW,
    OFFSET,
    REFRACTS,
    SHORT_RECORD,
    TAG,
    TOTALLY_REFLECTED,
)
from dolens.kernels.cpu.rendering.layout import BLOCK
from dolens.kernels.limits import TINY

# Rows that are kept: the state behind the first step at the first wavelength, with Γ in the row of
# the path, which a renderer has no use for; then d·N, and N.
GAMMA = PATH
COSINE, NORMAL_X, NORMAL_Y, NORMAL_Z = (STATE + BLOCK * row for row in range(4))


class FirstSurface(NamedTuple):
    """These compiled functions reuse the first step of a block's rays."""

    reusable: Any
    refract_again: Any


@cache
def first_surface(real: types.Type) -> FirstSurface:
    """Compile the functions for one real type."""
    at = real_at(real)
    zero, one, tiny = real(0.0), real(1.0), real(TINY)
    totally_reflected = real(TOTALLY_REFLECTED)
    # Γ² of a refraction too weak to give the normal.
    weak = real(1e-4)

    @njit(**OPTIONS)
    def ratio(job, codes, wavelength):  # noqa: ANN001, ANN202
        """Return the index in front of the step over that behind it."""
        count = job[jobs.WAVELENGTHS]
        indices = carray(real64_at(job[jobs.INDICES]), UNBOUNDED)
        return real(
            indices[codes[BEFORE] * count + wavelength] / indices[codes[AFTER] * count + wavelength]
        )

    @njit(**OPTIONS)
    def reusable(job, before, kept):  # noqa: ANN001, ANN202
        """Return whether the first wavelength's step serves the others: no ray of the block ended.

        N is taken along d' - μ·d, so that Γ is positive.
        """
        src, dst = carray(before, STATE), carray(kept, UNBOUNDED)
        codes = carray(int64_at(job[jobs.CODES]), CODE_ROW)
        refracts, mu = codes[REFRACTS] != 0, ratio(job, codes, 0)
        good = zero
        for i in range(BLOCK):
            l, m, n = src[L + i], src[M + i], src[N + i]  # noqa: E741
            x, y, z = dst[L + i] - mu * l, dst[M + i] - mu * m, dst[N + i] - mu * n
            squared = x * x + y * y + z * z
            good += one if squared > weak and dst[ENDED + i] == zero else zero
            size = math.sqrt(squared if squared > tiny else tiny)
            inverse = one / size
            x, y, z = x * inverse, y * inverse, z * inverse
            dst[GAMMA + i], dst[COSINE + i] = size, l * x + m * y + n * z
            dst[NORMAL_X + i], dst[NORMAL_Y + i], dst[NORMAL_Z + i] = x, y, z
        return good == real(float(BLOCK)) or not refracts

    @njit(**OPTIONS)
    def refract_again(job, wavelength, before, kept, after):  # noqa: ANN001, ANN202
        """Set the state behind the first step at another wavelength, but for its path."""
        src, old, dst = carray(before, STATE), carray(kept, UNBOUNDED), carray(after, STATE)
        codes = carray(int64_at(job[jobs.CODES]), CODE_ROW)
        record = carray(shifted(at(job[jobs.VALUES]), codes[OFFSET]), SHORT_RECORD)
        for i in range(BLOCK):
            dst[X + i], dst[Y + i], dst[Z + i] = old[X + i], old[Y + i], old[Z + i]
            dst[PATH + i], dst[ENDED + i] = zero, old[ENDED + i]
            dst[VIGNETTED + i], dst[TRAVELLED + i] = old[VIGNETTED + i], old[TRAVELLED + i]
        if codes[REFRACTS] == 0:
            for i in range(BLOCK * 3):
                dst[L + i] = old[L + i]
            return
        total_reflection = record[TAG] + totally_reflected
        known, mu = ratio(job, codes, 0), ratio(job, codes, wavelength)
        change, constant, square = mu - known, one - mu * mu, mu * mu
        # s·cos t = μ·d·N + Γ has the same sign at all wavelengths.
        for i in range(BLOCK):
            size, cosine = old[GAMMA + i], old[COSINE + i]
            squared = constant + square * (cosine * cosine)
            root = math.copysign(
                math.sqrt(squared if squared > tiny else tiny), known * cosine + size
            )
            # Small changes: the normal's rounding does not count.
            more = (root - mu * cosine) - size
            dst[L + i] = old[L + i] + (change * src[L + i] + more * old[NORMAL_X + i])
            dst[M + i] = old[M + i] + (change * src[M + i] + more * old[NORMAL_Y + i])
            dst[N + i] = old[N + i] + (change * src[N + i] + more * old[NORMAL_Z + i])
            dst[ENDED + i] = zero if squared > zero else total_reflection

    return FirstSurface(reusable, refract_again)
