"""Counter-based random numbers: their definition, their bits on every backend, their statistics."""

import itertools
import math

import pytest
import torch

from dolens.rendering.sampling import random_words, uniform

MASK = 2**32 - 1


def pcg4d(*words):
    """The published hash in unbounded integers: two rounds about a shift."""
    v = [(word * 1664525 + 1013904223) & MASK for word in words]

    def mix():
        for a, b, c in ((0, 1, 3), (1, 2, 0), (2, 0, 1), (3, 1, 2)):
            v[a] = (v[a] + v[b] * v[c]) & MASK

    mix()
    for i in range(4):
        v[i] ^= v[i] >> 16
    mix()
    return tuple(v)


COUNTERS = [
    (0, 0, 0),
    (1, 0, 0),
    (0, 1, 0),
    (0, 0, 1),
    (65535, 48, 2**32),
    (2**32 - 1, 2**32 - 1, 2**64 - 1),
    (123456789, 99, 987654321987654321),
]


@pytest.mark.parametrize(("pixel", "sample", "seed"), COUNTERS)
def test_words_are_the_published_hash(pixel, sample, seed):
    words = random_words(seed, torch.tensor(pixel), torch.tensor(sample))
    assert tuple(map(int, words)) == pcg4d(pixel, sample, seed & MASK, seed >> 32)


def test_kernels_have_the_same_bits():
    """They are called from compiled code, as kernels do: Python cannot call them."""
    import numpy as np
    from numba import njit

    from dolens.kernels.cpu.rendering import pixel_samples as kernel

    words_of, bits_of = kernel.random_words, kernel.upper_bits

    @njit
    def drawn(pixel, sample, low, high):
        words = words_of(pixel, sample, low, high)
        return words, (bits_of(words[0]), bits_of(words[1]), bits_of(words[2]), bits_of(words[3]))

    for pixel, sample, seed in COUNTERS:
        counters = (np.uint32(c) for c in (pixel, sample, seed & MASK, seed >> 32))
        found, upper = drawn(*counters)
        expected = random_words(seed, torch.tensor(pixel), torch.tensor(sample))
        assert tuple(map(int, found)) == tuple(map(int, expected))
        numbers = [uniform(word, torch.float64) for word in expected]
        assert [int(u) * 2.0**-24 for u in upper] == [float(n) for n in numbers]


def test_numbers_are_the_same_in_either_precision():
    words = random_words(5, torch.arange(1000)[:, None], torch.arange(49))
    for word in words:
        single = uniform(word, torch.float32)
        assert torch.equal(single.double(), uniform(word, torch.float64))
        assert float(single.min()) >= 0.0 and float(single.max()) < 1.0


def test_negative_seeds_and_bits_beyond_64_are_seeds_too():
    pixel, sample = torch.arange(4), torch.zeros(4, dtype=torch.int64)
    wrapped = random_words(2**64 - 3, pixel, sample)
    assert all(map(torch.equal, random_words(-3, pixel, sample), wrapped))


def numbers(seed, pixels, samples):
    """Four tensors (seeds, pixels, samples) of numbers as a renderer asks for them."""
    pixel, sample = torch.arange(pixels)[:, None], torch.arange(samples)
    words = [random_words(s, pixel, sample) for s in seed]
    return [uniform(torch.stack(w), torch.float64) for w in zip(*words, strict=True)]


@pytest.fixture(scope="module")
def render():
    """What eight neighbouring seeds give a sensor of 128 × 64 pixels with 25 samples."""
    return numbers(range(8), 128 * 64, 25)


def surprise(counts, cells):
    """χ² of counts over equal cells, in standard deviations from its mean."""
    expected = float(counts.sum()) / cells
    chi2 = float(((counts - expected) ** 2).sum()) / expected
    return (chi2 - (cells - 1)) / math.sqrt(2 * (cells - 1))


def test_every_dimension_is_equidistributed(render):
    for dimension in render:
        cells = (dimension * 4096).long().flatten()
        assert abs(surprise(torch.bincount(cells, minlength=4096).double(), 4096)) < 4.5
        # Bits further down too: the fraction of the cell.
        cells = ((dimension * 4096 % 1.0) * 4096).long().flatten()
        assert abs(surprise(torch.bincount(cells, minlength=4096).double(), 4096)) < 4.5


NEIGHBOURS = {
    "sample": lambda t: (t[..., 1:], t[..., :-1]),
    "pixel": lambda t: (t[:, 1:], t[:, :-1]),
    "row": lambda t: (t[:, 128:], t[:, :-128]),
    "seed": lambda t: (t[1:], t[:-1]),
    "stride": lambda t: (t[:, 64::2], t[:, :-64:2]),
}


def pairs(dimensions):
    """Pairs of numbers that must know nothing of one another, by name."""
    for (i, a), (j, b) in itertools.combinations(enumerate(dimensions), 2):
        yield f"dimensions {i}, {j}", a, b
    for name, shift in NEIGHBOURS.items():
        for i, a in enumerate(dimensions):
            for j, b in enumerate(dimensions):
                yield f"{name}, dimensions {i}, {j}", shift(a)[0], shift(b)[1]


def test_dimensions_and_neighbours_are_independent(render):
    for name, a, b in pairs(render):
        a, b = a.flatten(), b.flatten()
        correlation = float(((a - 0.5) * (b - 0.5)).mean()) * 12
        assert abs(correlation) < 4.5 / math.sqrt(len(a)), name
        cells = (a * 32).long() * 32 + (b * 32).long()
        assert abs(surprise(torch.bincount(cells, minlength=1024).double(), 1024)) < 4.5, name


def test_means_over_a_pixel_s_samples_scatter_as_those_of_independent_numbers(render):
    for dimension in render:
        scatter = float(dimension.mean(-1).var()) * 12 * 25
        count = dimension[..., 0].numel()
        assert scatter == pytest.approx(1.0, abs=4.5 * math.sqrt(2 / count))
