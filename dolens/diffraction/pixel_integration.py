"""From irradiance on the sensor to what pixels collect of it."""

from dataclasses import dataclass

import torch
from torch import Tensor

from dolens.errors import InputError


@dataclass(frozen=True)
class PixelWindow:
    """A square window of pixels about a point of the sensor.

    Attributes:
        pitch: of the pixels, mm.
        size: pixels along each side.

    Raises:
        InputError: a pitch that is not positive, or no pixel.
    """

    pitch: float
    size: int

    def __post_init__(self) -> None:
        if not self.pitch > 0.0 or self.size < 1:
            raise InputError(
                f"pitch must be positive and size at least 1, not {self.pitch} and {self.size}"
            )

    @property
    def half_width(self) -> float:
        """mm, of what `fine_grid` covers."""
        return self.pitch * (0.5 * self.size + 1.0)


def quadratic_b_spline(u: Tensor) -> Tensor:
    """β(u): a unit box convolved with itself twice; 3/4 - u² near zero, zero from |u| = 3/2 on."""
    u = u.abs()
    return torch.where(u < 0.5, 0.75 - u * u, 0.5 * (1.5 - u).clamp(min=0.0).square())


def fine_grid(size: int, subsamples: int, like: Tensor) -> Tensor:
    """Return the samples along a window of pixels: centres of cells, in pixels from its middle.

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
