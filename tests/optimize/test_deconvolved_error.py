"""The deconvolved error against closed forms and differences."""

import math
from dataclasses import replace

import pytest
import torch

from dolens.errors import InputError
from dolens.optimize.deconvolved_error import (
    DeconvolvedError,
    Photographs,
    luminance_spectrum,
)
from dolens.optimize.ray_intercept_quality import RayGroups

PITCH, NOISE = 0.005, 2e-3
# Power of both differences of colours over that of luminance, in photographs.
COLOURS = torch.tensor([1.0, 0.07, 0.018], dtype=torch.float64)
GROUPS = RayGroups(torch.zeros(0), torch.zeros(0, dtype=torch.int64), torch.ones(1))


def views(count: int, rays: int, filters: list[int], **others) -> DeconvolvedError:
    """Views of three colours, each with as many rays of equal weight."""
    view = torch.arange(count).repeat_interleave(3 * rays)
    colour = torch.arange(3).repeat_interleave(rays).repeat(count)
    share = torch.full((len(view),), 1.0 / rays, dtype=torch.float64)
    weights = torch.full((count,), 1.0 / count, dtype=torch.float64)
    photographs = Photographs(PITCH, NOISE)
    return DeconvolvedError(
        view, colour, share, torch.tensor(filters), weights, photographs, **others
    )


def frequencies(error: DeconvolvedError) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Radii (cycles a pixel) with angles, areas of half the plane, and the natural spectrum."""
    lowest, highest = math.log(1.0 / 128.0), math.log(0.5)
    step = (highest - lowest) / error.rings
    radius = torch.exp(lowest + step * (torch.arange(error.rings, dtype=torch.float64) + 0.5))
    angle = math.pi / error.arms * (torch.arange(error.arms, dtype=torch.float64) + 0.5)
    radius, angle = torch.meshgrid(radius, angle, indexing="ij")
    area = radius.square() * step * math.pi / error.arms
    spectrum = 0.002 * (radius / 0.05) ** -0.4 * torch.exp(-((radius / 0.38) ** 2)) / radius**2
    return torch.stack([radius * angle.cos(), radius * angle.sin()]), area, spectrum


def pixel(frequency: torch.Tensor) -> torch.Tensor:
    """The transfer function of a square pixel."""
    return torch.sinc(frequency[0]) * torch.sinc(frequency[1])


def test_a_lens_without_blur_leaves_what_wiener_s_filter_leaves_of_noise_and_pixels():
    """With one H for all colours, Σ over opponent colours λ of ∫ SλN/(SλH² + N)."""
    error = views(1, 4, [0])
    frequency, area, spectrum = frequencies(error)
    transfer = pixel(frequency)
    left = sum(
        area * spectrum * c * NOISE / (spectrum * c * transfer.square() + NOISE) for c in COLOURS
    )
    expected = left.sum() / (area * spectrum * COLOURS.sum()).sum()
    points = torch.zeros(2, 12, dtype=torch.float64)
    assert error(points, GROUPS) == pytest.approx(float(expected), rel=1e-10)


def test_a_lens_without_a_filter_loses_what_the_pixels_and_two_rays_blur():
    """Two rays at ±d give H = cos(2πν·d); without a filter ∫ S(1 - H)² and the noise are left."""
    error = views(1, 2, [0], strength=0.0)
    offset = 0.4 * PITCH
    points = torch.zeros(2, 6, dtype=torch.float64)
    points[0] = offset * torch.tensor([1.0, -1.0] * 3, dtype=torch.float64)
    frequency, area, spectrum = frequencies(error)
    transfer = pixel(frequency) * torch.cos(2.0 * math.pi * frequency[0] * 0.4)
    left = area * (COLOURS.sum() * spectrum * (1.0 - transfer).square() + 3.0 * NOISE)
    expected = left.sum() / (area * spectrum * COLOURS.sum()).sum()
    assert error(points, GROUPS) == pytest.approx(float(expected), rel=1e-10)


def test_one_colour_that_is_sharp_helps_the_others():
    """Filters of each colour alone would leave a third of what three blurred colours leave."""
    error = views(1, 16, [0])
    generator = torch.Generator().manual_seed(1)
    blur = 3.0 * PITCH * torch.randn(2, 48, generator=generator, dtype=torch.float64)
    sharp, blurred = float(error(0.0 * blur, GROUPS)), float(error(blur, GROUPS))
    one = blur.clone()
    one[:, :32] = 0.0
    mixed = float(error(one, GROUPS))
    assert sharp < mixed < sharp + 0.75 * (blurred - sharp) / 3.0


def test_views_that_share_a_filter_are_worse_than_views_with_filters_of_their_own():
    generator = torch.Generator().manual_seed(2)
    points = 2.0 * PITCH * torch.randn(2, 2 * 3 * 8, generator=generator, dtype=torch.float64)
    points[:, :24] *= 0.2
    own = views(2, 8, [0, 1]).errors(points)
    shared = views(2, 8, [0, 0]).errors(points)
    assert bool((shared > own * (1.0 + 1e-9)).all())
    twice = torch.cat([points[:, :24]] * 2, 1)
    alike = views(2, 8, [0, 0]).errors(twice)
    assert alike.tolist() == pytest.approx([float(own[0])] * 2, rel=1e-10)


def test_the_filter_is_the_best_one():
    """Any other strength than 1 leaves more."""
    generator = torch.Generator().manual_seed(3)
    points = PITCH * torch.randn(2, 48, generator=generator, dtype=torch.float64)
    best = views(1, 16, [0])
    found = [float(replace(best, strength=s)(points, GROUPS)) for s in (0.0, 0.5, 0.9, 1.0)]
    assert found == sorted(found, reverse=True)


@pytest.mark.parametrize("strength", [1.0, 0.4])
def test_derivatives_over_ray_intercepts_against_differences(strength):
    """First and second, of three views of which two share a filter, by steps of 2 nm."""
    error = views(3, 6, [0, 0, 1], strength=strength, norm=3.0)
    generator = torch.Generator().manual_seed(4)
    points = 1.5 * PITCH * torch.randn(2, 54, generator=generator, dtype=torch.float64)
    moves = torch.randn(3, 2, 54, generator=generator, dtype=torch.float64)
    leaf = points.clone().requires_grad_()
    (slope,) = torch.autograd.grad(error(leaf, GROUPS), leaf)
    found = error.second_derivatives(points, GROUPS, moves)
    step = 2e-6
    for row, move in enumerate(moves):
        ahead, behind = (error(points + s * step * move, GROUPS) for s in (1.0, -1.0))
        here = error(points, GROUPS)
        assert float((slope * move).sum()) == pytest.approx(
            float(ahead - behind) / (2.0 * step), rel=1e-5, abs=1e-6
        )
        second = float(ahead - 2.0 * here + behind) / step**2
        assert float(found[row, row]) == pytest.approx(second, rel=1e-3)
    both = moves[0] + moves[1]
    mixed = error.second_derivatives(points, GROUPS, both[None])[0, 0]
    assert float(found[0, 0] + found[1, 1] + found[0, 1] + found[1, 0]) == pytest.approx(
        float(mixed), rel=1e-9
    )


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"norm": 0.5}, "norm: 0.5; allowed: 1 or more"),
        ({"strength": 1.5}, "strength: 1.5; allowed: 0 to 1"),
        ({"arms": 0}, "rings, arms: 10, 0"),
    ],
)
def test_settings_out_of_range_are_errors(settings, message):
    with pytest.raises(InputError, match=message):
        views(1, 2, [0], **settings)


def test_the_spectrum_is_that_of_photographs():
    """Luminance of 240 crops of 31 training photographs, rings of their Fourier transforms."""
    measured = {0.017: 12.8, 0.049: 0.833, 0.126: 0.0822, 0.253: 0.0112, 0.452: 0.000991}
    found = luminance_spectrum(torch.tensor(list(measured), dtype=torch.float64))
    assert found.tolist() == pytest.approx(list(measured.values()), rel=0.2)


def test_photographs_need_noise():
    with pytest.raises(InputError, match=r"noise: 0\.0; allowed: above 0"):
        Photographs(PITCH, 0.0)
