"""Wiener's filter, and the least error of any linear restoration."""

import math

import pytest
import torch
from torch.nn import functional

from dolens.reconstruction import wiener_deconvolve
from dolens.reconstruction.wiener import linear_error, natural_spectrum

DOUBLE = torch.float64


def delta(size, row=None, column=None, channels=1):
    psf = torch.zeros(channels, size, size, dtype=DOUBLE)
    psf[:, size // 2 if row is None else row, size // 2 if column is None else column] = 1
    return psf


def comatic(size, channels=1):
    """A lopsided Gaussian of unit sum: it tells a convolution from a correlation."""
    y, x = torch.meshgrid(*[torch.arange(size, dtype=DOUBLE) - size // 2] * 2, indexing="ij")
    psf = torch.exp(-(x**2 + y**2) / 3) * (1 + 0.6 * torch.tanh(x - 0.5 * y))
    return (psf / psf.sum()).expand(channels, size, size).contiguous()


def blur(true, psf):
    """Σ_j psf[centre + i − j] true[j], where the kernel fits."""
    kernel = psf.flip(-2, -1)[:, None]
    return functional.conv2d(true, kernel, groups=true.shape[1])


def smooth_scene(size):
    y, x = torch.meshgrid(*[torch.arange(size, dtype=DOUBLE)] * 2, indexing="ij")
    waves = torch.sin(2 * math.pi * (0.11 * x + 0.07 * y)) + torch.cos(2 * math.pi * 0.16 * y)
    return (0.5 + 0.2 * waves)[None, None]


def psnr(a, b):
    return -10 * torch.log10((a - b).square().mean())


@pytest.mark.parametrize("dtype, tolerance", [(torch.float64, 1e-10), (torch.float32, 2e-6)])
def test_a_perfect_lens_without_noise_returns_the_image(dtype, tolerance):
    image = torch.rand(2, 3, 21, 34, generator=torch.Generator().manual_seed(0), dtype=DOUBLE)
    image = image.to(dtype)
    restored = wiener_deconvolve(image, delta(7, channels=3).to(dtype), 1e-12, margin=8)
    assert restored.dtype == dtype
    torch.testing.assert_close(restored, image, rtol=0, atol=tolerance)


@pytest.mark.parametrize("waves", [1, 5, 12])
def test_the_prior_attenuates_a_wave_by_its_squared_frequency(waves):
    ratio, size = 0.3, 24  # 24 is an FFT length: with no margin the wave is exactly periodic
    column = torch.arange(size, dtype=DOUBLE)
    wave = 0.1 * torch.cos(2 * math.pi * waves * column / size).expand(1, 1, size, size)
    restored = wiener_deconvolve(0.5 + wave, delta(3), ratio, margin=0)
    frequency = waves / size / 0.5  # of Nyquist
    torch.testing.assert_close(restored, 0.5 + wave / (1 + ratio * frequency**2))


def test_periodic_blur_is_undone_as_the_formula_says():
    generator = torch.Generator().manual_seed(3)
    true = torch.rand(1, 1, 20, 20, generator=generator, dtype=DOUBLE)
    psf = comatic(5)
    blurred = blur(functional.pad(true, (2, 2, 2, 2), mode="circular"), psf)
    restored = wiener_deconvolve(blurred, psf, 1e-13, margin=0)
    assert (blurred - true).abs().max() > 0.1
    torch.testing.assert_close(restored, true, rtol=0, atol=1e-6)


def test_a_blurred_band_limited_image_is_recovered_away_from_the_edges():
    psf = comatic(9)
    true = smooth_scene(96)
    blurred = blur(true, psf)
    true = true[..., 4:-4, 4:-4]
    restored = wiener_deconvolve(blurred, psf, 1e-3, margin=16)
    inner = (..., slice(16, -16), slice(16, -16))
    assert psnr(blurred[inner], true[inner]) < 25
    assert psnr(restored[inner], true[inner]) > 70
    # A correlation in place of the convolution makes it worse, so the test sees the difference.
    mirrored = wiener_deconvolve(blurred, psf.flip(-2, -1), 1e-3, margin=16)
    assert psnr(mirrored[inner], true[inner]) < 25


def test_a_shifted_point_spread_function_moves_the_image_back():
    true = torch.rand(1, 1, 30, 30, generator=torch.Generator().manual_seed(1), dtype=DOUBLE)
    down, right = 2, -3
    shifted = torch.roll(true, (down, right), (-2, -1))
    restored = wiener_deconvolve(shifted, delta(9, 4 + down, 4 + right), 1e-12, margin=6)
    inner = (..., slice(4, -4), slice(4, -4))
    torch.testing.assert_close(restored[inner], true[inner], rtol=0, atol=1e-9)


@pytest.mark.parametrize("ratio", [1e-4, 1.0, 100.0])
@pytest.mark.parametrize("margin", [0, 5])
def test_a_uniform_image_stays_uniform(ratio, margin):
    image = torch.full((1, 1, 17, 23), 0.37, dtype=DOUBLE)
    restored = wiener_deconvolve(image, comatic(11), ratio, margin)
    torch.testing.assert_close(restored, image, rtol=1e-12, atol=0)


def test_light_the_lens_lost_is_restored():
    image = torch.full((1, 1, 16, 16), 0.3, dtype=DOUBLE)
    restored = wiener_deconvolve(image, 0.6 * comatic(5), 1e-2, margin=4)
    torch.testing.assert_close(restored, image / 0.6)


def test_a_step_between_opposite_edges_leaves_no_ringing_at_either():
    ramp = torch.linspace(0, 1, 64, dtype=DOUBLE).expand(1, 1, 64, 64)
    restored = wiener_deconvolve(ramp, delta(3), 0.05, margin=32)
    torn = wiener_deconvolve(ramp, delta(3), 0.05, margin=0)
    assert (restored - ramp).abs().max() < 0.25 * (torn - ramp).abs().max()


def test_each_channel_has_its_own_lens_and_noise():
    image = torch.rand(1, 3, 16, 16, generator=torch.Generator().manual_seed(2), dtype=DOUBLE)
    psf = torch.cat([delta(5), comatic(5), delta(5, 1, 3)])
    ratio = torch.tensor([1e-1, 1e-2, 1e-3], dtype=DOUBLE)
    together = wiener_deconvolve(image, psf, ratio, margin=4)
    for channel in range(3):
        one = slice(channel, channel + 1)
        alone = wiener_deconvolve(image[:, one], psf[one], float(ratio[channel]), margin=4)
        torch.testing.assert_close(together[:, one], alone)


def test_gradients_with_respect_to_image_lens_and_noise_are_those_of_finite_differences():
    generator = torch.Generator().manual_seed(5)
    image = torch.rand(1, 2, 5, 6, generator=generator, dtype=DOUBLE, requires_grad=True)
    psf = comatic(3, channels=2).requires_grad_()
    ratio = torch.tensor([0.1, 0.02], dtype=DOUBLE, requires_grad=True)
    assert torch.autograd.gradcheck(
        lambda *tensors: wiener_deconvolve(*tensors, margin=2), (image, psf, ratio)
    )


def test_a_lens_that_passes_nothing_gives_finite_numbers_and_gradients():
    image = torch.rand(1, 1, 8, 8)
    psf = torch.zeros(1, 3, 3, requires_grad=True)
    restored = wiener_deconvolve(image, psf, 1e-2, margin=2)
    restored.sum().backward()
    assert restored.isfinite().all() and psf.grad.isfinite().all()


def test_a_point_spread_function_larger_than_the_image_is_no_obstacle():
    image = torch.full((1, 1, 6, 9), 0.5, dtype=DOUBLE)
    torch.testing.assert_close(wiener_deconvolve(image, comatic(31), 1e-2, margin=0), image)


def test_arguments_are_left_alone():
    image, psf = torch.rand(1, 1, 9, 9, dtype=DOUBLE), comatic(5)
    before = image.clone(), psf.clone()
    wiener_deconvolve(image, psf, 1e-2, margin=3)
    assert torch.equal(image, before[0]) and torch.equal(psf, before[1])


@pytest.mark.parametrize("shape", [(1, 4, 4), (1, 3, 5), (3, 3)])
def test_a_point_spread_function_without_a_central_pixel_is_refused(shape):
    with pytest.raises(ValueError, match="K odd"):
        wiener_deconvolve(torch.rand(1, 1, 8, 8), torch.rand(*shape), 1e-2, margin=2)


def test_wrong_channels_and_a_negative_margin_are_refused():
    image = torch.rand(1, 3, 8, 8)
    with pytest.raises(ValueError, match="2 channels for an image of 3 channels"):
        wiener_deconvolve(image, torch.rand(2, 3, 3), 1e-2, margin=2)
    with pytest.raises(ValueError, match="margin=-1"):
        wiener_deconvolve(image, torch.rand(3, 3, 3), 1e-2, margin=-1)


SIDE = 64


def gaussian(width, size=33):
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
    functions = torch.stack([gaussian(0.7), gaussian(2.0), gaussian(4.0)])
    found = linear_error(functions, spectrum(), 1e-4)
    assert bool((found.common_filter > found.filter_per_depth).all())
    same = linear_error(gaussian(2.0).expand(3, -1, -1), spectrum(), 1e-4)
    assert torch.allclose(same.common_filter, same.filter_per_depth)


def test_simulated_restorations_have_these_errors():
    # White noise shaped by the spectrum, blurred, made noisy, and filtered as the docstring says.
    generator = torch.Generator().manual_seed(0)
    noise, power, count = 1e-3, spectrum(), 400
    functions = torch.stack([gaussian(0.7), gaussian(2.5)])
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
