"""Lengths of Fourier transforms are the next products of small primes."""

import pytest

from dolens.fft_lengths import even_fft_length, fast_fft_length


def test_a_fast_length_is_the_next_product_of_small_primes():
    lengths = [1, 7, 11, 17, 31, 64, 301, 320]
    assert [fast_fft_length(n) for n in lengths] == [1, 8, 12, 18, 32, 64, 320, 320]


@pytest.mark.parametrize("length", [1, 2, 7, 31, 97, 211, 320, 641])
def test_an_even_length_is_the_next_even_one_with_small_factors(length):
    def smooth(number):
        for factor in (2, 3, 5):
            while number % factor == 0:
                number //= factor
        return number == 1

    found = even_fft_length(length)
    assert found % 2 == 0 and smooth(found)
    assert not any(smooth(n) for n in range(length, found) if n % 2 == 0)
