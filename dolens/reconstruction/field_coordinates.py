"""Field coordinates give a network the position of each pixel, because blur varies over the
field.
"""

import torch
from torch import Tensor

from dolens.errors import InputError

FIELD_CHANNELS = 3


def field_channels(field: Tensor) -> Tensor:
    """Turn coordinates (B, 2, H, W) into the channels x, y and r² = x² + y², (B, 3, H, W).

    x and y tell the sagittal direction from the tangential.  r² is there because a centred
    lens's blur grows with even powers of r, and a convolution, being linear, cannot make the
    first of them from x and y; r itself has a kink on the axis.
    """
    return torch.cat([field, field.square().sum(dim=1, keepdim=True)], dim=1)


def with_field_channels(image: Tensor, field: Tensor) -> Tensor:
    """Append the field's channels to an image: (B, C, H, W) and (B, 2, H, W) → (B, C + 3, H, W).

    The field takes the image's dtype.

    Raises:
        InputError: the field is not of shape (B, 2, H, W) with the image's B, H and W.
    """
    batch, _, height, width = image.shape
    if field.shape != (batch, 2, height, width):
        raise InputError(
            f"field of shape {tuple(field.shape)}: must be {(batch, 2, height, width)}, x and y "
            "of each pixel over half the sensor's diagonal"
        )
    return torch.cat([image, field_channels(field.to(image.dtype))], dim=1)


def required_field(field: Tensor | None, network: str) -> Tensor:
    """Return the field that a network with field coordinates needs.

    Args:
        field: (B, 2, H, W), or None.
        network: its class's name; the message begins with it.

    Raises:
        InputError: the field is None.
    """
    if field is None:
        raise InputError(
            f"{network} with field_coordinates=true needs `field`, the pixels' coordinates on the "
            "sensor, got None: give (B, 2, H, W), or field_coordinates=false"
        )
    return field
