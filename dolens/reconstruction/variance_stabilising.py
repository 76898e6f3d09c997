"""Noise whose variance grows with the light is made even, and denoised means are undone without
bias.

A sensor's noise has variance a·x + b at light x: shot noise and read noise.  A function f whose
slope is one over the noise's standard deviation makes it 1 everywhere (Starck, Murtagh and Bijaoui,
Image Processing and Data Analysis, 1998):

    f(z) = 2/a · √(max(a·z + b, 0) + 3a²/8).

Denoising gives an estimate of the mean of f(z), which is not f of the mean.  Its inverse is that of
x ↦ E f(z) (Mäkitalo and Foi, IEEE Trans. Image Process. 22, 91, 2013), here of Gaussian noise, as
the noise of a filtered image nearly is.
"""

from typing import NamedTuple, Self

import numpy as np
import torch
from torch import Tensor

# Points of the table of E f, evenly spaced in √x, and of the quadrature over the noise.
_POINTS, _NODES = 1024, 48


class VarianceStabiliser(NamedTuple):
    """Makes noise of variance slope·x + offset one of variance 1, and back.

    Attributes:
        slope: a > 0, of each of C colours, (C,).
        offset: b ≥ 0, (C,).
    """

    slope: Tensor
    offset: Tensor

    @classmethod
    def of_filtered(cls, shot: float, read: float, gain: Tensor) -> Self:
        """Return that of an image that a linear filter has made of a sensor's.

        Light is taken for alike over the reach of the filter and over the colours.

        Args:
            shot: variance of the sensor's noise for each unit of light; above 0.
            read: variance in the dark.
            gain: variance of each colour where the sensor's noise has variance 1, (C,): Σ |w|² of
                the filter's weights.
        """
        gain = gain.double()
        return cls(gain * shot, gain * read)

    def stabilised(self, light: Tensor) -> Tensor:
        """Return f of images (..., C, H, W), in their dtype."""
        slope, offset = (v.to(light)[:, None, None] for v in self)
        root = ((slope * light + offset).clamp(min=0.0) + 0.375 * slope**2).sqrt()
        return 2.0 / slope * root

    def undone(self, values: Tensor) -> Tensor:
        """Return the light x whose E f(z) is given, (..., C, H, W), at least 0."""
        colours = [
            _interpolated(values[..., number, :, :], slope, offset)
            for number, (slope, offset) in enumerate(
                zip(self.slope.tolist(), self.offset.tolist(), strict=True)
            )
        ]
        return torch.stack(colours, dim=-3)


def _interpolated(values: Tensor, slope: float, offset: float) -> Tensor:
    """Return x of E f(z) by a table, whose end lies beyond the largest value."""
    largest = float(values.max())
    # f grows as √x, and its mean lies below it by less than 1.
    end = max((0.5 * slope * (largest + 1.0)) ** 2 / slope, 10.0 * slope)
    light = np.linspace(0.0, np.sqrt(end), _POINTS) ** 2
    nodes, weights = np.polynomial.hermite_e.hermegauss(_NODES)
    noisy = light[:, None] + np.sqrt(slope * light + offset)[:, None] * nodes
    root = np.sqrt(np.maximum(slope * noisy + offset, 0.0) + 0.375 * slope**2)
    means = 2.0 / slope * root @ (weights / weights.sum())
    found = np.interp(values.double().cpu().numpy(), means, light)
    return torch.from_numpy(found).to(values)
