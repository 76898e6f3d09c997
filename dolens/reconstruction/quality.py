"""Image quality is measured by PSNR and SSIM, with confidence intervals by bootstrap."""

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from scipy.special import ndtr, stdtrit
from torch import Tensor

# Pixels along each side of the window of structural similarity; no smaller image has one.
SIMILARITY_WINDOW = 11
# Pixels of all images that are compared at a time: each takes some 700 bytes.
_PIXELS = 1 << 19
# RMS of a spectrum whose angle is that of its noise.
_DARK = 0.02


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
    error = restored.clamp(0.0, 1.0) - truth.clamp(0.0, 1.0)
    return -10.0 * error.square().mean(dim=(1, 2, 3)).log10()


def spectral_angle(restored: Tensor, truth: Tensor) -> Tensor:
    """Return the mean angle between spectra of each image, degrees (spectral angle mapper).

    Angles know nothing of brightness.  Pixels whose true spectrum has an RMS below 0.02 count for
    nothing.

    Args:
        restored: spectra (B, L, H, W), of white 1; negative values are taken for zero.
        truth: the same shape.

    Returns:
        (B,), NaN where all pixels are dark.
    """
    restored = restored.clamp(min=0.0)
    cosine = torch.nn.functional.cosine_similarity(restored, truth, dim=1)
    lit = truth.square().mean(dim=1).sqrt() > _DARK
    angle = torch.rad2deg(torch.acos(cosine.clamp(-1.0, 1.0)))
    return (angle * lit).sum((1, 2)) / lit.sum((1, 2))


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
    from torchmetrics.functional.image import structural_similarity_index_measure

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


def scores_of(image: Tensor, truth: Tensor, prefix: str = "") -> dict[str, float]:
    """Return `psnr_db` and `ssim` of an image (3, H, W), sRGB values, each name behind a prefix.

    Args:
        image: H and W at least 11.
        truth: the same shape.
        prefix: as `raw_`.
    """
    pair = image[None], truth[None].to(image)
    return {
        f"{prefix}psnr_db": float(psnr_db(*pair)),
        f"{prefix}ssim": float(structural_similarity(*pair)),
    }


def _check_shapes(restored: Tensor, truth: Tensor) -> None:
    if restored.shape != truth.shape or restored.ndim != 4:
        raise ValueError(
            f"restored {tuple(restored.shape)} and truth {tuple(truth.shape)}: "
            "expected one shape (B, C, H, W) for both"
        )


@dataclass(frozen=True)
class Interval:
    """An `Interval` holds an estimate and its confidence interval, in the units of the scores.

    Attributes:
        estimate: the mean over seeds of the statistic of means over photographs.
        low: lower end; NaN where there is one seed and one photograph.
        high: upper end; NaN likewise.
        seeds: how many seeds were resampled.
        photographs: how many photographs were resampled.
    """

    estimate: float
    low: float
    high: float
    seeds: int
    photographs: int


def bootstrap_interval(
    scores: Tensor,
    statistic: Callable[[Tensor], Tensor],
    generator: torch.Generator,
    level: float = 0.95,
    resamples: int = 4000,
) -> Interval:
    """Return the bootstrap interval of a statistic of mean scores, averaged over seeds.

    Each seed's camera has a statistic of its own, as the view that is worst for it, so that an
    estimate is the mean of what is printed for each seed, and a gain the difference of two means.

    Seeds and photographs are crossed: each seed's camera is judged on each photograph.  Both are
    resampled, independently of each other and with replacement (Owen 2007, "The pigeonhole
    bootstrap").  From n of either, n - 1 are drawn, so that the variance of a resampled mean is the
    unbiased s²/n (McCarthy and Snowden 1985).  What seeds and photographs do together counts up to
    three times, which makes the interval a little too wide rather than too narrow.

    Each end is the farther of two.  One is the resamples' percentile that Student's t asks for
    (Hesterberg 2015, "expanded percentile"): Φ(-t_{α/2, ν}) in place of α/2.  It follows skewed
    scores, but never leaves the resamples, which few seeds or photographs cannot spread far enough.
    The other is the estimate ± t_{α/2, ν} standard deviations of the resamples.  ν is by Welch and
    Satterthwaite from jackknife variances over seeds and over photographs.  With one seed the
    interval says nothing about other seeds.

    Paired comparisons put the scores of both cameras into the last axis of the same tensor: then
    every resample has the same seeds and photographs for both.

    Args:
        scores: (S, P, K): seed, photograph, and whatever the statistic takes, such as views.
        statistic: maps mean scores (R, K) to (R,), each row by itself.
        generator: draws the resamples; on the CPU.

    Rarely needed:
        level: confidence level, between 0 and 1.
        resamples: how many.

    Raises:
        ValueError: the shape is not (S, P, K) with at least one of each, the level is not between 0
            and 1, or there are fewer than 2 resamples.
    """
    if scores.dim() != 3 or scores.numel() == 0:
        raise ValueError(f"scores: shape {tuple(scores.shape)}; allowed: (seeds, photographs, any)")
    if not 0.0 < level < 1.0:
        raise ValueError(f"level: {level}; allowed: between 0 and 1")
    if resamples < 2:
        raise ValueError(f"resamples: {resamples}; allowed: 2 or more")
    scores = scores.detach().to("cpu", torch.float64)
    seeds, photographs, _ = scores.shape
    estimate = float(statistic(scores.mean(dim=1)).mean())
    if seeds == photographs == 1 or not bool(scores.isfinite().all()):
        return Interval(estimate, math.nan, math.nan, seeds, photographs)
    of_seeds = _weights(seeds, resamples, generator)
    of_photographs = _weights(photographs, resamples, generator)
    means = torch.einsum("rp,spk->rsk", of_photographs, scores)
    found = (of_seeds * statistic(means.flatten(0, 1)).view(resamples, seeds)).sum(dim=1)
    degrees = _degrees_of_freedom(scores, statistic)
    quantile = float(stdtrit(degrees, 0.5 * (1.0 + level)))
    tails = torch.tensor([ndtr(-quantile), ndtr(quantile)], dtype=found.dtype)
    low, high = torch.quantile(found, tails).tolist()
    half_width = quantile * float(found.std())
    low, high = min(low, estimate - half_width), max(high, estimate + half_width)
    return Interval(estimate, low, high, seeds, photographs)


def gain_interval(
    scores: Tensor,
    against: Tensor,
    statistic: Callable[[Tensor], Tensor],
    generator: torch.Generator,
    level: float = 0.95,
    resamples: int = 4000,
) -> Interval:
    """Return the paired interval of a gain, the mean over seeds of statistic(mean scores) -
    statistic(mean against).

    Args:
        scores: (S, P, K), see `bootstrap_interval`.
        against: those of the other camera, (S, P, K), with the same seeds and photographs in the
            same order.
        statistic: maps mean scores (R, K) to (R,).
        generator: draws the resamples.

    Rarely needed:
        level: confidence level, between 0 and 1.
        resamples: how many.

    Raises:
        ValueError: the shapes differ, or as in `bootstrap_interval`.
    """
    if scores.shape != against.shape:
        raise ValueError(
            f"scores of shape {tuple(scores.shape)} against {tuple(against.shape)}; allowed: the "
            "same seeds, photographs and views"
        )
    count = scores.shape[-1]

    def difference(means: Tensor) -> Tensor:
        return statistic(means[..., :count]) - statistic(means[..., count:])

    both = torch.cat((scores, against), dim=-1)
    return bootstrap_interval(both, difference, generator, level, resamples)


def _weights(count: int, resamples: int, generator: torch.Generator) -> Tensor:
    """Return weights (resamples, count) of means over `count - 1` draws with replacement; 1 for
    one.
    """
    if count == 1:
        return torch.ones(resamples, 1, dtype=torch.float64)
    drawn = torch.randint(count, (resamples, count - 1), generator=generator)
    weights = torch.zeros(resamples, count, dtype=torch.float64)
    return weights.scatter_add_(1, drawn, torch.full(drawn.shape, 1.0 / (count - 1)).double())


def _degrees_of_freedom(scores: Tensor, statistic: Callable[[Tensor], Tensor]) -> float:
    """Return Welch and Satterthwaite's ν = (Σ V)² / Σ (V² / (n - 1)), V by jackknife over each
    axis.
    """
    seeds, photographs, _ = scores.shape
    of_seeds = statistic(scores.mean(dim=1))
    without = (scores.sum(dim=1, keepdim=True) - scores) / max(photographs - 1, 1)
    of_photographs = statistic(without.flatten(0, 1)).view(seeds, photographs).mean(dim=0)
    variances, weighted = 0.0, 0.0
    for values, factor in ((of_seeds, 1 / max(seeds - 1, 1)), (of_photographs, photographs - 1)):
        count = len(values)
        if count == 1:
            continue
        variance = float(values.var(correction=0)) * factor
        variances += variance
        weighted += variance**2 / (count - 1)
    return variances**2 / weighted if weighted > 0.0 else math.inf
