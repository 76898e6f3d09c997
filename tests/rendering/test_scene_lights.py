"""Lights are found in pictures that hold radiance over white."""

import logging

import pytest
import torch

from dolens import InputError, load_lens
from dolens.rendering.scene_lights import lights_in
from dolens.sensor.pixels import Sensor

SENSOR = Sensor(60, 80, 0.1)


def dark():
    return torch.full((3, 60, 80), 0.1)


def test_a_light_has_centroid_and_power_of_what_is_over_white():
    picture = dark()
    picture[:, 20, 30] = torch.tensor([101.0, 201.0, 301.0])
    picture[:, 20, 31] = torch.tensor([101.0, 201.0, 301.0])
    picture[:, 21, 30] = torch.tensor([51.0, 101.0, 151.0])
    rest, (found,) = lights_in(picture, SENSOR, 1.0)
    assert (found.row, found.column) == pytest.approx((20.2, 30.4))
    assert found.power == pytest.approx((250.0, 500.0, 750.0))
    assert float(rest.max()) == 1.0
    # White, and a light about its centroid: the picture again.
    assert float(found.shape.sum()) == pytest.approx(1.0)
    middle = len(found.shape) // 2
    at = torch.arange(len(found.shape)) - middle
    assert float((found.shape.sum(1) * at).sum()) == pytest.approx(0.0, abs=1e-12)


def test_pixels_of_the_sensor_are_those_of_the_pinhole():
    picture = dark()
    picture[:, 0, 0] = 1001.0
    _, (found,) = lights_in(picture, Sensor(120, 160, 0.05), 1.1)
    # 29.5 and 39.5 from the middle, twice as many pixels, and 1.1 as far.
    assert (found.row, found.column) == pytest.approx((59.5 - 64.9, 79.5 - 86.9))
    assert found.power[1] == pytest.approx(1000.0 * 2.2**2)
    assert found.shape is None


def test_all_radiance_is_in_the_picture_or_in_its_lights():
    generator = torch.Generator().manual_seed(2)
    picture = 3.0 * torch.rand(3, 60, 80, generator=generator).double()
    picture[:, 10:50, 10:30] = 20.0
    picture[:, 5:7, 60] = 400.0
    rest, found = lights_in(picture, SENSOR, 1.0)
    power = torch.tensor([light.power for light in found]).sum(0)
    assert torch.allclose(rest.sum((1, 2)) + power, picture.sum((1, 2)))
    # What is large is cut: forty pixels by twenty in parts of four, the brightest of them kept.
    assert len(found) == 12
    assert found[0].power[0] == pytest.approx(798.0)


def test_what_is_no_light_stays(caplog):
    caplog.set_level(logging.INFO)
    picture = dark()
    picture[:, 30, 40], picture[:, 10, 10] = 90.0, 3.0
    rest, found = lights_in(picture, SENSOR, 1.0)
    assert found == [] and torch.equal(rest, picture)
    assert "lights: 0 found" in caplog.text and "1e+02 % has no ghosts" in caplog.text
    with pytest.raises(InputError, match="below 0 or without end"):
        lights_in(-picture, SENSOR, 1.0)


def test_a_photograph_finds_the_lights_that_a_list_names():
    lens = load_lens("cooke_triplet").coated("none")
    radiance = torch.full((3, 32, 48), 0.01, dtype=torch.float64)
    radiance[:, 10, 30] = 2e4
    options = {"distance": 1e6, "light": None, "sensor": (14.4, 9.6)}
    found = lens.photograph(radiance, lights="from picture", **options).signal
    white = radiance.clamp(max=1.0)
    encoded = torch.where(white <= 0.0031308, 12.92 * white, 1.055 * white ** (1 / 2.4) - 0.055)
    listed = lens.photograph(encoded, lights=[(10, 30, 2e4 - 1.0)], **options).signal
    assert torch.allclose(found, listed, rtol=1e-4, atol=1e-5)
    with pytest.raises(InputError, match="lights: 'all'; allowed: a list, or 'from picture'"):
        lens.photograph(radiance, lights="all", **options)
