"""Random noise: shot noise and read noise of pixels, from seeds, in any share of a batch."""

import hashlib
from typing import NamedTuple

import torch
from torch import Tensor


def noisy_point_spread_functions(
    functions: Tensor, electrons: float, read_noise: float, generator: torch.Generator
) -> Tensor:
    """Return point spread functions with simulated photon noise and read noise.

    A function h of sum Σh is measured with N electrons in the whole of it: pixel i counts a Poisson
    number n_i of mean N·h_i/Σh, and a normal number of the read noise is added.  The result
    is Σh·n_i/Σn, so that the measured function has the same sum.  Nothing is cut at zero.

    Args:
        functions: (..., K, K), not negative.
        electrons: N.
        read_noise: standard deviation, electrons a pixel.
        generator: on the CPU.

    Returns:
        (..., K, K), in the functions' dtype, without gradient.
    """
    exact = functions.detach().cpu().double().clamp(min=0.0)
    total = exact.sum((-2, -1), keepdim=True)
    counts = torch.poisson(electrons * exact / total, generator=generator)
    noise = torch.randn(counts.shape, dtype=counts.dtype, generator=generator)
    counts = counts + read_noise * noise
    return (total * counts / counts.sum((-2, -1), keepdim=True)).to(functions)


class BatchShare(NamedTuple):
    """A `BatchShare` says which images of a larger batch a process has.

    Random numbers are drawn for the whole batch, and each process keeps its own part of them, so
    that all processes together see what one process would see.

    Attributes:
        first: number in the batch of the first image here.
        total: images of the whole batch.
    """

    first: int
    total: int

    def normal(self, like: Tensor, generator: torch.Generator) -> Tensor:
        """Draw standard normal numbers for the whole batch, and return those of this share.

        Args:
            like: (B, ...), the images here.
            generator: on their device.

        Returns:
            (B, ...), of the images' precision.
        """
        shape = (self.total, *like.shape[1:])
        drawn = torch.randn(shape, generator=generator, device=like.device, dtype=like.dtype)
        return drawn[self.first : self.first + len(like)]


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


def generator_of(seed: int, device: torch.device | str = "cpu") -> torch.Generator:
    """Return a generator for a seed of any size.

    PyTorch's generator of the CPU (a Mersenne twister) takes the 32 lowest bits of a seed alone:
    seeds that differ by a multiple of 2³² would draw the same numbers.  Here the seed's BLAKE2b
    hash is the generator's seed.

    Args:
        seed: any integer.
        device: of the generator.
    """
    digest = hashlib.blake2b(str(seed).encode(), digest_size=8).digest()
    # The largest seed of a generator is 2⁶³ - 1.
    return torch.Generator(device).manual_seed(int.from_bytes(digest, "big") >> 1)
