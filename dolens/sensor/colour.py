"""Linear light is converted to the sRGB encoding and back (IEC 61966-2-1)."""

import torch
from torch import Tensor

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
