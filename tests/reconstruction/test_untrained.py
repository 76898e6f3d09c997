"""Restorers that nothing has trained: noise is made even, and means are undone without bias."""

import sys
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from dolens.errors import InputError
from dolens.reconstruction import WienerBM3DRestoration, WienerTVRestoration, psnr_db
from dolens.reconstruction.opponent_wiener import colour_filters, correlations
from dolens.reconstruction.untrained import VarianceStabiliser, noise_power, resampled_spectrum
from dolens.sensor.colour import linear_to_srgb
from dolens.sensor.readout import Readout

NOISE = torch.tensor([0.01, 0.0009])  # 100 electrons in white, read noise of 3
LIGHT = torch.tensor([0.03, 0.1, 0.3, 1.0]).double()


def disc(size=9, radius=2.5):
    """A defocused point of unit sum, of three colours."""
    x = torch.arange(size) - size // 2
    inside = ((x[:, None] ** 2 + x**2) <= radius**2).float()
    return (inside / inside.sum()).expand(1, 3, size, size).clone()


def blurred(truth, functions):
    """Linear light (3, H, W) behind the first of some functions, around the edges."""
    size = functions.shape[-1]
    padded = torch.zeros_like(truth)
    padded[:, :size, :size] = functions[0]
    padded = padded.roll((-(size // 2), -(size // 2)), (-2, -1))
    return torch.fft.irfft2(torch.fft.rfft2(truth) * torch.fft.rfft2(padded), s=truth.shape[-2:])


def sensed(truth, functions, seed=0):
    """What a sensor gives of linear light (3, H, W): blurred around the edges, with noise."""
    image = blurred(truth, functions)
    generator = torch.Generator().manual_seed(seed)
    noise = torch.randn(truth.shape, generator=generator)
    return image + (NOISE[0] * image + NOISE[1]).sqrt() * noise


def of_light(draws):
    """Gaussian noise of the sensor's variance at each light, (4, 1, draws)."""
    generator = torch.Generator().manual_seed(1)
    normal = torch.randn(len(LIGHT), 1, draws, generator=generator, dtype=torch.float64)
    return LIGHT[:, None, None] + (NOISE[0] * LIGHT + NOISE[1]).sqrt()[:, None, None] * normal


def test_noise_has_the_same_strength_at_any_light():
    even = VarianceStabiliser(*NOISE.double()[:, None].expand(2, 4))
    assert of_light(10).std(dim=-1).ravel()[-1] > 2.5 * of_light(10_000).std(dim=-1).ravel()[0]
    found = even.stabilised(of_light(100_000)).std(dim=-1).flatten()
    assert torch.allclose(found, torch.ones(4).double(), atol=0.03)


def test_a_mean_is_undone_without_bias():
    even = VarianceStabiliser(*NOISE.double()[:, None].expand(2, 4))
    means = even.stabilised(of_light(1_000_000)).mean(dim=-1, keepdim=True)
    # The mean of a million draws is known to a thousandth of their deviation.
    deviation = (NOISE[0] * LIGHT + NOISE[1]).sqrt()
    errors = (even.undone(means).flatten() - LIGHT) / deviation
    assert errors.abs().max() < 4e-3
    # The plain inverse of the function is darker, by a quarter of the slope.
    plain = ((NOISE[0] / 2.0 * means) ** 2 - 0.375 * NOISE[0] ** 2 - NOISE[1]) / NOISE[0]
    assert ((plain.flatten() - LIGHT) / deviation).abs().min() > 8e-3


def test_the_noise_behind_a_filter_has_the_spectrum_that_is_foretold():
    rows, columns = 48, 45
    functions = disc()
    matched, power = correlations(functions, rows, columns)
    filters = colour_filters(power[None], matched[None], torch.tensor([[0.3, 2.0, 6.0]]), columns)[
        0
    ]
    white = torch.randn(400, 3, rows, columns, generator=torch.Generator().manual_seed(2))
    found = torch.einsum("cduv,bduv->bcuv", filters, torch.fft.rfft2(white))
    coloured = torch.fft.irfft2(found, s=(rows, columns))
    expected = noise_power(filters, columns)
    measured = torch.fft.fft2(coloured).abs().square().mean(dim=0) / (rows * columns)
    assert torch.allclose(measured, expected, rtol=0.35, atol=1e-3 * float(expected.max()))
    assert torch.allclose(coloured.var(dim=(0, 2, 3)), expected.mean(dim=(-2, -1)), rtol=0.01)
    # At other frequencies it is the same noise: its correlation from pixel to pixel stays.
    spectrum = torch.from_numpy(resampled_spectrum(expected, 40, 40)).permute(2, 0, 1)
    near = torch.fft.ifft2(spectrum).real[:, 0, :4]
    correlation = torch.fft.ifft2(expected.double()).real
    assert torch.allclose(near, correlation[:, 0, :4] / correlation[:, 0, :1], atol=0.02)


def test_a_grey_plane_stays_as_bright_and_loses_its_grain():
    truth = torch.full((3, 96, 96), 0.2)
    restored = WienerTVRestoration()(sensed(truth, disc())[None], disc(), None, NOISE)[0]
    grey = float(linear_to_srgb(torch.tensor(0.2)))
    inner = restored[:, 8:-8, 8:-8]
    assert float(inner.mean()) == pytest.approx(grey, abs=2e-3)
    noise = (linear_to_srgb(sensed(truth, disc())) - grey).std()
    assert float(inner.std()) < 0.1 * float(noise)


def test_edges_gain_more_than_a_decibel_over_the_filter_alone():
    truth = torch.full((3, 96, 96), 0.1)
    truth[:, 20:60, 30:80] = torch.tensor([0.7, 0.5, 0.2])[:, None, None]
    raw = sensed(truth, disc())[None]
    encoded = linear_to_srgb(truth)[None]
    tv = WienerTVRestoration()(raw, disc(), None, NOISE).clamp(0.0, 1.0)
    filtered = WienerTVRestoration((1.0, 7.0, 20.0), 1e-6)(raw, disc(), None, NOISE)
    assert psnr_db(tv, encoded) > psnr_db(filtered.clamp(0.0, 1.0), encoded) + 1.0


def test_bm3d_is_told_the_power_of_the_noise_at_every_frequency(monkeypatch):
    """By a stand-in: the package is not for everybody, and not needed for this."""
    told = {}

    def bm3d_rgb(image, spectrum):
        told.update(image=image, spectrum=spectrum)
        return np.full_like(image, image.mean())

    monkeypatch.setattr("dolens.reconstruction.untrained.bm3d_is_installed", lambda: True)
    monkeypatch.setitem(sys.modules, "bm3d", SimpleNamespace(bm3d_rgb=bm3d_rgb))
    truth = torch.full((3, 64, 64), 0.3)
    restored = WienerBM3DRestoration(strength=1.0)(sensed(truth, disc())[None], disc(), None, NOISE)
    assert float(restored.mean()) == pytest.approx(float(linear_to_srgb(truth).mean()), abs=0.01)
    # Its convention: power of the transform, without a factor; the variance is its mean over N.
    variance = told["spectrum"].mean(axis=(0, 1)) / 64**2
    inner = told["image"][8:-8, 8:-8]
    assert np.allclose(variance, 1.0, atol=1e-9)
    assert np.allclose(inner.var(axis=(0, 1)), 1.0, atol=0.35)


def test_what_is_missing_is_one_line(monkeypatch):
    monkeypatch.setattr("dolens.reconstruction.untrained.bm3d_is_installed", lambda: False)
    with pytest.raises(InputError, match=r"needs the package bm3d: pip install dolens\[bm3d\]"):
        WienerBM3DRestoration()
    with pytest.raises(InputError, match="the sensor's noise"):
        WienerTVRestoration()(torch.zeros(1, 3, 16, 16), disc(), None, None)
    for settings in ({"weight": 0.0}, {"noise_to_signal": [1.0, 0.0, 1.0]}):
        with pytest.raises(InputError, match=next(iter(settings))):
            WienerTVRestoration(**settings)


@pytest.mark.parametrize("bits", [None, 8])
def test_the_noise_of_a_developed_image_is_what_the_readout_says(bits):
    readout = Readout.at_light(7000.0, 8000.0, read_noise=0.002, bits=bits, black_level=0.1)
    shot, read = readout.noise
    for light in (0.2, 0.8):
        image = torch.full((1, 3, 400, 400), light)
        developed = readout.develop(readout(image, torch.Generator().manual_seed(3)))
        assert float(developed.var()) == pytest.approx(shot * light + read, rel=0.02)
