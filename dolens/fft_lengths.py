"""Fourier transforms are fast when their lengths are products of small primes."""


def fast_fft_length(length: int) -> int:
    """Return the smallest product of twos, threes and fives that is at least `length`."""
    candidate = max(length, 1)
    while True:
        rest = candidate
        for factor in (2, 3, 5):
            while rest % factor == 0:
                rest //= factor
        if rest == 1:
            return candidate
        candidate += 1


def even_fft_length(length: int) -> int:
    """Return the smallest even product of twos, threes and fives that is at least `length`."""
    return 2 * fast_fft_length((length + 1) // 2)
