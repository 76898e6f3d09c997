"""Colour: the sRGB encoding (IEC 61966-2-1), and Bayer's filter array and its interpolation."""

import torch
from torch import Tensor
from torch.nn import functional

from dolens.errors import InputError, check_choice

_LINEAR_LIMIT = 0.0031308
_ENCODED_LIMIT = 0.04045


def linear_to_srgb(linear: Tensor) -> Tensor:
    """Encode linear light for display.

    Args:
        linear: relative radiance, any shape; values outside [0, 1] are clamped.

    Returns:
        sRGB values in [0, 1], the shape and dtype of the input.  The slope at black is
        12.92, so gradients stay finite.
    """
    linear = linear.clamp(0.0, 1.0)
    toe = 12.92 * linear
    power = 1.055 * linear.clamp(min=_LINEAR_LIMIT) ** (1 / 2.4) - 0.055
    return torch.where(linear <= _LINEAR_LIMIT, toe, power)


def srgb_to_linear(encoded: Tensor) -> Tensor:
    """Decode sRGB values in [0, 1] to linear light; the inverse of `linear_to_srgb`."""
    toe = encoded / 12.92
    power = ((encoded.clamp(min=_ENCODED_LIMIT) + 0.055) / 1.055) ** 2.4
    return torch.where(encoded <= _ENCODED_LIMIT, toe, power)


# The filters of rows 0 and 1, columns 0 and 1 → row and column of the red one; the blue one is
# across the corner, the others are green.
PATTERNS = {"RGGB": (0, 0), "GRBG": (0, 1), "GBRG": (1, 0), "BGGR": (1, 1)}


def mosaic(image: Tensor, pattern: str) -> Tensor:
    """Sample an image through a colour filter array.

    Args:
        image: (..., 3, H, W): red, green, blue.
        pattern: the filters of the upper left 2×2 pixels, row by row, as `RGGB`.

    Returns:
        (..., 1, H, W): of each pixel the colour of its filter.

    Raises:
        InputError: an unknown pattern, or not three channels.
    """
    if image.dim() < 3 or image.shape[-3] != 3:
        raise InputError(
            f"mosaic: a pattern of red, green and blue filters needs images (..., 3, H, W), "
            f"not {tuple(image.shape)}"
        )
    red_row, red_column = _red_rows_and_columns(image, pattern)
    red, green, blue = image.split(1, dim=-3)
    return torch.where(red_row == red_column, torch.where(red_row, red, blue), green)


def demosaic(raw: Tensor, pattern: str) -> Tensor:
    """Interpolate the three colours of each pixel by gradient-corrected linear interpolation.

    Malvar, He and Cutler, "High-quality linear interpolation for demosaicing of Bayer-patterned
    color images" (ICASSP 2004), their Fig. 2: the mean of the nearest pixels of the wanted colour,
    corrected by the Laplacian of the pixel's own colour.  A measured colour stays as it is.
    Beyond the edge the raw image goes on as its mirror image about the outermost pixels' centres,
    row -k as row k: an even distance, so that the filters go on in their order.

    Uniform colours come out exactly, and so do linear ramps, each colour with a slope of its own,
    two pixels away from the edge.  Linear in the raw image, hence differentiable.

    Args:
        raw: (..., 1, H, W), at least 3×3 pixels; even and odd sizes.
        pattern: the filters of the upper left 2×2 pixels, row by row, as `RGGB`.

    Returns:
        (..., 3, H, W): red, green, blue.

    Raises:
        InputError: an unknown pattern, not one channel, or fewer pixels.
    """
    if raw.dim() < 3 or raw.shape[-3] != 1 or min(raw.shape[-2:]) < 3:
        raise InputError(
            f"demosaic: needs raw images (..., 1, H, W) of 3×3 pixels or more, "
            f"not {tuple(raw.shape)}"
        )
    red_row, red_column = _red_rows_and_columns(raw, pattern)
    height, width = raw.shape[-2:]
    flat = raw.reshape(-1, 1, height, width)
    padded = functional.pad(flat, (2, 2, 2, 2), mode="reflect").reshape(
        *raw.shape[:-2], height + 4, width + 4
    )

    def at(row: int, column: int) -> Tensor:
        """Return the pixels that lie so many rows below and columns right of each."""
        return padded[..., 2 + row : 2 + row + height, 2 + column : 2 + column + width]

    beside, above = at(0, -1) + at(0, 1), at(-1, 0) + at(1, 0)
    beside_2, above_2 = at(0, -2) + at(0, 2), at(-2, 0) + at(2, 0)
    corners = at(-1, -1) + at(-1, 1) + at(1, -1) + at(1, 1)
    cross = 0.125 * (4.0 * raw + 2.0 * (beside + above) - beside_2 - above_2)
    from_beside = 0.125 * (5.0 * raw + 4.0 * beside - corners - beside_2 + 0.5 * above_2)
    from_above = 0.125 * (5.0 * raw + 4.0 * above - corners - above_2 + 0.5 * beside_2)
    from_corners = 0.125 * (6.0 * raw + 2.0 * corners - 1.5 * (beside_2 + above_2))

    # A green pixel of a red row has red pixels beside it and blue ones above and below.
    red = torch.where(
        red_row,
        torch.where(red_column, raw, from_beside),
        torch.where(red_column, from_above, from_corners),
    )
    green = torch.where(red_row == red_column, cross, raw)
    blue = torch.where(
        red_row,
        torch.where(red_column, from_corners, from_above),
        torch.where(red_column, from_beside, raw),
    )
    return torch.cat((red, green, blue), dim=-3)


def _red_rows_and_columns(image: Tensor, pattern: str) -> tuple[Tensor, Tensor]:
    """Return whether rows (H, 1) and columns (W,) hold red filters; the others hold blue ones."""
    check_choice(pattern, PATTERNS, "pattern")
    row, column = PATTERNS[pattern]
    height, width = image.shape[-2:]
    rows = torch.arange(height, device=image.device) % 2 == row
    columns = torch.arange(width, device=image.device) % 2 == column
    return rows[:, None], columns
