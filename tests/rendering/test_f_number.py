"""Stopping down at equal exposure time: what light is lost, and what noise that leaves."""

import math

import pytest
import torch
import yaml

import dolens
from dolens.errors import InputError
from dolens.prescriptions import lens_from_prescription
from dolens.rendering.exit_pupil import axial_f_number
from dolens.sensor.readout import Readout

# Where a colour is uniform, the standard error of a standard deviation is 1/√(2n) of it.
MANY = 200_000


@pytest.fixture
def stopped(root):
    """The phase-plate camera's lens with another semi-diameter of its stop."""

    def build(semi_diameter):
        prescription = yaml.safe_load((root / "conf/lens/wavefront_coding.yaml").read_text())
        prescription["surfaces"]["1"]["semi_diameter"] = semi_diameter
        return lens_from_prescription(prescription, torch.float64, where="lens")

    return build


def spread(readout, level):
    image = torch.full((1, 1, MANY), level, dtype=torch.float64)
    read = readout.develop(readout(image, torch.Generator().manual_seed(0)))
    return float(read.mean()), float(read.std())


def test_the_f_number_is_that_of_the_axial_marginal_ray(stopped):
    # A ray parallel to the axis just inside the stop's edge, traced: 1/(2·sin u') at the sensor.
    lens, height = stopped(3.0), 3.0 * (1.0 - 1e-6)
    position = torch.tensor([0.0, height, -10.0], dtype=torch.float64)
    direction = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    hit = lens.trace(dolens.Rays(position, direction, 587.5618))
    assert bool(hit.valid)
    sine = -float(hit.direction[1].detach())
    # The cone to the sensor's middle differs from the one that is focused at infinity by the
    # sensor's distance from that focus, 1 mm of 93.
    assert axial_f_number(lens) == pytest.approx(0.5 / sine, rel=0.02)


def test_half_the_aperture_is_twice_the_f_number(stopped):
    # sin u' = ρ/√(ρ² + L²), so N² = (1 + (L/ρ)²)/4 for the pupil's radius ρ at the distance L.
    wide, half = (axial_f_number(stopped(s)) for s in (6.0, 3.0))
    assert 4.0 * half**2 - 1.0 == pytest.approx(
        4.0 * (4.0 * wide**2 - 1.0), rel=5e-3
    )  # less the spherical aberration of the pupil


def test_noise_at_equal_exposure_time_is_that_of_the_electrons_that_are_left():
    light, well, read, level = 400.0, 8000.0, 5.0, 0.5
    for stops in (0, 1, 2, 4):
        sensor = Readout.at_light(light, well, read_noise=read / well, reference_f_number=8.0)
        mean, deviation = spread(sensor.at_f_number(8.0 * math.sqrt(2.0) ** stops), level)
        white = light / 2.0**stops
        # Shot noise of white·level electrons and the sensor's own, over the electrons of white.
        expected = math.sqrt(white * level + read**2) / white
        assert mean == pytest.approx(level, abs=4.0 * expected / math.sqrt(MANY))
        assert deviation == pytest.approx(expected, rel=4.0 / math.sqrt(2.0 * MANY))


def test_read_noise_alone_doubles_with_every_stop():
    sensor = Readout(read_noise=0.003, reference_f_number=8.0)
    _, wide = spread(sensor.at_f_number(8.0), 0.5)
    _, stop = spread(sensor.at_f_number(8.0 * math.sqrt(2.0)), 0.5)
    assert stop == pytest.approx(2.0 * wide, rel=1e-9)  # the same random numbers
    _, without = spread(Readout(read_noise=0.003).at_f_number(16.0), 0.5)
    assert without == pytest.approx(wide, rel=1e-9)


def test_a_white_pixel_beyond_the_full_well_is_refused():
    with pytest.raises(InputError, match=r"light is 9000\.0; allowed: at most the full well, 8000"):
        Readout.at_light(9000.0, 8000.0)
    with pytest.raises(InputError, match=r"f_number is 0\.0"):
        Readout().at_f_number(0.0)
