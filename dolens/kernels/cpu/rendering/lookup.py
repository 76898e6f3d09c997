"""Where rays meet a textured plane, what they see there, and the adjoint of both.

It mirrors `distance_to_plane`, `texture_coordinates` and `bilinear` of the reference.
"""

from functools import cache
from typing import Any, NamedTuple

from llvmlite import ir
from numba import carray, njit, types
from numba.extending import intrinsic

from dolens.kernels.cpu.compiler import FASTMATH, OPTIONS, int32_at, shifted


class Lookup(NamedTuple):
    """Compiled functions between a block's rays and the texels of a plane."""

    arrive: Any
    meet: Any
    see: Any
    of_texels: Any
    of_rays: Any


@intrinsic
def between_rows(context, above, below, column, down):  # noqa: ANN001, ANN201
    """Two neighbouring columns of texels between two rows, and how they grow downwards.

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
    """The functions for one real type.

    Textures have at least two texels each way, so that a texel always has neighbours.
    """
    zero, one, grazing = real(0.0), real(1.0), real(1e-9)

    @njit(**OPTIONS)
    def arrive(state, scratch):  # noqa: ANN001, ANN202
        """Mark the rays that got through the lens; their number."""
        src, rows = carray(state, 1280), carray(scratch, 512)
        total = zero
        for i in range(128):
            # Both are zero where nothing failed, and never negative.
            failed = src[896 + i] + src[1024 + i]
            passes = one if src[640 + i] < zero else zero
            passes = passes if failed == zero else zero
            rows[384 + i] = passes
            total += passes
        return total

    @njit(**OPTIONS)
    def meet(lengths, depth, per_mm, width, state, scratch, texels):  # noqa: ANN001, ANN202
        """Carry rays to a plane: the texel above and to the left, and the fractions beyond it."""
        src, rows = carray(state, 1280), carray(scratch, 1280)
        first = carray(int32_at(texels), 128)
        middle_row, middle_column = lengths[7], lengths[8]
        last_row, last_column = lengths[9], lengths[10]
        before_row, before_column = last_row - one, last_column - one
        before_row = before_row if before_row > zero else zero
        before_column = before_column if before_column > zero else zero
        wide = types.int32(width)
        for i in range(128):
            cosine = -src[640 + i]
            inverse = one / (cosine if cosine > grazing else grazing)
            t = (depth + src[256 + i]) * inverse
            row = middle_row - (src[128 + i] + t * src[512 + i]) * per_mm
            column = middle_column + (src[i] + t * src[384 + i]) * per_mm
            rows[768 + i], rows[896 + i] = t, inverse
            rows[1024 + i] = -per_mm if row > zero and row < last_row else zero
            rows[1152 + i] = per_mm if column > zero and column < last_column else zero
            row, column = row if row > zero else zero, column if column > zero else zero
            row = row if row < last_row else last_row
            column = column if column < last_column else last_column
            upper = row if row < before_row else before_row
            left = column if column < before_column else before_column
            upper_texel, left_texel = types.int32(upper), types.int32(left)
            rows[512 + i] = row - real(upper_texel)
            rows[640 + i] = column - real(left_texel)
            first[i] = types.int32(types.int32(upper_texel * wide) + left_texel)

    @njit(**OPTIONS)
    def see(texture, width, texels, scratch, pixels):  # noqa: ANN001, ANN202
        """Add the samples' radiance, weighted, to their pixels."""
        rows, out = carray(scratch, 1280), carray(pixels, 128)
        first = carray(int32_at(texels), 128)
        below = shifted(texture, width)
        for i in range(128):
            left, right, _, _ = between_rows(texture, below, types.int64(first[i]), rows[512 + i])
            out[i] += rows[256 + i] * rows[384 + i] * (left + rows[640 + i] * (right - left))

    @njit(**OPTIONS)
    def of_texels(texture, width, texels, scratch, pixels):  # noqa: ANN001, ANN202
        """Add cotangents of row, column and weight, from those of the pixels."""
        rows, cot = carray(scratch, 1664), carray(pixels, 128)
        first = carray(int32_at(texels), 128)
        below = shifted(texture, width)
        for i in range(128):
            left, right, of_left, of_right = between_rows(
                texture, below, types.int64(first[i]), rows[512 + i]
            )
            across = rows[640 + i]
            rows[1280 + i] += cot[i] * (of_left + across * (of_right - of_left))
            rows[1408 + i] += cot[i] * (right - left)
            rows[1536 + i] += cot[i] * (left + across * (right - left))

    @njit(**OPTIONS)
    def of_rays(state, scratch, cotangents):  # noqa: ANN001, ANN202
        """Add the cotangents of rays to those of row and column, and clear these.

        With p = Q + t·d, t = (depth + z)/(-n): Q̄ = (x̄, ȳ, t̄/(-n)), d̄ = (t·x̄, t·ȳ, t·t̄/(-n)),
        where t̄ = x̄·l + ȳ·m.

        Returns:
            x̄·p_x + ȳ·p_y, summed: the cotangent of the logarithm of the plane's magnification.
        """
        src, rows, cot = carray(state, 1280), carray(scratch, 1664), carray(cotangents, 768)
        total = zero
        for i in range(128):
            shine = rows[256 + i] * rows[384 + i]
            y = shine * rows[1280 + i] * rows[1024 + i]
            x = shine * rows[1408 + i] * rows[1152 + i]
            t = rows[768 + i]
            along = (x * src[384 + i] + y * src[512 + i]) * rows[896 + i]
            cot[i] += x
            cot[128 + i] += y
            cot[256 + i] += along
            cot[384 + i] += t * x
            cot[512 + i] += t * y
            cot[640 + i] += t * along
            total += x * (src[i] + t * src[384 + i]) + y * (src[128 + i] + t * src[512 + i])
            rows[1280 + i], rows[1408 + i] = zero, zero
        return total

    return Lookup(arrive, meet, see, of_texels, of_rays)


@cache
def texel_sums(real: types.Type) -> Any:
    """Compiled: add what a block's pixels ask of the texels to a texture's sums."""
    one = real(1.0)

    @njit(**OPTIONS)
    def add_texels(sums, width, texels, scratch, pixels):  # noqa: ANN001, ANN202
        rows, cot = carray(scratch, 1280), carray(pixels, 128)
        first = carray(int32_at(texels), 128)
        above, below = carray(sums, 1 << 40), carray(shifted(sums, width), 1 << 40)
        for i in range(128):
            k = types.uint64(first[i])
            amount = cot[i] * rows[256 + i] * rows[384 + i]
            lower = amount * rows[512 + i]
            upper = amount - lower
            across = rows[640 + i]
            above[k] += upper * (one - across)
            above[k + types.uint64(1)] += upper * across
            below[k] += lower * (one - across)
            below[k + types.uint64(1)] += lower * across

    return add_texels
