"""The least mean squared error of any linear filter is computed from transfer functions.

A cross-check of trained cameras that takes milliseconds and no photographs.  Where the depth of a
pixel is unknown one filter serves all depths; where it is known each depth has its own.  A network
that guesses depths from what it sees lies in between.
"""

from typing import Any, NamedTuple

import torch
from torch import Tensor

from dolens.reconstruction.wiener import half_spectrum_counts


class LinearError(NamedTuple):
    """A `LinearError` holds mean squared errors of D depths, in the image's units squared, each
    (..., D).

    Attributes:
        common_filter: one filter for all depths, of least mean error over them.
        filter_per_depth: each depth has the filter that is best for it.
    """

    common_filter: Tensor
    filter_per_depth: Tensor


def natural_spectrum(
    rows: int, columns: int, variance: float, outer_scale: float, like: Tensor
) -> Tensor:
    """Return the power spectrum of natural images, S ∝ 1/(f² + f₀²) without its mean.

    Field (J. Opt. Soc. Am. A 4, 2379, 1987) has 1/f²; f₀ keeps low frequencies finite.

    Args:
        rows: of the transform.
        columns: of the image; the transform has columns // 2 + 1.
        variance: of the image, which S averages to over all frequencies.
        outer_scale: pixels; f₀ = 1/outer_scale cycles a pixel.
        like: gives dtype and device.

    Returns:
        (rows, columns // 2 + 1), zero at the origin.
    """
    options: dict[str, Any] = {"dtype": like.dtype, "device": like.device}
    down = torch.fft.fftfreq(rows, **options)[:, None]
    across = torch.fft.rfftfreq(columns, **options)[None]
    power = 1.0 / (down.square() + across.square() + outer_scale**-2)
    power[0, 0] = 0.0
    return power * (variance / _mean(power, columns))


def linear_error(functions: Tensor, spectrum: Tensor, noise: float) -> LinearError:
    """Return the least errors of restoring an image of spectrum S that was blurred and got white
    noise.

    With transfer functions H_d and noise of variance N a pixel, a filter W leaves at depth d the
    error e_d = ⟨|1 - W·H_d|²·S + |W|²·N⟩, ⟨⟩ the mean over frequencies.  The mean of e_d over d is
    least for W = S·mean(H_d*)/(S·mean|H_d|² + N), Wiener's filter where there is one depth.

    Args:
        functions: (..., D, K, K), point spread functions, K odd.
        spectrum: (R, C // 2 + 1) with C = R even and at least K.
        noise: N.

    Returns:
        errors of D depths.
    """
    return linear_error_of_readouts(functions.unsqueeze(-4), spectrum, noise)


def linear_error_of_readouts(functions: Tensor, spectrum: Tensor, noise: float) -> LinearError:
    """Return the least errors of restoring an image that was read out several times.

    As `linear_error`, with a filter for each readout: |1 - Σ_n W_n·H_nd|²·S + Σ_n |W_n|²·N, and
    sums over n of mean|H_nd|².

    Args:
        functions: (..., readouts, D, K, K), scaled so that all have the same noise; see
            `readouts_of`.
        spectrum: (R, C // 2 + 1) with C = R even and at least K.
        noise: N.
    """
    rows = spectrum.shape[-2]
    # The place of the origin changes the phase of all depths alike, and no error.
    transfer = torch.fft.rfft2(functions, s=(rows, rows))
    power = (transfer.real.square() + transfer.imag.square()).sum(-4)
    filters = spectrum * transfer.mean(-3, keepdim=True).conj()
    filters = filters / (spectrum * power.mean(-3, keepdim=True) + noise).unsqueeze(-4)
    residual = 1.0 - (filters * transfer).sum(-4)
    left = spectrum * (residual.real.square() + residual.imag.square())
    left = left + noise * (filters.real.square() + filters.imag.square()).sum(-4)
    own = spectrum * noise / (spectrum * power + noise)
    return LinearError(_mean(left, rows), _mean(own, rows))


def _mean(values: Tensor, columns: int) -> Tensor:
    """Average over all frequencies of a real image, of which the transform holds one half."""
    weight = half_spectrum_counts(columns, values)
    return (values * weight).sum((-2, -1)) / (values.shape[-2] * columns)
