"""Colour filters, and the colours interpolated between them."""

import numpy as np
import pytest
import torch

from dolens.sensor.colour import PATTERNS, demosaic, mosaic
from tests.refused import refused

SIZES = [(3, 3), (4, 6), (5, 4), (7, 9)]

# Malvar, He and Cutler (2004), Fig. 2, in eighths, centred on the pixel that lacks the colour.
GREEN = """ 0  0  -1   0  0
            0  0   2   0  0
           -1  2   4   2 -1
            0  0   2   0  0
            0  0  -1   0  0"""
BESIDE = """ 0  0  0.5  0  0
             0 -1   0  -1  0
            -1  4   5   4 -1
             0 -1   0  -1  0
             0  0  0.5  0  0"""
CORNERS = """ 0   0 -1.5  0   0
              0   2   0   2   0
            -1.5  0   6   0 -1.5
              0   2   0   2   0
              0   0 -1.5  0   0"""


def random(*shape, seed=0):
    return torch.rand(
        shape,
        dtype=torch.float64,
        generator=torch.Generator().manual_seed(seed),
        requires_grad=True,
    )


def filters(pattern, height, width):
    """The letter over every pixel."""
    return [[pattern[2 * (i % 2) + j % 2] for j in range(width)] for i in range(height)]


def published_kernel(pattern, row, column, colour):
    """What the paper applies at a pixel for a colour, in eighths of the raw values around it."""
    around = filters(pattern, row + 2, column + 2)
    own, beside = around[row][column], around[row][column + 1]
    if own == colour:
        text = "0 0 0 0 0  0 0 0 0 0  0 0 8 0 0  0 0 0 0 0  0 0 0 0 0"
    elif colour == "G":
        text = GREEN
    elif own != "G":
        text = CORNERS
    else:
        text = BESIDE
    kernel = np.array(text.split(), float).reshape(5, 5)
    return kernel.T if own == "G" and colour not in ("G", beside) else kernel


def ramps(height, width, slopes):
    rows, columns = np.mgrid[:height, :width]
    return torch.tensor(np.array([a + b * rows + c * columns for a, b, c in slopes]))


@pytest.mark.parametrize("pattern", PATTERNS)
@pytest.mark.parametrize("size", SIZES)
def test_a_pixel_sees_the_colour_of_its_filter(pattern, size):
    image = random(3, *size)
    raw = mosaic(image, pattern)
    assert raw.shape == (1, *size)
    for i, row in enumerate(filters(pattern, *size)):
        for j, letter in enumerate(row):
            assert raw[0, i, j] == image["RGB".index(letter), i, j]


@pytest.mark.parametrize("pattern", PATTERNS)
def test_the_coefficients_are_the_published_ones(pattern):
    raw = random(1, 10, 10)
    colours = demosaic(raw, pattern)
    for row in (4, 5):
        for column in (4, 5):
            for channel, colour in enumerate("RGB"):
                (weights,) = torch.autograd.grad(
                    colours[channel, row, column], raw, retain_graph=True
                )
                expected = np.zeros((10, 10))
                expected[row - 2 : row + 3, column - 2 : column + 3] = published_kernel(
                    pattern, row, column, colour
                )
                np.testing.assert_array_equal(8.0 * weights[0].numpy(), expected)


@pytest.mark.parametrize("pattern", PATTERNS)
@pytest.mark.parametrize("size", SIZES)
def test_a_uniform_colour_is_exact_to_the_edges(pattern, size):
    colour = torch.tensor([0.8, 0.3, 0.1], dtype=torch.float64)[:, None, None].expand(3, *size)
    torch.testing.assert_close(
        demosaic(mosaic(colour, pattern), pattern), colour, rtol=1e-15, atol=0
    )


@pytest.mark.parametrize("pattern", PATTERNS)
@pytest.mark.parametrize("size", [(8, 9), (7, 6)])
def test_linear_ramps_are_exact_inside_each_colour_with_its_own_slope(pattern, size):
    image = ramps(*size, [(0.1, 0.02, 0.03), (0.5, -0.04, 0.01), (0.9, 0.01, -0.05)])
    inside = demosaic(mosaic(image, pattern), pattern)[:, 2:-2, 2:-2]
    torch.testing.assert_close(inside, image[:, 2:-2, 2:-2], rtol=0, atol=1e-15)


@pytest.mark.parametrize("pattern", PATTERNS)
@pytest.mark.parametrize("size", SIZES)
def test_measured_values_stay_to_the_bit(pattern, size):
    raw = random(2, 1, *size)
    assert torch.equal(mosaic(demosaic(raw, pattern), pattern), raw)


@pytest.mark.parametrize("pattern", PATTERNS)
@pytest.mark.parametrize("size", [(5, 6), (6, 7)])
def test_beyond_the_edge_the_image_goes_on_mirrored_with_the_filters_in_order(pattern, size):
    image = random(3, *size).detach()
    mirrored = torch.tensor(np.pad(image.numpy(), ((0, 0), (4, 4), (4, 4)), mode="reflect"))
    # Four pixels more do not shift the pattern; the mirror image of each filter must be one too.
    raw = mosaic(image, pattern)
    wider = mosaic(mirrored, pattern)
    np.testing.assert_array_equal(
        wider[0].numpy(), np.pad(raw[0].numpy(), 4, mode="reflect"), strict=True
    )
    expected = demosaic(wider, pattern)[:, 4:-4, 4:-4]
    torch.testing.assert_close(demosaic(raw, pattern), expected, rtol=0, atol=1e-15)


def test_a_pattern_is_another_one_seen_from_its_next_pixel():
    raw = random(1, 9, 10)
    whole = demosaic(raw, "RGGB")
    for pattern, row, column in (("GRBG", 0, 1), ("GBRG", 1, 0), ("BGGR", 1, 1)):
        part = demosaic(raw[:, row:, column:], pattern)
        torch.testing.assert_close(part[:, 2:, 2:], whole[:, row + 2 :, column + 2 :])


def test_many_images_at_once_are_each_alone():
    raw = random(2, 3, 1, 6, 5)
    colours = demosaic(raw, "GBRG")
    assert colours.shape == (2, 3, 3, 6, 5)
    assert torch.equal(colours[1, 2], demosaic(raw[1, 2], "GBRG"))


def test_the_precision_is_the_image_s():
    image = random(3, 6, 6).float()
    assert demosaic(mosaic(image, "RGGB"), "RGGB").dtype == torch.float32


def test_gradients_are_those_of_finite_differences():
    def there_and_back(image):
        return demosaic(mosaic(image, "GRBG"), "GRBG")

    assert torch.autograd.gradcheck(there_and_back, random(3, 5, 4))


BAD_INPUT = {
    "pattern of a mosaic": (lambda: mosaic(random(3, 4, 4), "RGBG"), "'RGBG' is unknown"),
    "pattern of a raw image": (lambda: demosaic(random(1, 4, 4), "rggb"), "RGGB, GRBG, GBRG, BGGR"),
    "one channel to a mosaic": (lambda: mosaic(random(1, 4, 4), "RGGB"), r"(1, 4, 4)"),
    "no channel to a mosaic": (lambda: mosaic(random(4, 4), "RGGB"), "(..., 3, H, W)"),
    "three channels of raw": (lambda: demosaic(random(3, 4, 4), "RGGB"), "(..., 1, H, W)"),
    "two rows": (lambda: demosaic(random(1, 2, 9), "RGGB"), "3×3 pixels or more, not (1, 2, 9)"),
}


@pytest.mark.parametrize("case", BAD_INPUT)
def test_bad_input_gives_one_clear_line(case):
    call, expected = BAD_INPUT[case]
    with refused(expected):
        call()
