"""The likelihood of what the sensor saw tells the depth of each place."""

import pytest
import torch

from dolens.reconstruction import GeneralRestoration, psnr_db
from dolens.reconstruction.likelihood import depth_picture, depth_probabilities, picture_weights
from dolens.sensor.colour import linear_to_srgb
from tests.reconstruction.test_untrained import blurred, disc

NEAR, FAR = disc(13, 1.0), disc(13, 4.5)
DEPTHS = torch.cat([NEAR, FAR])


def natural(size=160, seed=0):
    """Grey light of spectrum 1/f², (3, size, size)."""
    generator = torch.Generator().manual_seed(seed)
    frequency = torch.fft.fftfreq(size)
    radius = (frequency[:, None] ** 2 + torch.fft.rfftfreq(size) ** 2).sqrt()
    radius[0, 0] = torch.inf
    values = torch.randn(size, size, generator=generator)
    field = torch.fft.irfft2(torch.fft.rfft2(values) / radius, s=(size, size))
    return (0.4 + 0.12 * field / field.std()).clamp(min=0.0).expand(3, size, size)


def two_depths(truth, light, seed=1):
    """The left half near, the right half far: what a sensor gives, (1, 3, H, W), and its noise."""
    half = truth.shape[-1] // 2
    image = torch.cat([blurred(truth, NEAR)[..., :half], blurred(truth, FAR)[..., half:]], dim=-1)
    noise = torch.tensor([1.0 / light, (3.0 / light) ** 2])
    normal = torch.randn(image.shape, generator=torch.Generator().manual_seed(seed))
    return (image + (noise[0] * image + noise[1]).sqrt() * normal)[None], noise


def test_each_half_has_its_own_depth():
    raw, noise = two_depths(natural(), 1000.0)
    found = depth_probabilities(raw, DEPTHS, noise)[0]
    assert torch.allclose(found.sum(dim=0), torch.ones(160, 160), atol=1e-5)
    # The neighbourhoods that decide reach some 16 pixels across the border.
    assert float(found[0, :, :64].mean()) > 0.95
    assert float(found[1, :, 96:].mean()) > 0.95


def test_a_picture_of_depths_has_vergence_as_its_grey():
    certain = torch.eye(3)[:, :, None, None]  # three images of one pixel, each at one depth
    grey = depth_picture(certain, [8000.0, 6000.0, 4000.0])[:, :, 0, 0]
    nearness = torch.tensor([0.0, (1 / 6 - 1 / 8) / (1 / 4 - 1 / 8), 1.0])
    assert torch.allclose(grey, nearness[:, None].expand(3, 3), atol=1e-6)


def test_less_light_is_less_certain():
    ahead = [
        float(picture_weights(depth_probabilities(*_seen(light)))[:, :2].sum(dim=1).mean())
        for light in (1000.0, 30.0, 3.0)
    ]
    assert ahead[0] > ahead[1] > ahead[2]
    assert ahead[2] < 0.5


def _seen(light):
    raw, noise = two_depths(natural(), light)
    return raw, DEPTHS, noise


def test_depths_that_look_alike_are_left_undecided():
    raw, noise = two_depths(natural(), 1000.0)
    found = depth_probabilities(raw, NEAR.expand(3, 3, 13, 13), noise)
    assert torch.allclose(found, torch.full_like(found, 1.0 / 3.0))
    shares = picture_weights(found)
    assert torch.allclose(shares[:, -1], torch.ones(1, 160, 160), atol=1e-5)


@pytest.mark.parametrize("light", [100.0, 1000.0])
def test_a_scene_of_two_depths_is_restored_better_by_choosing(light):
    truth = natural(seed=4)
    raw, noise = two_depths(truth, light)
    score = {}
    for chosen in (False, True):
        network = GeneralRestoration(by_depth=chosen).eval()
        with torch.no_grad():
            restored = network(raw, DEPTHS, None, noise).clamp(0.0, 1.0)
        score[chosen] = float(psnr_db(restored, linear_to_srgb(truth)[None]))
    assert score[True] > score[False] + 0.1
