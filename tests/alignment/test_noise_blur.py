"""Noise of the light within reach, and derivatives without what wide patches spill."""

import copy
import math
from dataclasses import replace

import pytest
import torch

from dolens.alignment.image_losses import (
    NoiseWeightedLoss,
    blurred_deviation,
    deviation,
    spill_left,
)
from dolens.alignment.information import fisher_information
from dolens.alignment.measurement import Light, Measurement, simulated
from dolens.alignment.pose import Pose
from dolens.rendering.spot_image import SpotImager
from dolens.sensor.pixels import Sensor

SENSOR = Sensor(64, 64, 0.11)
SOURCE = [[0.0, 0.0, -864.0]]
PHOTONS = 3_000_000
PLANES = (0.0, -8.0, -16.0)  # the last is near focus
TRUTH = {
    "sensor_distance": 119.45,
    "elements.lens.decenter_x": 0.1,
    "elements.lens.decenter_y": -0.2,
    "elements.lens.tilt_x": -9.0,
    "elements.lens.tilt_y": 1.5,
}


def pose(lens, values):
    settings = {name: {"initial": values.get(name, 0.0)} for name in TRUTH}
    return Pose(copy.deepcopy(lens), SOURCE, settings, PLANES)


def seen(lens):
    true = pose(lens, TRUTH)
    true.store()
    generator = torch.Generator().manual_seed(3)
    return simulated(true.lens, true.sources, 622.5, SENSOR, Light(PHOTONS), generator, true.planes)


def test_derivatives_leave_out_what_wide_patches_spill_onto_dark_pixels(singlet):
    """Where an iteration begins residuals are those of narrow patches; a pixel that has none of
    their light has no derivative, though wide patches bring it some.
    """
    measured, one = seen(singlet), pose(singlet, TRUTH)
    narrow = SpotImager(SENSOR, 622.5, 20_000, subpixels=20)
    wide = replace(narrow, subpixels=2)
    alone = NoiseWeightedLoss(measured, narrow).weighted_at(one)
    loss = NoiseWeightedLoss(measured, narrow, wide).weighted_at(one)
    chosen = torch.ones(len(one.names), dtype=torch.bool)
    residuals, jacobian = loss.jacobian(one, chosen)
    assert torch.allclose(residuals, alone.residuals(one).detach(), rtol=0.0, atol=1e-9)
    with torch.no_grad():
        shares, spilt = (
            torch.stack([found.image for found in one.images(by)]) for by in (narrow, wide)
        )
    dark = ((shares == 0.0) & (spilt > 0.0)).flatten()
    assert int(dark.sum()) > 20
    # Each image's own exposure moves every pixel by its residual, which is its noise alone.
    told = jacobian[dark].square().sum(0) / jacobian.square().sum(0)
    assert float(told.max()) < 1e-6
    bounds, rough = (
        fisher_information(one, narrow, measured, by).bounds for by in (wide, replace(wide, seed=1))
    )
    assert torch.allclose(bounds, rough, rtol=0.1)


def test_a_share_of_the_spill_counts_that_narrow_patches_confirm():
    narrow = torch.tensor([0.0, 0.0, 0.1, 0.5, 1.0, 2.0], dtype=torch.float64)
    wide = torch.tensor([0.0, 0.4, 0.4, 1.0, 1.0, 1.0], dtype=torch.float64)
    assert spill_left(narrow, wide).tolist() == [1.0, 0.0, 0.5, 1.0, 1.0, 1.0]


def light(electrons, width=33):
    """A square of light in the middle of a dark image, and its shares."""
    image = torch.zeros(1, width, width, dtype=torch.float64)
    image[0, 8:25, 8:25] = electrons
    return image, image / image.sum()


def test_noise_is_that_of_the_light_within_reach():
    """In the middle of even light as the model has it; outside, where the model is dark, that of
    what a Gaussian brings: half the light at an edge, none eight deviations from it.
    """
    image, shares = light(900.0)
    mask = torch.ones_like(image, dtype=torch.bool)
    measured = Measurement(image, mask, 2.0, Sensor(33, 33, 0.05))
    plain = deviation(shares, measured)[1]
    assert torch.equal(blurred_deviation(shares, measured, 0.0), plain)
    sigma = blurred_deviation(shares, measured, 1.0)
    assert float(sigma[0, 16, 16]) == pytest.approx(math.sqrt(904.0), rel=1e-5)
    assert float(sigma[0, 16, 0]) == pytest.approx(2.0, rel=1e-6)
    # Pixels on both sides of the edge add up to all light: 900 + 2·4.
    both = sigma[0, 16, 7].square() + sigma[0, 16, 8].square()
    assert float(both) == pytest.approx(908.0, rel=1e-5)
    assert float(plain[0, 16, 7]) == pytest.approx(2.0, rel=1e-6)


def test_noise_of_pixels_that_are_not_trusted_is_what_is_expected():
    image, shares = light(900.0)
    mask = torch.ones_like(image, dtype=torch.bool)
    mask[0, 16, 16] = False
    saturated = image.clone()
    saturated[0, 16, 16] = 1e6
    measured = Measurement(saturated, mask, 2.0, Sensor(33, 33, 0.05))
    sigma = blurred_deviation(shares, measured, 1.0)
    assert float(sigma[0, 15, 15]) == pytest.approx(math.sqrt(904.0), rel=1e-2)
