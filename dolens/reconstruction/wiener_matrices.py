"""The Wiener deconvolution of images of one size by products of real matrices.

Programs that run networks elsewhere lack the Fourier transform of `wiener_deconvolve`, or compute
it inexactly.  For a fixed size it is four products with matrices of cosines and sines:

    spectrum = F_R·image·F_Cᵀ,   F = C - iS,   C_jk = cos(2π·jk/N),   S_jk = sin(2π·jk/N).

The filter is computed once and stored, so nothing of the point spread function is left to compute.
"""

import math

import torch
from torch import Tensor, nn

from dolens.reconstruction.restoration import WienerUNetRestoration
from dolens.reconstruction.wiener import close_periodically, padded_lengths, wiener_filter
from dolens.sensor.colour import linear_to_srgb


class WienerMatrices(nn.Module):
    """Deconvolve images of one size; the same numbers as `wiener_deconvolve` but for rounding.

    Args:
        point_spread_function: (C, K, K), K odd.
        noise_to_signal: r, one number a channel, (C,).
        margin: pixels at each edge.
        height: of the images, pixels.
        width: of the images, pixels.
    """

    weight_real: Tensor
    weight_imaginary: Tensor
    row_cosine: Tensor
    row_sine: Tensor
    column_cosine: Tensor
    column_sine: Tensor
    inverse_cosine: Tensor
    inverse_sine: Tensor

    def __init__(
        self,
        point_spread_function: Tensor,
        noise_to_signal: Tensor,
        margin: int,
        height: int,
        width: int,
    ) -> None:
        super().__init__()
        self.height, self.width = height, width
        size = point_spread_function.shape[-1]
        self.rows, self.columns = padded_lengths(height, width, margin, size)
        weight = wiener_filter(
            point_spread_function.detach().double(),
            noise_to_signal.detach().double(),
            self.rows,
            self.columns,
        )
        dtype = point_spread_function.dtype
        half = self.columns // 2 + 1
        # A real image's spectrum is known by half of its columns: the others count through these.
        counts = torch.full((half,), 2.0, dtype=torch.float64)
        counts[0] = 1.0
        if self.columns % 2 == 0:
            counts[-1] = 1.0
        cosine, sine = _matrices(self.columns, half)
        inverse = counts / (self.rows * self.columns)
        stored = {
            "weight_real": weight.real,
            "weight_imaginary": weight.imag,
            "row_cosine": _matrices(self.rows, self.rows)[0],
            "row_sine": _matrices(self.rows, self.rows)[1],
            "column_cosine": cosine,
            "column_sine": sine,
            "inverse_cosine": (cosine * inverse).T,
            "inverse_sine": (sine * inverse).T,
        }
        for name, value in stored.items():
            self.register_buffer(name, value.to(dtype).contiguous())

    def forward(self, image: Tensor) -> Tensor:
        """Deconvolve linear light (B, C, height, width), not clamped."""
        image = close_periodically(image, self.rows, self.columns)
        a, b = image @ self.column_cosine, -(image @ self.column_sine)
        real = self.row_cosine @ a + self.row_sine @ b
        imaginary = self.row_cosine @ b - self.row_sine @ a
        real, imaginary = (
            real * self.weight_real - imaginary * self.weight_imaginary,
            real * self.weight_imaginary + imaginary * self.weight_real,
        )
        a = self.row_cosine @ real - self.row_sine @ imaginary
        b = self.row_cosine @ imaginary + self.row_sine @ real
        restored = a @ self.inverse_cosine - b @ self.inverse_sine
        return restored[..., : self.height, : self.width]


class FixedWienerUNet(nn.Module):
    """A `WienerUNetRestoration` for images of one size and one lens, of real arithmetic alone.

    Args:
        network: as trained.
        point_spread_functions: (D, 3, K, K), that it is given for D depths.
        height: of the images, pixels.
        width: of the images, pixels.
    """

    def __init__(
        self,
        network: WienerUNetRestoration,
        point_spread_functions: Tensor,
        height: int,
        width: int,
    ) -> None:
        super().__init__()
        mean = point_spread_functions.to(network.dtype).mean(dim=0)
        ratio = network.log_noise_to_signal.exp()
        self.wiener = WienerMatrices(mean, ratio, network.margin, height, width)
        self.network = network.network

    def forward(self, raw: Tensor) -> Tensor:
        """Restore (B, 3, height, width) linear light to sRGB."""
        encoded = linear_to_srgb(self.wiener(raw))
        return encoded + self.network(torch.cat([encoded, linear_to_srgb(raw)], dim=1))


def _matrices(length: int, frequencies: int) -> tuple[Tensor, Tensor]:
    """Return cos and sin of 2π·jk/length, (length, frequencies), in double precision."""
    products = torch.arange(length)[:, None] * torch.arange(frequencies)
    angle = (products % length).double() * (2.0 * math.pi / length)
    return torch.cos(angle), torch.sin(angle)
