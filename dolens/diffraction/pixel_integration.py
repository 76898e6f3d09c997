"""From irradiance on the sensor to what pixels collect of it."""

import torch
from torch import Tensor


def quadratic_b_spline(u: Tensor) -> Tensor:
    """β(u): a unit box convolved with itself twice; 3/4 - u² near zero, zero from |u| = 3/2 on."""
    u = u.abs()
    return torch.where(u < 0.5, 0.75 - u * u, 0.5 * (1.5 - u).clamp(min=0.0).square())


def fine_grid(size: int, subsamples: int, like: Tensor) -> Tensor:
    """Where light on a window of pixels is sampled: centres of cells, in pixels from its middle.

    Args:
        size: pixels along a side.
        subsamples: cells a pixel.
        like: gives precision and device.

    Returns:
        (subsamples·(size + 2),), ascending; β reaches a pixel beyond the window.
    """
    count = subsamples * (size + 2)
    cells = torch.arange(count, dtype=like.dtype, device=like.device)
    return (cells + 0.5) / subsamples - 0.5 * (size + 2)


def pixel_matrix(size: int, subsamples: int, like: Tensor) -> Tensor:
    """β(x/p - i) of every pixel i at the samples x of `fine_grid`.

    β is a pixel's box convolved with a texel's tent, as in `dolens.rendering.psf`.  With B this
    matrix times the samples' distance, B·I·Bᵀ is what pixels collect of the irradiance I: exactly,
    where I has no frequency that a multiple of the samples' own takes to where β has one.

    Args:
        size: pixels along a side.
        subsamples: samples a pixel.
        like: gives precision and device.

    Returns:
        (size, subsamples·(size + 2)).  The pixels' shares of a sample add up to one within the
        window.
    """
    pixel = torch.arange(size, dtype=like.dtype, device=like.device) - 0.5 * (size - 1)
    return quadratic_b_spline(fine_grid(size, subsamples, like) - pixel[:, None])
