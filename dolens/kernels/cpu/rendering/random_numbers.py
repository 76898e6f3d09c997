"""Counters give random numbers, the same bits as `dolens.rendering.sampling`."""

from numba import njit, types

from dolens.kernels.cpu.compiler import OPTIONS

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
