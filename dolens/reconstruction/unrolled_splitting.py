"""Half-quadratic splitting with a learned prior is unrolled into a network of a few stages."""

from collections.abc import Sequence
from typing import ClassVar

import torch
from torch import Tensor, nn

from dolens.errors import InputError
from dolens.reconstruction.feature_wiener import NOISE_TO_SIGNAL
from dolens.reconstruction.opponent_wiener import (
    OpponentWiener,
    check_functions,
    correlations,
    solve_in_opponent_colours,
)
from dolens.reconstruction.restoration import (
    COLORS,
    FIELD_CHANNELS,
    Restoration,
    required_field,
    with_field_channels,
)
from dolens.reconstruction.unet import UNet
from dolens.reconstruction.wiener import close_periodically, padded_lengths, squared_frequency
from dolens.sensor.colour import linear_to_srgb, srgb_to_linear


class UnrolledSplittingRestoration(Restoration):
    """Restore by stages of a prior, which is learned, and of a data step, in closed form.

    Half-quadratic splitting (Geman and Yang 1995; unrolled by Zhang et al., "Plug-and-play image
    restoration with deep denoiser prior", 2022) minimises over pictures x and z in turns

        mean_d |h_d * x - y|² + μ·φ·|O·(x - z)|² + prior(z),

    d going over depths, φ = (f/f_N)², O opponent colours and one μ for each of them.  Given z, x
    is found exactly in Fourier space (`splitting_data_step`); given x, z is what a small U-Net
    makes of it.  φ leaves means to the data, as Wiener's filter does; without it noise at low
    frequencies would weigh as much as at high ones.  The first x is Wiener's, where z = 0.

        x_0 = wiener(y),   z_k = decode(e_k + U_k([e_k, e_0])),   x_{k+1} = data step(y, z_k, μ_k),
        restored = e_K + U_K([e_K, e_0]),   e_k = sRGB(x_k).

    It begins as the data steps alone, which is Wiener's filter with ever less of its prior.

    Args:
        stages: K, data steps after the first; at least 1.
        width: channels of each U-Net's first stage.
        depth: number of its halvings.
        margin: pixels added at each edge for the deconvolution; see `wiener_deconvolve`.
        noise_to_signal: initial r of luminance and of both differences of colours.
        field_coordinates: whether the U-Nets are told where on the sensor a pixel lies.

    Raises:
        InputError: a number out of range.
    """

    needs_point_spread_function: ClassVar[bool] = True

    def __init__(
        self,
        stages: int = 2,
        width: int = 8,
        depth: int = 3,
        margin: int = 32,
        noise_to_signal: Sequence[float] = NOISE_TO_SIGNAL,
        field_coordinates: bool = False,
    ) -> None:
        super().__init__()
        if stages < 1:
            raise InputError(f"stages={stages}: must be a whole number of at least 1")
        self.needs_field = field_coordinates
        self.wiener = OpponentWiener(margin, noise_to_signal)
        initial = self.wiener.log_noise_to_signal.detach()
        self.log_penalty = nn.Parameter(initial.repeat(stages, 1))
        channels = 2 * COLORS + FIELD_CHANNELS * field_coordinates
        self.priors = nn.ModuleList(
            UNet(channels, COLORS, width=width, depth=depth, zero_output=True)
            for _ in range(stages + 1)
        )

    def filtered(self, raw: Tensor, point_spread_functions: Tensor | None) -> Tensor:
        """Return the pictures (B, 3, H, W) of the first deconvolution alone, sRGB-encoded."""
        return linear_to_srgb(self.wiener(raw.to(self.dtype), point_spread_functions)[:, 0])

    def forward(
        self,
        raw: Tensor,
        point_spread_functions: Tensor | None = None,
        field: Tensor | None = None,
    ) -> Tensor:
        """Restore (B, 3, H, W) linear light to (B, 3, H, W) sRGB; see `Restoration.forward`.

        Raises:
            InputError: `point_spread_functions` is None or not of shape (D, 3, K, K), or `field` is
                needed, and is None or not of shape (B, 2, H, W).
        """
        if self.needs_field:
            required_field(field, type(self).__name__)
        raw = raw.to(self.dtype)
        first = encoded = self.filtered(raw, point_spread_functions)
        assert point_spread_functions is not None  # the deconvolution has looked
        functions, margin = point_spread_functions.to(raw), self.wiener.margin
        for prior, penalty in zip(self.priors[:-1], self.log_penalty.exp(), strict=True):
            guess = (encoded + self._correction(prior, encoded, first, field)).clamp(0.0, 1.0)
            linear = srgb_to_linear(guess)
            encoded = linear_to_srgb(splitting_data_step(raw, functions, linear, penalty, margin))
        return encoded + self._correction(self.priors[-1], encoded, first, field)

    def _correction(
        self, prior: nn.Module, encoded: Tensor, first: Tensor, field: Tensor | None
    ) -> Tensor:
        seen = torch.cat([encoded, first], dim=1)
        return prior(
            with_field_channels(seen, field) if self.needs_field and field is not None else seen
        )


def splitting_data_step(
    image: Tensor, functions: Tensor, guess: Tensor, penalty: Tensor, margin: int
) -> Tensor:
    """Return x of least mean_d |h_d * x - image|² + φ·Σ_k μ_k·|(O·(x - guess))_k|².

    In Fourier space, with P = mean |H_d|² and O of opponent colours,

        x = guess + (P + φ·Oᵀ·diag(μ)·O)⁻¹·(mean(H_d*)·image - P·guess).

    A guess that explains the image, of one depth without noise, stays what it is, whatever μ is.

    Args:
        image: linear light, (B, 3, H, W).
        functions: point spread functions, (D, 3, K, K), K odd.
        guess: linear light, (B, 3, H, W).
        penalty: μ > 0, (3,).
        margin: pixels added at each edge.

    Returns:
        (B, 3, H, W), not clamped.

    Raises:
        InputError: functions of another shape.
    """
    check_functions(functions)
    height, width = image.shape[-2:]
    rows, columns = padded_lengths(height, width, margin, functions.shape[-1])
    matched, power = correlations(functions, rows, columns)
    both = torch.fft.rfft2(close_periodically(torch.cat([image, guess]), rows, columns))
    spectrum, of_guess = both.chunk(2)
    frequency = squared_frequency(rows, columns, image)
    change = matched * spectrum - power * of_guess
    solved = solve_in_opponent_colours(power, frequency, penalty, change)
    return guess + torch.fft.irfft2(solved, s=(rows, columns))[..., :height, :width]
