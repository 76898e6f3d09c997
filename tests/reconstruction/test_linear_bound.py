"""The least error of linear restoration: closed forms, and simulated restorations."""

import math

import pytest
import torch

from dolens.reconstruction.wiener import linear_error, natural_spectrum

SIDE = 64


def blur(width, size=33):
    x = torch.arange(size, dtype=torch.float64) - size // 2
    one = torch.exp(-0.5 * (x / width) ** 2)
    two = one[:, None] * one[None, :]
    return two / two.sum()


def spectrum(variance=0.04):
    return natural_spectrum(SIDE, SIDE, variance, 32.0, torch.zeros((), dtype=torch.float64))


def test_the_spectrum_averages_to_the_variance():
    power = spectrum(0.07)
    full = torch.cat([power, power[:, 1:-1]], dim=1)  # the half that the transform leaves out
    assert float(full.mean()) == pytest.approx(0.07, rel=1e-12)
    assert float(power[0, 8] / power[0, 16]) == pytest.approx(
        ((16 / SIDE) ** 2 + 1 / 32**2) / ((8 / SIDE) ** 2 + 1 / 32**2), rel=1e-12
    )


def test_without_blur_and_with_white_signal_it_is_wiener_s_scalar():
    point = torch.zeros(1, 3, 3, dtype=torch.float64)
    point[0, 1, 1] = 1.0
    white = torch.full((SIDE, SIDE // 2 + 1), 0.04, dtype=torch.float64)
    found = linear_error(point, white, 0.01)
    assert float(found.common_filter[0]) == pytest.approx(0.04 * 0.01 / 0.05, rel=1e-12)
    assert torch.allclose(found.common_filter, found.filter_per_depth)


def test_a_filter_that_serves_several_depths_is_worse_than_one_for_each():
    functions = torch.stack([blur(0.7), blur(2.0), blur(4.0)])
    found = linear_error(functions, spectrum(), 1e-4)
    assert bool((found.common_filter > found.filter_per_depth).all())
    same = linear_error(blur(2.0).expand(3, -1, -1), spectrum(), 1e-4)
    assert torch.allclose(same.common_filter, same.filter_per_depth)


def test_simulated_restorations_have_these_errors():
    # White noise shaped by the spectrum, blurred, made noisy, and filtered as the docstring says.
    generator = torch.Generator().manual_seed(0)
    noise, power, count = 1e-3, spectrum(), 400
    functions = torch.stack([blur(0.7), blur(2.5)])
    transfer = torch.fft.rfft2(functions, s=(SIDE, SIDE))
    white = torch.randn(count, 1, SIDE, SIDE, generator=generator, dtype=torch.float64)
    image = torch.fft.rfft2(white) * power.sqrt()
    grain = torch.randn(count, 2, SIDE, SIDE, generator=generator, dtype=torch.float64)
    taken = image * transfer + math.sqrt(noise) * torch.fft.rfft2(grain)
    best = power * transfer.conj().mean(0)
    best = best / (power * transfer.abs().square().mean(0) + noise)
    left = torch.fft.irfft2(taken * best - image, s=(SIDE, SIDE)).square().mean((0, 2, 3))
    expected = linear_error(functions, power, noise).common_filter
    assert torch.allclose(left, expected, rtol=0.03)
    # It is the least mean error: a filter a little off is worse.
    for factor in (0.97, 1.03):
        off = torch.fft.irfft2(factor * best * taken - image, s=(SIDE, SIDE)).square().mean()
        assert float(off) > float(left.mean())
