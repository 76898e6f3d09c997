"""A Gaussian blur makes images comparable from farther away."""

import math

import torch
from torch import Tensor


def blurred(images: Tensor, deviation: float) -> Tensor:
    """Return images (..., height, width) convolved with a Gaussian.

    The standard deviation is in pixels; 0 leaves the images as they are.  Light that leaves at the
    edges is lost.  The operation is its own transpose.
    """
    if deviation == 0.0:
        return images
    down, across = (_gaussian(n, deviation, images) for n in images.shape[-2:])
    return down @ images @ across


def noise_left(deviation: float) -> float:
    """Return the variance that independent noise of variance 1 keeps when it is blurred, Σ
    kernel².
    """
    if deviation == 0.0:
        return 1.0
    length = 2 * 4 * math.ceil(deviation) + 1
    kernel = _gaussian(length, deviation, torch.zeros((), dtype=torch.float64))[length // 2]
    return float(kernel.square().sum()) ** 2


def _gaussian(length: int, deviation: float, like: Tensor) -> Tensor:
    """Return the convolution with a Gaussian along one side, (length, length), symmetric."""
    place = torch.arange(length, dtype=like.dtype, device=like.device)
    far = (place[:, None] - place) / deviation
    step = torch.arange(-4 * math.ceil(deviation), 4 * math.ceil(deviation) + 1).to(like)
    return torch.exp(-0.5 * far.square()) / torch.exp(-0.5 * (step / deviation).square()).sum()
