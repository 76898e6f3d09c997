"""The Wiener deconvolution of images of one size by products of real matrices.

Programs that run networks elsewhere lack the Fourier transform of `wiener_deconvolve`, or compute
it inexactly.  For a fixed size it is four products with matrices of cosines and sines:

    spectrum = F_R·image·F_Cᵀ,   F = C - iS,   C_jk = cos(2π·jk/N),   S_jk = sin(2π·jk/N).

The filter is computed once and stored, so nothing of the point spread function is left to compute.
"""

import copy
import math

import torch
from torch import Tensor, nn

from dolens.reconstruction.feature_wiener import DeconvolvedRestoration
from dolens.reconstruction.general import (
    GeneralRestoration,
    Prepared,
    given_to_the_network,
    noise_to_signal,
    stabilised_images,
)
from dolens.reconstruction.opponent_wiener import colour_filters, correlations
from dolens.reconstruction.restoration import COLORS, WienerUNetRestoration
from dolens.reconstruction.wiener import (
    close_periodically,
    half_spectrum_counts,
    padded_lengths,
    wiener_filter,
)
from dolens.sensor.colour import linear_to_srgb


class FourierMatrices(nn.Module):
    """The Fourier transform of real images of one size and its inverse, as products of matrices.

    Args:
        rows: of the images.
        columns: of the images.
        dtype: of the images.
    """

    row_cosine: Tensor
    row_sine: Tensor
    column_cosine: Tensor
    column_sine: Tensor
    inverse_cosine: Tensor
    inverse_sine: Tensor

    def __init__(self, rows: int, columns: int, dtype: torch.dtype) -> None:
        super().__init__()
        self.rows, self.columns = rows, columns
        half = columns // 2 + 1
        # A real image's spectrum is known by half of its columns: the others count through these.
        counts = half_spectrum_counts(columns, torch.zeros((), dtype=torch.float64))
        cosine, sine = _matrices(columns, half)
        inverse = counts / (rows * columns)
        stored = {
            "row_cosine": _matrices(rows, rows)[0],
            "row_sine": _matrices(rows, rows)[1],
            "column_cosine": cosine,
            "column_sine": sine,
            "inverse_cosine": (cosine * inverse).T,
            "inverse_sine": (sine * inverse).T,
        }
        for name, value in stored.items():
            self.register_buffer(name, value.to(dtype).contiguous())

    def transform(self, image: Tensor) -> tuple[Tensor, Tensor]:
        """Return real and imaginary parts (..., rows, columns // 2 + 1) of a spectrum."""
        a, b = image @ self.column_cosine, -(image @ self.column_sine)
        return self.row_cosine @ a + self.row_sine @ b, self.row_cosine @ b - self.row_sine @ a

    def inverse(self, real: Tensor, imaginary: Tensor) -> Tensor:
        """Return the image (..., rows, columns) of a spectrum."""
        a = self.row_cosine @ real - self.row_sine @ imaginary
        b = self.row_cosine @ imaginary + self.row_sine @ real
        return a @ self.inverse_cosine - b @ self.inverse_sine


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
        rows, columns = padded_lengths(height, width, margin, point_spread_function.shape[-1])
        weight = wiener_filter(
            point_spread_function.detach().double(),
            noise_to_signal.detach().double(),
            rows,
            columns,
        )
        dtype = point_spread_function.dtype
        self.fourier = FourierMatrices(rows, columns, dtype)
        self.register_buffer("weight_real", weight.real.to(dtype).contiguous())
        self.register_buffer("weight_imaginary", weight.imag.to(dtype).contiguous())

    def forward(self, image: Tensor) -> Tensor:
        """Deconvolve linear light (B, C, height, width), not clamped."""
        image = close_periodically(image, self.fourier.rows, self.fourier.columns)
        real, imaginary = self.fourier.transform(image)
        restored = self.fourier.inverse(
            real * self.weight_real - imaginary * self.weight_imaginary,
            real * self.weight_imaginary + imaginary * self.weight_real,
        )
        return restored[..., : self.height, : self.width]


class FilterMatrices(nn.Module):
    """Filter images of one size by given filters that mix their channels.

        out_n = Σ_c w_nc·in_c   at every frequency.

    Args:
        weights: w, (N, C, R, S // 2 + 1), complex.
        columns: S, of the padded images.
        height: of the images, pixels.
        width: of the images, pixels.
        dtype: of the images.
    """

    weight_real: Tensor
    weight_imaginary: Tensor

    def __init__(
        self, weights: Tensor, columns: int, height: int, width: int, dtype: torch.dtype
    ) -> None:
        super().__init__()
        self.height, self.width = height, width
        self.fourier = FourierMatrices(weights.shape[-2], columns, dtype)
        self.register_buffer("weight_real", weights.real.to(dtype).contiguous())
        self.register_buffer("weight_imaginary", weights.imag.to(dtype).contiguous())

    def forward(self, image: Tensor) -> Tensor:
        """Map (B, C, height, width) to (B, N, height, width)."""
        image = close_periodically(image, self.fourier.rows, self.fourier.columns)
        real, imaginary = (part[:, None] for part in self.fourier.transform(image))
        found = self.fourier.inverse(
            (real * self.weight_real - imaginary * self.weight_imaginary).sum(2),
            (real * self.weight_imaginary + imaginary * self.weight_real).sum(2),
        )
        return found[..., : self.height, : self.width]


class _FixedWiener(nn.Module):
    """In the place of an `OpponentWiener`."""

    def __init__(self, filters: FilterMatrices) -> None:
        super().__init__()
        self.filters = filters

    def forward(self, image: Tensor, functions: Tensor | None) -> Tensor:
        return self.filters(image).unflatten(1, (-1, COLORS))


class _FixedFeatures(nn.Module):
    """In the place of `LearnedFeatures`."""

    def __init__(self, filters: FilterMatrices) -> None:
        super().__init__()
        self.filters = filters

    def forward(self, image: Tensor, functions: Tensor) -> Tensor:
        return self.filters(image)


def with_fixed_filters(
    network: DeconvolvedRestoration, functions: Tensor, height: int, width: int
) -> DeconvolvedRestoration:
    """Return a copy of a network for images of one size and one lens, of real arithmetic alone.

    Args:
        network: as trained.
        functions: point spread functions (D, 3, K, K) that it is given.
        height: of the images, pixels.
        width: of the images, pixels.
    """
    exact = copy.deepcopy(network).double()
    fixed = copy.deepcopy(network)
    functions, dtype = functions.detach().double(), network.dtype
    with torch.no_grad():
        weights, columns = exact.wiener.filters(functions, height, width)
        filters = FilterMatrices(weights.flatten(0, 1), columns, height, width, dtype)
        fixed.wiener = _FixedWiener(filters)  # type: ignore[assignment]
        features = getattr(exact, "features", None)
        if features is not None:
            weights, columns = features.filters(functions, height, width)
            filters = FilterMatrices(weights, columns, height, width, dtype)
            fixed.features = _FixedFeatures(filters)
    return fixed


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


class FixedGeneral(nn.Module):
    """A `GeneralRestoration` for images of one size, lens and noise, of real arithmetic alone.

    Args:
        network: one picture for all depths, `by_depth` false.
        functions: point spread functions (D, 3, K, K) that it is given.
        noise: (2,), likewise.
        height: of the images, pixels.
        width: of the images, pixels.
    """

    known: Tensor
    pedestal: Tensor

    @torch.no_grad()
    def __init__(
        self,
        network: GeneralRestoration,
        functions: Tensor,
        noise: Tensor,
        height: int,
        width: int,
    ) -> None:
        super().__init__()
        functions, noise, dtype = functions.detach().double(), noise.double(), network.dtype
        size = functions.shape[-1]
        rows, columns = padded_lengths(height, width, size // 2, size)
        matched, power = (c.expand(3, *c.shape) for c in correlations(functions, rows, columns))
        weights = colour_filters(power, matched, noise_to_signal(noise), columns).flatten(0, 1)
        self.filters = FilterMatrices(weights, columns, height, width, dtype)
        nothing = functions.new_zeros(1, COLORS, 1, 1)
        given = given_to_the_network(nothing, nothing[:, None], functions[None], noise)
        self.register_buffer("known", given.known.to(dtype))
        self.register_buffer("pedestal", given.pedestal.to(dtype))
        self.network = network

    def forward(self, raw: Tensor) -> Tensor:
        """Restore (B, 3, height, width) linear light to sRGB."""
        light = self.filters(raw).unflatten(1, (-1, COLORS))
        pedestal = self.pedestal.expand(raw.shape[0])
        images = stabilised_images(raw, light, pedestal)
        known = self.known.expand(raw.shape[0], -1)
        return self.network.restored(Prepared(images, known, pedestal))


def _matrices(length: int, frequencies: int) -> tuple[Tensor, Tensor]:
    """Return cos and sin of 2π·jk/length, (length, frequencies), in double precision."""
    products = torch.arange(length)[:, None] * torch.arange(frequencies)
    angle = (products % length).double() * (2.0 * math.pi / length)
    return torch.cos(angle), torch.sin(angle)
