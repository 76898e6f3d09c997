"""Wiener deconvolution knows that the colours of photographs go together.

Red, green and blue of a photograph rise and fall as one: nearly all of its power is in their sum,
the luminance, and little in their differences (Buchsbaum and Gottschalk, Proc. R. Soc. Lond. B 220,
89, 1983).  Noise is alike in all of them.  A filter that knows both averages noise over the colours
where they agree, and needs no training for it.
"""

import math
from collections.abc import Sequence

import torch
from torch import Tensor, nn

from dolens.errors import InputError
from dolens.reconstruction.wiener import (
    close_periodically,
    padded_lengths,
    squared_frequency,
    transfer_function,
)

# Rows are orthonormal: luminance, red against blue, green against both.
OPPONENT = (
    (1.0 / math.sqrt(3.0), 1.0 / math.sqrt(3.0), 1.0 / math.sqrt(3.0)),
    (1.0 / math.sqrt(2.0), 0.0, -1.0 / math.sqrt(2.0)),
    (1.0 / math.sqrt(6.0), -2.0 / math.sqrt(6.0), 1.0 / math.sqrt(6.0)),
)

Symmetric = tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor]


def opponent_wiener_deconvolve(
    image: Tensor, functions: Tensor, noise_to_signal: Tensor, margin: int
) -> Tensor:
    """Undo a blur of unknown depth by the linear filter of least expected squared error.

    See `opponent_wiener_filter` for the filter, and `wiener_deconvolve` for the image's edges.

    Args:
        image: linear light, (B, 3, H, W), float32 or float64; its dtype is computed in.
        functions: point spread functions of D depths, (D, 3, K, K), K odd.
        noise_to_signal: r > 0 of luminance and of both differences of colours, (3,).
        margin: pixels at each edge, at least 0.

    Returns:
        (B, 3, H, W), not clamped.  Gradients reach all three tensors.

    Raises:
        InputError: functions of another shape.
    """
    check_functions(functions)
    height, width = image.shape[-2:]
    rows, columns = padded_lengths(height, width, margin, functions.shape[-1])
    matched, power = correlations(functions.to(image), rows, columns)
    spectrum = torch.fft.rfft2(close_periodically(image, rows, columns))
    frequency = squared_frequency(rows, columns, image)
    solved = solve_in_opponent_colours(power, frequency, noise_to_signal, matched * spectrum)
    return torch.fft.irfft2(solved, s=(rows, columns))[..., :height, :width]


class OpponentWiener(nn.Module):
    """Deconvolve by `opponent_wiener_deconvolve`, with noise-to-signal ratios that are learned.

    The first picture is that of one filter for all depths.  With `depths` D > 0 there follow D
    pictures, each of the filter that is best where the depth is known: a network may choose.

    Args:
        margin: pixels added at each edge for the deconvolution; see `wiener_deconvolve`.
        noise_to_signal: initial r of luminance and of both differences of colours.
        depths: number of the camera's point spread functions, each with a filter of its own; 0
            for none.

    Raises:
        InputError: ratios that are not three positive numbers, or a negative number.
    """

    def __init__(self, margin: int, noise_to_signal: Sequence[float], depths: int = 0) -> None:
        super().__init__()
        initial = checked_ratios(noise_to_signal).log()
        if margin < 0:
            raise InputError(f"margin={margin}: must be at least 0 pixels")
        if depths < 0:
            raise InputError(f"depths={depths}: must be at least 0")
        self.margin = margin
        self.depths = depths
        self.log_noise_to_signal = nn.Parameter(initial.repeat(1 + depths, 1))

    @property
    def pictures(self) -> int:
        """Return the number of pictures, 1 + depths."""
        return 1 + self.depths

    def forward(self, image: Tensor, functions: Tensor | None) -> Tensor:
        """Return pictures in linear light, (B, 1 + depths, 3, H, W), not clamped.

        Args:
            image: linear light, (B, 3, H, W), in the dtype of the parameters.
            functions: point spread functions, (D, 3, K, K), K odd.

        Raises:
            InputError: `functions` is None or of another shape.
        """
        if functions is None:
            raise InputError(
                "a network with a Wiener deconvolution needs the lens's point spread functions, "
                "got None: use a renderer that gives them, or a network that works without, as unet"
            )
        height, width = image.shape[-2:]
        filters, columns = self.filters(functions.to(image), height, width)
        rows = filters.shape[-2]
        spectrum = torch.fft.rfft2(close_periodically(image, rows, columns))
        found = torch.einsum("ncduv,bduv->bncuv", filters, spectrum)
        return torch.fft.irfft2(found, s=(rows, columns))[..., :height, :width]

    def filters(self, functions: Tensor, height: int, width: int) -> tuple[Tensor, int]:
        """Return filters (1 + depths, 3, 3, R, C // 2 + 1), complex, to a colour from a colour, and
        C.

        Args:
            functions: point spread functions, (D, 3, K, K), K odd; one stands for all depths.
            height: of the images, pixels.
            width: of the images, pixels.

        Raises:
            InputError: `functions` of another shape.
        """
        if self.depths and len(functions) == 1:
            functions = functions.expand(self.depths, *functions.shape[1:])
        check_functions(functions, self.depths or None)
        rows, columns = padded_lengths(height, width, self.margin, functions.shape[-1])
        matched, power = correlations(functions, rows, columns)
        matched, power = matched[None], power[None]
        if self.depths:
            each = [correlations(one[None], rows, columns) for one in functions]
            matched = torch.cat([matched, torch.stack([own for own, _ in each])])
            power = torch.cat([power, torch.stack([own for _, own in each])])
        return colour_filters(power, matched, self.log_noise_to_signal.exp(), columns), columns


def colour_filters(power: Tensor, matched: Tensor, ratios: Tensor, columns: int) -> Tensor:
    """Return filters (N, 3, 3, R, C // 2 + 1), complex, to a colour from a colour.

    Args:
        power: mean |H|², (N, 3, R, C // 2 + 1); see `correlations`.
        matched: mean H*, likewise.
        ratios: r, (N, 3); see `solve_in_opponent_colours`.
        columns: C.
    """
    # From each colour alone: (from, N, to, R, C // 2 + 1).
    colours = torch.eye(3, dtype=power.dtype, device=power.device)[:, None, :, None, None]
    frequency = squared_frequency(power.shape[-2], columns, power)
    solved = solve_in_opponent_colours(power, frequency, ratios, colours * matched)
    return solved.permute(1, 2, 0, 3, 4)


def checked_ratios(noise_to_signal: Sequence[float]) -> Tensor:
    """Return ratios of noise to signal, (3,).

    Raises:
        InputError: they are not three positive numbers.
    """
    ratios = [float(ratio) for ratio in noise_to_signal]
    if len(ratios) != 3 or not all(r > 0 and math.isfinite(r) for r in ratios):
        raise InputError(
            f"noise_to_signal={ratios}: must be three positive numbers, of luminance and of "
            "both differences of colours"
        )
    return torch.tensor(ratios)


def check_functions(functions: Tensor, depths: int | None = None) -> None:
    """Refuse point spread functions of another shape than (depths, 3, K, K), K odd.

    Args:
        functions: to be checked.
        depths: their number; None for any.

    Raises:
        InputError: the line has both shapes.
    """
    shape = tuple(functions.shape)
    good = len(shape) == 4 and shape[1] == 3 and shape[2] == shape[3] and shape[3] % 2 == 1
    if not good or depths not in (None, shape[0]):
        raise InputError(
            f"point_spread_functions of shape {shape}: expected ({depths or 'depths'}, 3, K, K), "
            "K odd"
        )


def functions_of_each(images: Tensor, functions: Tensor) -> Sequence[Tensor]:
    """Return the point spread functions (D, 3, K, K) of each of B images, or (N, D, 3, K, K) of
    each readout of each.

    Args:
        images: (B, 3, H, W), or of N readouts (B, N, 3, H, W).
        functions: (D, 3, K, K) of all images, or (B, D, 3, K, K); of readouts (N, D, 3, K, K), or
            (B, N, D, 3, K, K).

    Raises:
        InputError: functions of another shape.
    """
    if functions.ndim == images.ndim:
        functions = functions.expand(len(images), *functions.shape)
    if functions.ndim != images.ndim + 1 or len(functions) != len(images):
        several = "readouts, " if images.ndim == 5 else ""
        raise InputError(
            f"point_spread_functions of shape {tuple(functions.shape)}: expected "
            f"({several}depths, 3, K, K), or ({len(images)}, {several}depths, 3, K, K), of each "
            "image"
        )
    for own in functions.flatten(0, -5):
        check_functions(own)
    return functions.unbind()


def correlations(functions: Tensor, rows: int, columns: int) -> tuple[Tensor, Tensor]:
    """Return mean H* and mean |H|² over the depths, each (..., 3, rows, columns // 2 + 1).

    Args:
        functions: point spread functions (..., D, 3, K, K), K odd; H are their transforms.
        rows: of the padded image.
        columns: of the padded image.
    """
    return over_depths(transfer_function(functions, rows, columns))


def over_depths(transfer: Tensor) -> tuple[Tensor, Tensor]:
    """Return mean H* and mean |H|² of transfer functions (..., D, 3, R, C), each (..., 3, R, C)."""
    power = (transfer.real**2 + transfer.imag**2).mean(dim=-4)
    return transfer.mean(dim=-4).conj(), power


def solve_in_opponent_colours(
    power: Tensor, frequency: Tensor, ratios: Tensor, matched: Tensor
) -> Tensor:
    """Return x = (P + φ·Oᵀ·diag(r)·O)⁻¹·b at every frequency, b in red, green and blue.

    It minimises the mean over depths d of |H_d·x - y|² + φ·Σ_k r_k·|(O·x)_k|², O being `OPPONENT`,
    P = mean |H_d|² a diagonal matrix, and b = mean(H_d*)·y.  With φ = (f/f_N)² it is Wiener's
    filter for photographs whose opponent colours have spectra ∝ 1/f² of unlike strength: r_k is
    noise over signal power of opponent colour k at the Nyquist frequency along an axis.  For one
    depth and three equal r it is `wiener_filter`.  At f = 0 the gain is mean(H*)/mean|H|²: 1 for
    point spread functions of unit sum.

    Args:
        power: P, (..., 3, R, C), real; values below the machine epsilon become it.
        frequency: φ, (R, C).
        ratios: r > 0, (..., 3).
        matched: b, (..., 3, R, C), complex.

    Returns:
        x, complex, of the shape that they have together.
    """
    basis = torch.tensor(OPPONENT, dtype=power.dtype, device=power.device)
    power = power.clamp(min=torch.finfo(power.dtype).eps)
    red, green, blue = power.unbind(-3)

    def entry(i: int, j: int) -> Tensor:
        # Of O·P·Oᵀ; the penalty is diagonal in this basis.  Its off-diagonal elements are
        # differences of the colours' powers, so that the inverse is well conditioned.
        terms = zip(OPPONENT[i], OPPONENT[j], (red, green, blue), strict=True)
        found = sum((a * b * colour for a, b, colour in terms), torch.zeros_like(red))
        return found + frequency * ratios[..., i, None, None] if i == j else found

    inverse = _inverse(
        (entry(0, 0), entry(0, 1), entry(0, 2), entry(1, 1), entry(1, 2), entry(2, 2))
    )
    first, second, third = _times(basis, matched.unbind(-3))
    a, b, c, d, e, f = inverse
    solved = (
        a * first + b * second + c * third,
        b * first + d * second + e * third,
        c * first + e * second + f * third,
    )
    return torch.stack(_times(basis.T, solved), dim=-3)


def _times(matrix: Tensor, colours: Sequence[Tensor]) -> list[Tensor]:
    first, second, third = colours
    return [a * first + b * second + c * third for a, b, c in matrix]


def _inverse(matrix: Symmetric) -> Symmetric:
    """Return the inverse of symmetric 3×3 matrices: elements 11, 12, 13, 22, 23, 33 of each.

    Elements are divided by the trace first: the determinant is a product of three of them, and
    its square, which the derivative has, would leave single precision.
    """
    trace = matrix[0] + matrix[3] + matrix[5]
    a, b, c, d, e, f = (element / trace for element in matrix)
    first, second, third = d * f - e * e, c * e - b * f, b * e - c * d
    scale = 1.0 / (trace * (a * first + b * second + c * third))
    return (
        first * scale,
        second * scale,
        third * scale,
        (a * f - c * c) * scale,
        (b * c - a * e) * scale,
        (a * d - b * b) * scale,
    )
