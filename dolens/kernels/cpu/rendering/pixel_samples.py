"""Rays from points of the sensor's pixels to points of the exit pupil, up to the first surface.

Samples are rays from jittered points of the sensor's pixels to strata of the exit pupil.

It mirrors `RayRenderer._samples`, `sampling.square_to_disc` and `pupil.aim` of `dolens.rendering`.

Rays of all wavelengths meet the first surface at the same points.

Only refraction differs.  With d' = μ·d + Γ·N a known refraction gives the normal, N ∥ d' - μ·d;
another wavelength's differs by (Δμ)·d + (ΔΓ)·N: no second search for the intersection.
"""

import math
from collections.abc import Callable
from functools import cache
from typing import Any, NamedTuple

from numba import carray, njit, types

from dolens.kernels.cpu import jobs
from dolens.kernels.cpu.compiler import OPTIONS, int64_at, real64_at, shifted
from dolens.kernels.cpu.forward import real_at
from dolens.kernels.cpu.layout import (
    AFTER,
    BEFORE,
    CODE_ROW,
    ENDED,
    OFFSET,
    PATH,
    REFRACTS,
    SHORT_RECORD,
    STATE,
    TAG,
    TOTALLY_REFLECTED,
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
from dolens.kernels.cpu.rendering.layout import (
    ARRIVES,
    BLOCK,
    MIDDLE_COLUMN,
    MIDDLE_ROW,
    OF_WEIGHT,
    PITCH,
    PIXEL_AREA,
    PIXEL_COLUMN,
    PIXEL_ROW,
    PUPIL_Z,
    RADIUS,
    SAMPLE_WEIGHT,
    SEED_HIGH,
    SEED_LOW,
    SENSOR_Z,
    SIDE,
    WEIGHT,
    WIDTH,
)
from dolens.kernels.table import TINY


class Sampler(NamedTuple):
    """These compiled functions make a block's rays."""

    place_pixels: Any
    sample: Any
    of_aim: Any


def _disc(real: types.Type) -> Callable[..., Any]:
    """Compile the concentric map of the unit square onto the unit disc."""
    zero, one, two, quarter = real(0.0), real(1.0), real(2.0), real(0.25 * math.pi)
    # Taylor's series, to the last bit of double precision up to 45 degrees.
    s0, s1, s2, s3, s4, s5, s6, s7 = (
        real((-1.0) ** k / math.factorial(2 * k + 1)) for k in range(8)
    )
    c0, c1, c2, c3, c4, c5, c6, c7, c8 = (
        real((-1.0) ** k / math.factorial(2 * k)) for k in range(9)
    )

    @njit(**OPTIONS)
    def disc(u, v):  # noqa: ANN001, ANN202
        a, b = two * u - one, two * v - one
        wide = math.fabs(a) > math.fabs(b)
        radius, other = a if wide else b, b if wide else a
        angle = quarter * other / (one if radius == zero else radius)
        q = angle * angle
        sine = s4 + q * (s5 + q * (s6 + q * s7))
        sine = angle * (s0 + q * (s1 + q * (s2 + q * (s3 + q * sine))))
        cosine = c4 + q * (c5 + q * (c6 + q * (c7 + q * c8)))
        cosine = c0 + q * (c1 + q * (c2 + q * (c3 + q * cosine)))
        near, far = radius * cosine, radius * sine
        return near if wide else far, far if wide else near

    return disc


@cache
def sampler(real: types.Type) -> Sampler:
    """Compile functions that place a block's pixels and make their rays, for one real type."""
    disc = _disc(real)
    zero, half, one, four = real(0.0), real(0.5), real(1.0), real(4.0)
    unit = real(2.0**-24)

    @njit(**OPTIONS)
    def place_pixels(view, start, count, scratch):  # noqa: ANN001, ANN202
        """Set rows and columns of pixels from `start` on; lanes beyond `count` repeat the last."""
        out = carray(scratch, UNBOUNDED)
        width = view[WIDTH]
        for i in range(BLOCK):
            pixel = start + (i if i < count else count - 1)
            row = pixel // width
            out[X + i], out[Y + i] = real(row), real(pixel - row * width)

    @njit(**OPTIONS)
    def sample(view, lengths, number, start, count, state, scratch):  # noqa: ANN001, ANN202
        """Make the rays of sample `number` and their weights."""
        out, rows = carray(state, STATE), carray(scratch, UNBOUNDED)
        side = view[SIDE]
        seed_low, seed_high = types.uint32(view[SEED_LOW]), types.uint32(view[SEED_HIGH])
        cells, cell_u, cell_v = real(side), real(number % side), real(number // side)
        pitch, middle_row = lengths[PITCH], lengths[MIDDLE_ROW]
        middle_column = lengths[MIDDLE_COLUMN]
        radius, z, weight = lengths[RADIUS], lengths[SENSOR_Z], lengths[WEIGHT]
        dz = lengths[PUPIL_Z] - z
        sign = -one if dz > zero else one
        spread, centre = (unit, half) if view[PIXEL_AREA] != 0 else (zero, zero)
        counter = types.uint32(number)
        first, last = types.int32(start), types.int32(count - 1)
        for i in range(BLOCK):
            lane = types.int32(i)
            pixel = types.int32(first + (lane if lane < last else last))
            a, b, c, d = random_words(types.uint32(pixel), counter, seed_low, seed_high)
            u = (real(upper_bits(a)) * unit + cell_u) / cells
            v = (real(upper_bits(b)) * unit + cell_v) / cells
            pupil_x, pupil_y = disc(u, v)
            row = rows[PIXEL_ROW + i] + (real(upper_bits(c)) * spread - centre)
            column = rows[PIXEL_COLUMN + i] + (real(upper_bits(d)) * spread - centre)
            x, y = (middle_column - column) * pitch, (row - middle_row) * pitch
            dx, dy = pupil_x * radius - x, pupil_y * radius - y
            inverse = sign / math.sqrt(dx * dx + dy * dy + dz * dz)
            n = dz * inverse
            out[X + i], out[Y + i], out[Z + i] = x, y, z
            out[L + i], out[M + i], out[N + i] = dx * inverse, dy * inverse, n
            out[PATH + i], out[ENDED + i], out[VIGNETTED + i] = zero, zero, zero
            rows[SAMPLE_WEIGHT + i] = (n * n) * (n * n) * weight

    @njit(**OPTIONS)
    def of_aim(lengths, state, cotangents, scratch):  # noqa: ANN001, ANN202
        """Return the cotangents of the sensor's z, the pupil's z, its radius and the weight along
        the axis from those of a block's rays and weights, summed.

        Rays start at P, aim at the pupil's point A, and with A - P = Q·d
        of_A = (of_d - (of_d·d) d)/Q, of_P = of_position - of_A, and of_radius = of_A·A/radius.
        """
        src, cot = carray(state, STATE), carray(cotangents, UNBOUNDED)
        rows = carray(scratch, UNBOUNDED)
        distance, per_radius = lengths[PUPIL_Z] - lengths[SENSOR_Z], one / lengths[RADIUS]
        per_weight = one / lengths[WEIGHT]
        of_z, of_pupil_z, of_radius, of_share = zero, zero, zero, zero
        for i in range(BLOCK):
            l, m, n = src[L + i], src[M + i], src[N + i]  # noqa: E741
            of_weight = rows[ARRIVES + i] * rows[OF_WEIGHT + i]
            weighted = of_weight * rows[SAMPLE_WEIGHT + i]
            of_share += weighted
            of_n = cot[N + i] + four * weighted / n
            along = cot[L + i] * l + cot[M + i] * m + of_n * n
            q = distance / n
            inverse = one / q
            x, y = (cot[L + i] - along * l) * inverse, (cot[M + i] - along * m) * inverse
            z = (of_n - along * n) * inverse
            of_z += cot[Z + i] - z
            of_pupil_z += z
            of_radius += x * (src[X + i] + q * l) + y * (src[Y + i] + q * m)
        return of_z, of_pupil_z, of_radius * per_radius, of_share * per_weight

    return Sampler(place_pixels, sample, of_aim)


_word = types.uint32
_FACTOR, _SUMMAND, _HALF, _UNUSED = _word(1664525), _word(1013904223), _word(16), _word(8)


@njit(**OPTIONS)
def random_words(x, y, z, w):  # noqa: ANN001, ANN201
    """Return four random words of four counters, all of 32 bits: pcg4d of Jarzynski and Olano
    (2020).
    """
    x, y = _word(x * _FACTOR + _SUMMAND), _word(y * _FACTOR + _SUMMAND)
    z, w = _word(z * _FACTOR + _SUMMAND), _word(w * _FACTOR + _SUMMAND)
    x = _word(x + y * w)
    y = _word(y + z * x)
    z = _word(z + x * y)
    w = _word(w + y * z)
    x, y = _word(x ^ (x >> _HALF)), _word(y ^ (y >> _HALF))
    z, w = _word(z ^ (z >> _HALF)), _word(w ^ (w >> _HALF))
    x = _word(x + y * w)
    y = _word(y + z * x)
    z = _word(z + x * y)
    w = _word(w + y * z)
    return x, y, z, w


@njit(**OPTIONS)
def upper_bits(word):  # noqa: ANN001, ANN201
    """Return the 24 upper bits of a word, as a signed integer: exact in either precision."""
    return types.int32(word >> _UNUSED)


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
