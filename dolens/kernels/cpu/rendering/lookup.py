"""Rays meet a textured plane and look its radiance up; the adjoint gives both back.

It mirrors `distance_to_plane`, `texture_coordinates` and `bilinear` of the reference.
"""

from functools import cache
from typing import Any, NamedTuple

from llvmlite import ir
from numba import carray, njit, types
from numba.extending import intrinsic

from dolens.kernels.cpu.compiler import FASTMATH, OPTIONS, int32_at, shifted
from dolens.kernels.cpu.layout import ENDED, STATE, UNBOUNDED, VIGNETTED, L, M, N, X, Y, Z
from dolens.kernels.cpu.rendering.layout import (
    ACROSS,
    ARRIVES,
    BLOCK,
    COLUMNS_PER_MM,
    DOWN,
    LAST_COLUMN,
    LAST_ROW,
    OF_COLUMN,
    OF_ROW,
    OF_WEIGHT,
    PER_COSINE,
    PLANE_DISTANCE,
    ROWS_PER_MM,
    SAMPLE_WEIGHT,
    TEXTURE_COLUMN,
    TEXTURE_ROW,
)
from dolens.kernels.table import GRAZING


class Lookup(NamedTuple):
    """These compiled functions stand between a block's rays and the texels of a plane."""

    arrive: Any
    meet: Any
    see: Any
    of_texels: Any
    of_rays: Any


@intrinsic
def between_rows(context, above, below, column, down):  # noqa: ANN001, ANN201
    """Return two neighbouring columns of texels between two rows, and their growth downwards.

    Neighbours are loaded and blended as a vector of two, which halves the work of a lookup.
    """
    real = above.dtype

    def generate(context, builder, signature, arguments):  # noqa: ANN001, ANN202
        upper_row, lower_row, place, fraction = arguments
        pair = ir.VectorType(context.get_value_type(real), 2)
        first, second = (ir.Constant(ir.IntType(32), i) for i in range(2))

        def load(row):  # noqa: ANN001, ANN202
            address = builder.bitcast(builder.gep(row, [place]), pair.as_pointer())
            loaded = builder.load(address)
            loaded.align = real.bitwidth // 8
            return loaded

        flags = tuple(FASTMATH)
        upper = load(upper_row)
        growth = builder.fsub(load(lower_row), upper, flags=flags)
        fractions = ir.Constant(pair, ir.Undefined)
        for i in (first, second):
            fractions = builder.insert_element(fractions, fraction, i)
        value = builder.fadd(upper, builder.fmul(fractions, growth, flags=flags), flags=flags)
        elements = [builder.extract_element(v, i) for v in (value, growth) for i in (first, second)]
        return context.make_tuple(builder, signature.return_type, elements)

    return types.UniTuple(real, 4)(above, below, column, down), generate


@cache
def lookup(real: types.Type) -> Lookup:
    """Compile the functions for one real type.

    Textures have at least two texels each way, so that a texel always has neighbours.
    """
    zero, one, grazing = real(0.0), real(1.0), real(GRAZING)

    @njit(**OPTIONS)
    def arrive(state, scratch):  # noqa: ANN001, ANN202
        """Mark the rays that got through the lens; return their number."""
        src, rows = carray(state, STATE), carray(scratch, UNBOUNDED)
        total = zero
        for i in range(BLOCK):
            # Both are zero where nothing failed, and never negative.
            failed = src[ENDED + i] + src[VIGNETTED + i]
            passes = one if src[N + i] < zero else zero
            passes = passes if failed == zero else zero
            rows[ARRIVES + i] = passes
            total += passes
        return total

    @njit(**OPTIONS)
    def meet(lengths, depth, per_mm, width, state, scratch, texels):  # noqa: ANN001, ANN202
        """Carry rays to a plane; set the texel above and to the left, and fractions beyond it."""
        src, rows = carray(state, STATE), carray(scratch, UNBOUNDED)
        first = carray(int32_at(texels), BLOCK)
        middle_row, middle_column = lengths[TEXTURE_ROW], lengths[TEXTURE_COLUMN]
        last_row, last_column = lengths[LAST_ROW], lengths[LAST_COLUMN]
        before_row, before_column = last_row - one, last_column - one
        before_row = before_row if before_row > zero else zero
        before_column = before_column if before_column > zero else zero
        wide = types.int32(width)
        for i in range(BLOCK):
            cosine = -src[N + i]
            inverse = one / (cosine if cosine > grazing else grazing)
            t = (depth + src[Z + i]) * inverse
            row = middle_row - (src[Y + i] + t * src[M + i]) * per_mm
            column = middle_column + (src[X + i] + t * src[L + i]) * per_mm
            rows[PLANE_DISTANCE + i], rows[PER_COSINE + i] = t, inverse
            rows[ROWS_PER_MM + i] = -per_mm if row > zero and row < last_row else zero
            rows[COLUMNS_PER_MM + i] = per_mm if column > zero and column < last_column else zero
            row, column = row if row > zero else zero, column if column > zero else zero
            row = row if row < last_row else last_row
            column = column if column < last_column else last_column
            upper = row if row < before_row else before_row
            left = column if column < before_column else before_column
            upper_texel, left_texel = types.int32(upper), types.int32(left)
            rows[DOWN + i] = row - real(upper_texel)
            rows[ACROSS + i] = column - real(left_texel)
            first[i] = types.int32(types.int32(upper_texel * wide) + left_texel)

    @njit(**OPTIONS)
    def see(texture, width, texels, scratch, pixels):  # noqa: ANN001, ANN202
        """Add the samples' radiance, weighted, to their pixels."""
        rows, out = carray(scratch, UNBOUNDED), carray(pixels, BLOCK)
        first = carray(int32_at(texels), BLOCK)
        below = shifted(texture, width)
        for i in range(BLOCK):
            left, right, _, _ = between_rows(texture, below, types.int64(first[i]), rows[DOWN + i])
            shine = rows[SAMPLE_WEIGHT + i] * rows[ARRIVES + i]
            out[i] += shine * (left + rows[ACROSS + i] * (right - left))

    @njit(**OPTIONS)
    def of_texels(texture, width, texels, scratch, pixels):  # noqa: ANN001, ANN202
        """Add cotangents of row, column and weight, from those of the pixels."""
        rows, cot = carray(scratch, UNBOUNDED), carray(pixels, BLOCK)
        first = carray(int32_at(texels), BLOCK)
        below = shifted(texture, width)
        for i in range(BLOCK):
            left, right, of_left, of_right = between_rows(
                texture, below, types.int64(first[i]), rows[DOWN + i]
            )
            across = rows[ACROSS + i]
            rows[OF_ROW + i] += cot[i] * (of_left + across * (of_right - of_left))
            rows[OF_COLUMN + i] += cot[i] * (right - left)
            rows[OF_WEIGHT + i] += cot[i] * (left + across * (right - left))

    @njit(**OPTIONS)
    def of_rays(state, scratch, cotangents):  # noqa: ANN001, ANN202
        """Add the cotangents of rays to those of row and column, and clear these.

        With p = Q + t·d, t = (depth + z)/(-n): Q̄ = (x̄, ȳ, t̄/(-n)), d̄ = (t·x̄, t·ȳ, t·t̄/(-n)),
        where t̄ = x̄·l + ȳ·m.

        Returns:
            x̄·p_x + ȳ·p_y, summed: the cotangent of the logarithm of the plane's magnification.
        """
        src, rows = carray(state, STATE), carray(scratch, UNBOUNDED)
        cot = carray(cotangents, UNBOUNDED)
        total = zero
        for i in range(BLOCK):
            shine = rows[SAMPLE_WEIGHT + i] * rows[ARRIVES + i]
            y = shine * rows[OF_ROW + i] * rows[ROWS_PER_MM + i]
            x = shine * rows[OF_COLUMN + i] * rows[COLUMNS_PER_MM + i]
            t = rows[PLANE_DISTANCE + i]
            along = (x * src[L + i] + y * src[M + i]) * rows[PER_COSINE + i]
            cot[X + i] += x
            cot[Y + i] += y
            cot[Z + i] += along
            cot[L + i] += t * x
            cot[M + i] += t * y
            cot[N + i] += t * along
            total += x * (src[X + i] + t * src[L + i]) + y * (src[Y + i] + t * src[M + i])
            rows[OF_ROW + i], rows[OF_COLUMN + i] = zero, zero
        return total

    return Lookup(arrive, meet, see, of_texels, of_rays)


@cache
def texel_sums(real: types.Type) -> Any:
    """Compile the function that adds the cotangents of a block's pixels to a texture's sums."""
    one = real(1.0)

    @njit(**OPTIONS)
    def add_texels(sums, width, texels, scratch, pixels):  # noqa: ANN001, ANN202
        rows, cot = carray(scratch, UNBOUNDED), carray(pixels, BLOCK)
        first = carray(int32_at(texels), BLOCK)
        above, below = carray(sums, UNBOUNDED), carray(shifted(sums, width), UNBOUNDED)
        for i in range(BLOCK):
            k = types.uint64(first[i])
            amount = cot[i] * rows[SAMPLE_WEIGHT + i] * rows[ARRIVES + i]
            lower = amount * rows[DOWN + i]
            upper = amount - lower
            across = rows[ACROSS + i]
            above[k] += upper * (one - across)
            above[k + types.uint64(1)] += upper * across
            below[k] += lower * (one - across)
            below[k + types.uint64(1)] += lower * across

    return add_texels
