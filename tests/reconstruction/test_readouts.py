"""Several readouts of one scene: what they tell together, and how far the scene moved between."""

import math

import numpy as np
import pytest
import torch

from dolens.errors import InputError
from dolens.reconstruction import GeneralRestoration, WienerTVRestoration
from dolens.reconstruction.general import prepared
from dolens.reconstruction.likelihood import depth_probabilities, estimated_motion
from dolens.reconstruction.wiener import readouts_of, shifted
from dolens.sensor.colour import linear_to_srgb

SHOT, READ = 0.01, 4e-4


def disc(radius, size=17):
    offset = torch.arange(size) - size // 2
    distance = (offset[:, None].square() + offset.square()).float().sqrt()
    spot = (radius + 0.5 - distance).clamp(0.0, 1.0)
    return (spot / spot.sum()).expand(1, 3, size, size)


def textured(side, seed=0):
    """Light whose power falls as 1/f², about 0.4 of white."""
    generator = torch.Generator().manual_seed(seed)
    spectrum = torch.fft.rfft2(torch.randn(side, side, generator=generator))
    down, right = torch.fft.fftfreq(side)[:, None], torch.fft.rfftfreq(side)
    values = torch.fft.irfft2(spectrum / (down**2 + right**2 + side**-2.0).sqrt(), s=(side, side))
    return 0.4 + 0.12 * ((values - values.mean()) / values.std()).expand(3, side, side)


def imaged(light, function, side):
    """The middle of light behind a function (1, 3, K, K), by a convolution."""
    reach = function.shape[-1] // 2
    wide = torch.nn.functional.conv2d(light[None], function.transpose(0, 1), groups=3)[0]
    cut = (wide.shape[-1] - side) // 2
    assert cut >= 0 and reach > 0
    return wide[:, cut : cut + side, cut : cut + side]


def noisy(light, share, seed):
    shot, read = SHOT / share, READ / share**2
    generator = torch.Generator().manual_seed(seed)
    return light + (shot * light.clamp(min=0.0) + read).sqrt() * torch.randn(
        light.shape, generator=generator
    )


def noise_of(*shares):
    return torch.tensor([[SHOT / share, READ / share**2] for share in shares])


def test_the_mean_of_readouts_has_their_shot_noise_once_and_their_read_noise_as_often():
    raw, functions = torch.zeros(1, 4, 3, 8, 8), torch.zeros(4, 1, 3, 3, 3)
    found = readouts_of(raw, functions, noise_of(0.25, 0.25, 0.25, 0.25))
    torch.testing.assert_close(found.noise, torch.tensor([SHOT, 4 * READ]))


def test_readouts_weigh_as_the_inverse_of_their_variances():
    generator = torch.Generator().manual_seed(0)
    shares = (0.2, 0.8)
    raw = torch.stack(
        [
            0.2
            + noise_of(s)[0].mul(torch.tensor([0.2, 1.0])).sum().sqrt()
            * torch.randn(1, 3, 400, 400, generator=generator)
            for s in shares
        ],
        dim=1,
    )
    found = readouts_of(raw, torch.zeros(2, 1, 3, 3, 3), noise_of(*shares))
    told = float(0.2 * found.noise[0] + found.noise[1])
    assert float(found.mean.var()) == pytest.approx(told, rel=0.01)
    # No other weights have less.
    for weight in (0.1, 0.15, 0.3):
        other = weight * raw[:, 0] + (1.0 - weight) * raw[:, 1]
        assert float(other.var()) >= 0.999 * float(found.mean.var())


def test_readouts_that_see_alike_are_one_readout_of_all_their_light():
    raw = textured(40)[None]
    one = prepared(raw, disc(2.0), torch.tensor([SHOT, 2 * READ]))
    stack = raw[:, None].expand(-1, 2, -1, -1, -1)
    two = prepared(stack, disc(2.0)[None].expand(2, -1, -1, -1, -1), noise_of(0.5, 0.5))
    for mine, other in zip(one, two, strict=True):
        torch.testing.assert_close(mine, other, rtol=1e-4, atol=1e-5)


def test_the_filters_of_readouts_are_those_of_least_squares_over_all_of_them():
    """Grey light passes by Σ w·|H|²/(Σ w·|H|² + φ·r), and the noise by Σ w·|H|² over its square."""
    functions, noise = torch.stack([disc(1.0), disc(3.0)]), noise_of(0.25, 0.75)
    known = prepared(torch.stack([textured(32)] * 2)[None], functions, noise).known[0].numpy()
    variance = 0.2 * noise[:, 0].double().numpy() + noise[:, 1].double().numpy()
    weights = (1.0 / variance) / (1.0 / variance).sum()
    side = 128
    spots = functions[:, 0, 0].double().numpy()
    power = (weights[:, None, None] * np.abs(np.fft.fft2(spots, s=(side, side))) ** 2).sum(0)
    frequency = np.fft.fftfreq(side) / 0.5
    square = frequency[:, None] ** 2 + frequency**2
    ratio = 0.1 / (1.0 / variance).sum() / (0.25 / 100.0 + (3.0 / 100.0) ** 2)  # of the weak filter
    passed = power / (power + square * ratio)
    density = power / (power + square * ratio) ** 2
    radius = np.sqrt(square)
    bands = [(radius >= a) & (radius < b) for a, b in ((0.0, 0.125), (0.25, 0.375), (0.75, 1.0))]
    for band, number in zip(bands, (0, 2, 5), strict=True):
        # Half of the frequencies are held, their first and last columns among them.
        half = band[:, : side // 2 + 1]
        mean = passed[:, : side // 2 + 1][half].mean()
        assert known[3 + number] == pytest.approx(mean, rel=1e-4)
        noisy_by = density[:, : side // 2 + 1][half].mean()
        deviation = 2.0 * known[0]  # its logarithm's double is the variance's
        assert known[3 + 24 + number] == pytest.approx(math.log10(noisy_by) + deviation, abs=1e-4)


@pytest.mark.parametrize("network", [GeneralRestoration(by_depth=True), WienerTVRestoration()])
def test_one_readout_in_a_list_is_one_readout(network):
    raw, functions = textured(40)[None], torch.cat([disc(1.0), disc(3.0)])
    noise = torch.tensor([SHOT, READ])
    with torch.no_grad():
        alone = network(raw, functions, None, noise)
        listed = network(raw[:, None], functions[None], None, noise[None])
    torch.testing.assert_close(listed, alone, rtol=1e-4, atol=2e-4)


def test_a_bracket_restores_two_depths_that_one_focus_between_them_loses():
    """Equal light: two sharp halves of it against all of it, blurred."""
    network, side = GeneralRestoration(by_depth=True).eval(), 96
    light = textured(side + 32, 5)
    truth = light[:, 16:-16, 16:-16]
    one = noisy(imaged(light, disc(4.0), side), 1.0, 1)[None]
    sharp, soft = imaged(light, disc(0.0), side), imaged(light, disc(8.0), side)
    bracket = torch.stack([noisy(sharp, 0.5, 2), noisy(soft, 0.5, 3)])[None]
    functions = torch.stack([torch.cat([disc(0.0), disc(8.0)]), torch.cat([disc(8.0), disc(0.0)])])
    noise = torch.tensor([SHOT, READ])

    def error(picture):
        return float((picture - linear_to_srgb(truth)).square().mean())

    with torch.no_grad():
        alone = network(one, torch.cat([disc(4.0), disc(4.0)]), None, noise)
        both = network(bracket, functions, None, noise_of(0.5, 0.5))
    assert error(both[0]) < 0.5 * error(alone[0])


def test_two_sides_of_focus_look_alike_in_one_readout_and_unlike_in_two():
    side, light = 64, textured(96)
    noise = torch.tensor([SHOT, READ])
    both = torch.cat([disc(3.0), disc(3.0)])
    one = depth_probabilities(noisy(imaged(light, disc(3.0), side), 1.0, 1)[None], both, noise)
    torch.testing.assert_close(one, torch.full_like(one, 0.5))
    functions = torch.stack([torch.cat([disc(1.0), disc(5.0)]), torch.cat([disc(5.0), disc(1.0)])])
    bracket = torch.stack(
        [
            noisy(imaged(light, disc(1.0), side), 0.5, 2),
            noisy(imaged(light, disc(5.0), side), 0.5, 3),
        ]
    )
    two = depth_probabilities(bracket[None], functions, noise_of(0.5, 0.5))
    assert float(two[0, 0].mean()) > 0.99


def test_a_shift_moves_waves_by_fractions_of_a_pixel():
    row, column = torch.arange(40.0)[:, None], torch.arange(50.0)

    def wave(down, right):
        return (0.4 * (row - down) + 0.7 * (column - right)).sin()

    found = shifted(wave(0.0, 0.0), torch.tensor([0.6, -1.3]))
    inner = (slice(12, -12), slice(12, -12))
    assert float((found - wave(0.6, -1.3))[inner].abs().max()) < 0.02


@pytest.mark.parametrize("light", [1.0, 100.0])
def test_motion_between_blurred_readouts_is_found(light):
    """Of 96×96 pixels behind blurs of unlike radius, at 100 and 10 000 electrons in white."""
    functions = torch.stack(
        [
            torch.cat([disc(0.0), disc(4.0)]),
            torch.cat([disc(2.0), disc(2.0)]),
            torch.cat([disc(4.0), disc(0.0)]),
        ]
    )
    truth = torch.tensor([[-0.7, 0.9], [0.0, 0.0], [0.7, -0.9]])
    worst = 0.0
    for seed, depth in ((3, 0), (4, 1)):
        scene = textured(160, seed)
        images = [
            noisy(
                imaged(shifted(scene, move), f[depth : depth + 1], 96), light / 3.0, 10 * seed + n
            )
            for n, (move, f) in enumerate(zip(truth, functions, strict=True))
        ]
        noise = noise_of(*[light / 3.0] * 3)
        found = estimated_motion(torch.stack(images)[None], functions, noise, 1, 3.0)[0]
        worst = max(worst, float((found - truth).abs().max()))
    assert worst < (0.3 if light == 1.0 else 0.1)


def test_readouts_and_functions_of_unlike_numbers_are_refused():
    raw = torch.zeros(1, 2, 3, 16, 16)
    with pytest.raises(InputError, match="readouts"):
        readouts_of(raw, disc(1.0)[None].expand(3, -1, -1, -1, -1), noise_of(0.5, 0.5))
    with pytest.raises(InputError, match="point_spread_functions"):
        prepared(raw, disc(1.0), noise_of(0.5, 0.5))
