"""Fourier transforms are fast when their lengths are products of small primes."""

from scipy.fft import next_fast_len


def fast_fft_length(length: int) -> int:
    """Return the smallest product of twos, threes and fives that is at least `length`."""
    return next_fast_len(max(length, 1), real=True)


def even_fft_length(length: int) -> int:
    """Return the smallest even product of twos, threes and fives that is at least `length`."""
    return 2 * fast_fft_length((length + 1) // 2)
