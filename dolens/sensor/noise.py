"""A pixel has shot noise, from the light, and read noise, from the electronics."""

import torch
from torch import Tensor

from dolens.sensor.batch_share import BatchShare


def add_read_noise(
    image: Tensor, sigma: float, generator: torch.Generator, share: BatchShare | None = None
) -> Tensor:
    """Add Gaussian read noise.

    Args:
        image: linear light, 1 is full scale.
        sigma: standard deviation in units of full scale; 0 returns the image itself.
        generator: the source of randomness, on the image's device.
        share: of a batch whose images these are (B, ...); None: they are all of it.

    Returns:
        The noisy image, not clipped: a real sensor's black level keeps negative noise too.
    """
    if sigma == 0.0:
        return image
    return image + sigma * _normal(image, generator, share)


def add_shot_noise(
    image: Tensor, full_well: float, generator: torch.Generator, share: BatchShare | None = None
) -> Tensor:
    """Add shot noise, as a Gaussian whose variance follows the light.

    A pixel of irradiance s collects a Poisson number of electrons of mean and variance N·s, with
    N the full well.  Here n = s + σ(N·s)/N · z with z from the standard normal distribution and
    σ from `shot_noise_deviation`: mean and variance are Poisson's, and ∂n/∂s has the mean's 1 and
    the deviation's share, which counting itself cannot give.  Poisson's skewness, (N·s)^(-1/2),
    and its whole numbers are lost; from some 20 electrons on the two are hard to tell apart.

    Args:
        image: linear light, 1 is full scale; below 0 there is no shot noise.
        full_well: N, electrons at full scale.
        generator: the source of randomness, on the image's device.
        share: of a batch whose images these are (B, ...); None: they are all of it.

    Returns:
        The noisy image, not clipped.
    """
    noise = _normal(image, generator, share)
    return image + shot_noise_deviation(full_well * image) / full_well * noise


def shot_noise_deviation(electrons: Tensor) -> Tensor:
    """Return the standard deviation of a number of electrons whose mean is given.

    It is √μ, Poisson's, from one electron on.  The slope of √μ has no bound towards the dark, and
    a Gaussian is no model of less than one electron; there it is (3μ - μ²)/2, which meets √μ in
    value and slope, ends at 0 with slope 3/2, and keeps the variance within 0.14 of Poisson's.

    Args:
        electrons: μ, any shape; below 0 the deviation is 0.
    """
    # Either branch is finite, with its gradient, where the other one is taken.  At no light the
    # gradient is the slope towards more; clamp's own differs between versions of torch.
    dim = torch.where(electrons < 0.0, 0.0, electrons)
    bright = torch.where(electrons < 1.0, 1.0, electrons).sqrt()
    return torch.where(electrons < 1.0, 0.5 * dim * (3.0 - dim), bright)


def _normal(image: Tensor, generator: torch.Generator, share: BatchShare | None) -> Tensor:
    """Return standard normal numbers of an image's shape."""
    if share is not None:
        return share.normal(image, generator)
    return torch.randn(image.shape, generator=generator, device=image.device, dtype=image.dtype)
