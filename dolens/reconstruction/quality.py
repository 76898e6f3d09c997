"""Image quality is measured by PSNR and SSIM, image by image."""

from torch import Tensor
from torchmetrics.functional.image import (
    peak_signal_noise_ratio,
    structural_similarity_index_measure,
)

# Pixels along each side of the window of structural similarity; no smaller image has one.
SIMILARITY_WINDOW = 11
# Pixels of all images that are compared at a time: each takes some 700 bytes.
_PIXELS = 1 << 19


def psnr_db(restored: Tensor, truth: Tensor) -> Tensor:
    """Return the peak signal-to-noise ratio of each image, 10 log₁₀(1 / mean squared error).

    Args:
        restored: sRGB values, (B, C, H, W), clamped to [0, 1] here as a display does.
        truth: the same shape, clamped too.

    Returns:
        (B,), in dB; infinite for equal images.

    Raises:
        ValueError: the shapes differ or are not (B, C, H, W).
    """
    _check_shapes(restored, truth)
    return peak_signal_noise_ratio(
        restored.clamp(0.0, 1.0),
        truth.clamp(0.0, 1.0),
        data_range=1.0,
        reduction="none",
        dim=(1, 2, 3),
    )


def structural_similarity(restored: Tensor, truth: Tensor) -> Tensor:
    """Return the structural similarity (SSIM) of each image.

    Gaussian window of 11 pixels, σ = 1.5 pixels, K₁ = 0.01, K₂ = 0.03 (Wang et al. 2004), mean
    over channels and over windows about every pixel; beyond its edges an image is mirrored, as in
    torchmetrics.  Large images are compared in strips of rows, for memory.

    Args:
        restored: sRGB values, (B, C, H, W), clamped to [0, 1]; H and W at least 11.
        truth: the same shape, clamped too.

    Returns:
        (B,), at most 1, which equal images reach.

    Raises:
        ValueError: the shapes differ, are not (B, C, H, W), or are smaller than the window.
    """
    _check_shapes(restored, truth)
    if min(restored.shape[-2:]) < SIMILARITY_WINDOW:
        raise ValueError(
            f"images of {restored.shape[-2]}×{restored.shape[-1]} pixels: structural similarity "
            f"needs at least {SIMILARITY_WINDOW}×{SIMILARITY_WINDOW}"
        )
    batch, _, height, width = restored.shape
    strip, reach = max(SIMILARITY_WINDOW, _PIXELS // (batch * width)), SIMILARITY_WINDOW // 2
    total = restored.new_zeros(batch)
    for first in range(0, height, strip):
        # Rows on both sides, as far as a window reaches; a mirror needs some at the image's end.
        low = max(0, min(first, height - SIMILARITY_WINDOW) - reach)
        high = min(first + strip + reach, height)
        _, similarity = structural_similarity_index_measure(
            restored[..., low:high, :].clamp(0.0, 1.0),
            truth[..., low:high, :].clamp(0.0, 1.0),
            reduction="none",
            data_range=1.0,
            return_full_image=True,
        )
        own = similarity[..., first - low : first - low + strip, :]
        total = total + own.mean((1, 3)).sum(-1)
    return total / height


def _check_shapes(restored: Tensor, truth: Tensor) -> None:
    if restored.shape != truth.shape or restored.ndim != 4:
        raise ValueError(
            f"restored {tuple(restored.shape)} and truth {tuple(truth.shape)}: "
            "expected one shape (B, C, H, W) for both"
        )
