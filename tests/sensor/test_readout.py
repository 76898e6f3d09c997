"""From light to numbers: noise, saturation, codes, and what gradients pass."""

import math

import numpy as np
import pytest
import scipy.stats
import torch

from dolens.errors import InputError
from dolens.sensor.colour import mosaic
from dolens.sensor.noise import add_read_noise, add_shot_noise, shot_noise_deviation
from dolens.sensor.readout import Readout, quantise

MANY = 400_000  # values, for statistics


def seeded(seed=0):
    return torch.Generator().manual_seed(seed)


def uniform(level, count=MANY):
    return torch.full((1, 1, count), level, dtype=torch.float64)


def random(*shape, seed=0):
    return torch.rand(shape, dtype=torch.float64, generator=seeded(seed))


def variance_s_error(variance, count=MANY):
    """Standard error of the variance of normal values."""
    return variance * math.sqrt(2.0 / count)


# ---------------------------------------------------------------- what is off changes nothing


def test_by_default_the_numbers_are_the_light():
    image = random(2, 3, 4, 5)
    readout = Readout()
    assert readout(image, seeded()) is image
    assert readout.develop(image) is image


def test_read_noise_alone_adds_the_generator_s_normal_numbers():
    image = random(2, 3, 4, 5).float()
    normal = torch.randn(2, 3, 4, 5, generator=seeded(7))
    assert torch.equal(Readout(read_noise=0.005)(image, seeded(7)), image + 0.005 * normal)


def test_read_noise_has_its_standard_deviation_and_its_seed():
    image = torch.full((200, 200), 0.5, dtype=torch.float64)
    one = add_read_noise(image, 0.01, seeded(1))
    two = add_read_noise(image, 0.01, seeded(1))
    assert torch.equal(one, two)
    assert float((one - image).std()) == pytest.approx(0.01, rel=0.02)
    assert add_read_noise(image, 0.0, seeded()) is image


def test_a_black_level_without_a_converter_has_no_effect():
    image = random(3, 4, 5)
    assert Readout(black_level=0.1)(image, seeded()) is image


# ---------------------------------------------------------------- noise


def test_shot_noise_is_drawn_before_read_noise():
    image, generator = 0.1 + random(3, 4, 5), seeded(3)
    shot, read = (
        torch.randn(3, 4, 5, generator=generator, dtype=torch.float64) for _ in ("shot", "read")
    )
    expected = image + (image / 500.0).sqrt() * shot + 0.01 * read
    found = Readout(full_well=500.0, read_noise=0.01)(image, seeded(3))
    torch.testing.assert_close(found, expected, rtol=0, atol=1e-15)


def test_the_generator_decides_everything():
    readout = Readout(full_well=500.0, read_noise=0.01, bits=10, black_level=0.1, pattern="RGGB")
    image = random(3, 8, 8)
    one, two, other = (readout(image, seeded(seed)) for seed in (5, 5, 6))
    assert torch.equal(one, two)
    assert not torch.equal(one, other)


def test_behind_colour_filters_each_pixel_has_one_noise():
    image = torch.ones(2, 3, 40, 50)
    raw = Readout(read_noise=0.1, pattern="RGGB")(image, seeded())
    assert raw.shape == (2, 1, 40, 50)
    assert raw.unique().numel() == pytest.approx(raw.numel(), rel=0.01)


@pytest.mark.parametrize("electrons", [1.0, 4.0, 50.0, 1000.0])
def test_shot_noise_has_the_mean_and_variance_of_poisson(electrons):
    full_well = 2000.0
    image = uniform(electrons / full_well)
    counts = full_well * add_shot_noise(image, full_well, seeded())
    assert float(counts.mean()) == pytest.approx(electrons, abs=5 * math.sqrt(electrons / MANY))
    assert float(counts.var()) == pytest.approx(electrons, abs=5 * variance_s_error(electrons))
    drawn = torch.poisson(full_well * image, generator=seeded(1))
    # The variance of a Poisson sample's variance has the fourth cumulant besides, μ/n.
    error = math.sqrt((2 * electrons**2 + electrons) / MANY)
    assert float(counts.var() - drawn.var()) == pytest.approx(0.0, abs=7 * error)


@pytest.mark.parametrize("electrons", [4.0, 20.0, 500.0])
def test_shot_noise_misses_poisson_s_distribution_by_its_skewness_alone(electrons):
    # Edgeworth: at a half integer the two distribution functions differ by (1 - x²)·φ(x)·γ/6 to
    # first order, at most γ/(6·√(2π)) with Poisson's skewness γ = 1/√μ.
    counts = 1e4 * add_shot_noise(uniform(electrons / 1e4), 1e4, seeded())
    k = np.arange(int(electrons + 6 * math.sqrt(electrons)) + 1)
    gaussian = np.searchsorted(np.sort(counts.flatten().numpy()), k + 0.5) / MANY
    distance = np.abs(gaussian - scipy.stats.poisson.cdf(k, electrons)).max()
    skewness = 1.0 / math.sqrt(electrons)
    assert distance == pytest.approx(skewness / 6 / math.sqrt(2 * math.pi), rel=0.15, abs=0.002)


def test_below_one_electron_the_deviation_is_smooth_and_falls_to_zero():
    electrons = torch.linspace(0.0, 1.0, 1001, dtype=torch.float64)
    short = electrons - shot_noise_deviation(electrons) ** 2
    assert float(short.min()) >= 0.0
    assert 0.13 < float(short.max()) < 0.14
    joint = torch.tensor([1.0 - 1e-9, 1.0, 1.0 + 1e-9], dtype=torch.float64, requires_grad=True)
    deviation = shot_noise_deviation(joint)
    (slope,) = torch.autograd.grad(deviation.sum(), joint)
    torch.testing.assert_close(deviation, torch.ones_like(joint), rtol=0, atol=1e-8)
    torch.testing.assert_close(slope, torch.full_like(joint, 0.5), rtol=0, atol=1e-8)
    dark = shot_noise_deviation(torch.tensor([0.0, -3.0], dtype=torch.float64))
    assert dark.tolist() == [0.0, 0.0]


PHOTON_TRANSFER = {
    "shot": Readout(full_well=2000.0),
    "shot and read": Readout(full_well=2000.0, read_noise=0.012),
    "shot, read and codes": Readout(full_well=2000.0, read_noise=0.012, bits=6, black_level=0.1),
    "underexposed": Readout(0.25, full_well=500.0, read_noise=0.012, bits=6, black_level=0.1),
}


@pytest.mark.parametrize("case", PHOTON_TRANSFER)
@pytest.mark.parametrize("level", [0.02, 0.2, 0.6])
def test_the_photon_transfer_curve(case, level):
    readout = PHOTON_TRANSFER[case]
    raw = readout(uniform(level), seeded())
    mean = readout.exposure * level
    step = 0.0 if readout.bits is None else 1.0 / (0.9 * 63)
    variance = mean / readout.full_well + readout.read_noise**2 + step**2 / 12
    assert float(raw.mean()) == pytest.approx(mean, abs=5 * math.sqrt(variance / MANY))
    assert float(raw.var()) == pytest.approx(variance, abs=5 * variance_s_error(variance))


@pytest.mark.parametrize("exposure", [0.125, 0.5, 2.0])
def test_the_mean_is_proportional_to_the_exposure_and_developed_to_the_light(exposure):
    readout = Readout(exposure, full_well=5000.0, read_noise=0.002, bits=10, black_level=0.05)
    raw = readout(uniform(0.3), seeded())
    error = float(raw.std()) / math.sqrt(MANY)
    assert float(raw.mean()) == pytest.approx(exposure * 0.3, abs=5 * error)
    developed = float(readout.develop(raw).mean())
    assert developed == pytest.approx(0.3, abs=5 * error / exposure)


# ---------------------------------------------------------------- saturation and codes


@pytest.mark.parametrize("options", [{"saturate": True}, {"bits": 12}])
@pytest.mark.parametrize("black_level", [0.0, 0.25])
def test_beyond_full_scale_and_below_the_black_level_values_are_clipped(options, black_level):
    image = torch.tensor([[[-2.0, 1.0, 1.001, 7.0]]], dtype=torch.float64)
    raw = Readout(black_level=black_level, **options)(image, seeded())
    floor = -black_level / (1.0 - black_level)
    torch.testing.assert_close(
        raw[0, 0], torch.tensor([floor, 1.0, 1.0, 1.0], dtype=torch.float64), rtol=0, atol=1e-15
    )


def test_the_exposure_decides_what_saturates():
    white = torch.ones(1, 2, 2)
    readout = Readout(exposure=2.0, saturate=True)
    assert torch.equal(readout(white, seeded()), white)
    assert torch.equal(readout.develop(readout(white, seeded())), 0.5 * white)


def test_without_a_black_level_the_dark_is_too_bright():
    # Of normal noise only the positive half is left: its mean is σ/√(2π).
    dark, sigma = uniform(0.0), 0.01
    clipped = Readout(read_noise=sigma, bits=16)(dark, seeded())
    assert float(clipped.mean()) == pytest.approx(sigma / math.sqrt(2 * math.pi), rel=0.01)
    kept = Readout(read_noise=sigma, bits=16, black_level=0.0625)(dark, seeded())
    assert float(kept.mean()) == pytest.approx(0.0, abs=5 * sigma / math.sqrt(MANY))
    assert float(kept.std()) == pytest.approx(sigma, rel=0.01)


@pytest.mark.parametrize("bits", [1, 2, 8, 12, 16])
def test_codes_are_whole_numbers_and_the_nearest_ones(bits):
    signal = random(1000)
    quantised = quantise(signal, bits)
    codes = quantised * (2**bits - 1)
    torch.testing.assert_close(codes, codes.round(), rtol=1e-15, atol=0)
    assert float(codes.min()) >= 0.0 and float(codes.max()) <= 2**bits - 1
    assert float((quantised - signal).abs().max()) <= 0.5 / (2**bits - 1) * (1 + 1e-12)
    ends = torch.tensor([0.0, 1.0], dtype=torch.float64)
    assert torch.equal(quantise(ends, bits), ends)


def test_a_black_level_is_its_code_and_light_has_the_rest():
    # Eight bits, black at code 51: 204 codes for the light.
    raw = Readout(bits=8, black_level=0.2)(
        torch.tensor([[[0.0, 0.5, 1 / 204, 0.6 / 204]]]), seeded()
    )
    expected = torch.tensor([0.0, 102 / 204, 1 / 204, 1 / 204])
    torch.testing.assert_close(raw[0, 0], expected, rtol=0, atol=1e-7)


# ---------------------------------------------------------------- gradients


def gradient(readout, image, seed=0):
    image = image.clone().requires_grad_()
    readout(image, seeded(seed)).sum().backward()
    return image.grad


def test_gradients_pass_the_codes_and_end_at_saturation():
    image = torch.tensor([[[-0.2, 0.0, 0.004, 0.5, 1.0, 1.2]]], dtype=torch.float64)
    found = gradient(Readout(bits=4), image)
    assert found.flatten().tolist() == [0.0, 1.0, 1.0, 1.0, 1.0, 0.0]
    found = gradient(Readout(exposure=0.5, bits=4, black_level=0.3), image)
    torch.testing.assert_close(found, torch.full_like(image, 0.5))


def test_gradients_are_finite_without_light():
    readout = Readout(full_well=1000.0, read_noise=0.002)
    dark = torch.zeros(3, 4, 5, dtype=torch.float64)
    # The mean's slope is 1, the deviation's 3/2 an electron.
    normal = torch.randn(3, 4, 5, generator=seeded(2), dtype=torch.float64)
    torch.testing.assert_close(gradient(readout, dark, seed=2), 1.0 + 1.5 * normal)


@pytest.mark.parametrize(
    "readout",
    [
        Readout(full_well=50.0),
        Readout(exposure=1.7, full_well=50.0, read_noise=0.1, pattern="BGGR"),
        Readout(exposure=3.0, full_well=50.0, saturate=True, black_level=0.1),
    ],
)
def test_with_the_noise_held_gradients_are_those_of_finite_differences(readout):
    # Of 50 electrons, from a third of one up: both branches of the deviation; the last one clips.
    image = 0.007 + 0.6 * random(3, 4, 4) ** 3
    assert float(image.min()) * 50 < 1.0 < float(image.max()) * 50

    def developed(image):
        return readout.develop(readout(image, seeded(4)))

    assert torch.autograd.gradcheck(developed, image.requires_grad_())


# ---------------------------------------------------------------- behind colour filters


def test_a_uniform_colour_survives_filters_and_interpolation():
    colour = torch.tensor([0.8, 0.3, 0.1], dtype=torch.float64)[:, None, None].expand(3, 7, 6)
    readout = Readout(exposure=0.5, bits=14, black_level=0.0625, pattern="GRBG")
    raw = readout(colour, seeded())
    step = 1.0 / (0.9375 * (2**14 - 1))
    torch.testing.assert_close(raw, 0.5 * mosaic(colour, "GRBG"), rtol=0, atol=step / 2)
    # Weights of one kernel's values add up to 20 eighths at most in magnitude, of E = 1/2.
    torch.testing.assert_close(readout.develop(raw), colour, rtol=0, atol=20 / 8 * step)


def test_the_precision_is_the_image_s():
    readout = Readout(full_well=500.0, read_noise=0.01, bits=10, black_level=0.1, pattern="RGGB")
    raw = readout(random(3, 6, 6).float(), seeded())
    assert raw.dtype == torch.float32 and readout.develop(raw).dtype == torch.float32


# ---------------------------------------------------------------- bad input


BAD_INPUT = {
    "exposure": (0.0, -1.0, math.nan, math.inf, None, "bright"),
    "full_well": (0, -100.0, math.inf, "large"),
    "read_noise": (-0.001, math.nan, None),
    "bits": (0, 17, 9.5, "12"),
    "saturate": ("no", 2),
    "black_level": (-0.1, 1.0, None),
}


@pytest.mark.parametrize(("key", "value"), [(k, v) for k, vs in BAD_INPUT.items() for v in vs])
def test_bad_settings_give_one_line_with_the_key_and_what_is_allowed(key, value):
    with pytest.raises(InputError, match=rf"^readout: {key} is {value}; allowed: .+$") as caught:
        Readout(**{key: value})
    assert "\n" not in str(caught.value)


def test_an_unknown_pattern_is_named_with_the_known_ones():
    with pytest.raises(InputError, match=r"'XTRANS' is unknown \(allowed: RGGB, GRBG, GBRG, BGGR"):
        Readout(pattern="XTRANS")


def test_colour_filters_need_three_channels():
    with pytest.raises(InputError, match=r"\(\.\.\., 3, H, W\), not \(1, 4, 4\)"):
        Readout(pattern="RGGB")(torch.ones(1, 4, 4), seeded())
