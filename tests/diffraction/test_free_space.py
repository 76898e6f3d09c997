"""Light through free space: closed forms, and the Rayleigh-Sommerfeld integral by brute force."""

import math

import numpy as np
import pytest
import torch

from dolens.diffraction.field_pupil import fast_length
from dolens.diffraction.free_space import (
    Layer,
    PlaneField,
    by_fourier,
    by_spectrum,
    by_summation,
    fourier_error,
    turns_to_centre,
)
from dolens.diffraction.wavefront import covered

WAVE = 550e-6


def grid(count, width):
    return ((torch.arange(count, dtype=torch.float64) + 0.5) / count - 0.5) * width


def aperture(count, width, radius):
    """A lit disc, with the cells that its edge cuts lit in part."""
    x = grid(count, width)
    margin = radius**2 - x[None].square() - x[:, None].square()
    return PlaneField(covered(margin[None])[0].to(torch.complex128), x, x, 1e6 * WAVE)


def layer(thickness, index=1.0):
    return Layer(torch.tensor(thickness, dtype=torch.float64), index)


def lens(count, width, focal, slope=0.0, wavelength=1e6 * WAVE):
    """A round lens that focuses light along an angle's sine, less that tilt."""
    found = aperture(count, width, 0.5 * width)
    square = found.x[None].square() + found.y[:, None].square()
    turns = -square / ((square + focal**2).sqrt() + focal) / (1e-6 * wavelength)
    values = torch.polar(found.values.real, 2 * math.pi * turns)
    return PlaneField(values, found.x, found.y, wavelength, (slope, 0.0))


def brute_force(field, distance, points):
    """The first Rayleigh-Sommerfeld integral, in NumPy's double precision."""
    x, y, values = field.x.numpy(), field.y.numpy(), field.values.numpy()
    wave = 1e-6 * field.wavelength
    tilt = np.exp(2j * np.pi / wave * (field.carrier[0] * x[None] + field.carrier[1] * y[:, None]))
    found = []
    for px, py in points:
        r = np.sqrt((px - x[None]) ** 2 + (py - y[:, None]) ** 2 + distance**2)
        kernel = distance / r * (1 / r - 2j * np.pi / wave) * np.exp(2j * np.pi * r / wave) / r
        found.append((values * tilt * kernel).sum() * field.pitch**2 / (2 * np.pi))
    return np.array(found)


@pytest.mark.parametrize("number", [1.0, 2.0, 3.0, 5.5, 8.0])
def test_irradiance_on_the_axis_behind_a_disc_has_a_closed_form_at_every_fresnel_number(number):
    radius = 0.25
    z = radius**2 / (WAVE * number)
    spot = by_spectrum(
        aperture(400, 0.52, radius), [layer(z)], (0.0, 0.0), torch.zeros(1).double(), grid(3, 0.01)
    )
    rho = math.hypot(z, radius)
    # Osterberg and Smith, J. Opt. Soc. Am. 51, 1050 (1961).
    exact = abs(1.0 - z / rho * np.exp(2j * np.pi * (rho - z) / WAVE)) ** 2
    assert float(spot[1, 0].abs().square()) == pytest.approx(exact, abs=0.01 * 4.0)


def test_a_grating_is_its_own_image_at_the_talbot_distance_and_shifted_halfway():
    period = 0.02
    x = grid(1500, 1.5)
    bars = 0.5 * (1.0 + (2 * math.pi * x / period).cos())
    bars = bars.expand(64, -1).to(torch.complex128)
    field = PlaneField(bars, x, grid(64, 0.064), 1e6 * WAVE)
    # The square of the period over the wavelength, twice, beyond the paraxial.
    distance = WAVE / (1.0 - math.sqrt(1.0 - (WAVE / period) ** 2))
    u = grid(81, 3 * period)
    # Along y the field is narrow: the profile along x is what repeats.
    for z, shift in ((distance, 0.0), (0.5 * distance, 0.5 * period)):
        found = by_spectrum(field, [layer(z)], (0.0, 0.0), u, torch.zeros(1).double())[0]
        image = found.abs() / found.abs().max()
        wanted = (0.5 * (1.0 + (2 * math.pi * (u - shift) / period).cos())).abs()
        assert float((image - wanted).abs().max()) < 0.02


@pytest.mark.parametrize(
    ("width", "focal", "angle", "defocus"),
    [(0.5, 4.0, 0.0, 0.0), (0.5, 4.0, 0.15, 0.03), (0.5, 1.0, 0.0, 0.01), (0.4, 0.8, 0.1, 0.0)],
)
def test_spectra_are_the_integral_within_a_hundredth_of_the_peak(width, focal, angle, defocus):
    field = lens(512, width, focal, math.sin(angle))
    z = focal + defocus
    centre = (z * math.tan(angle), 0.0)
    u = grid(9, 0.02)
    found = by_spectrum(field, [layer(z)], centre, u, u).abs().square()
    points = [(centre[0] + float(a), float(b)) for b in u[::2] for a in u[::2]]
    exact = np.abs(brute_force(field, z, points)) ** 2
    peak = max(float(found.max()), exact.max())
    assert np.abs(found[::2, ::2].flatten().numpy() - exact).max() < 0.01 * peak
    x, y = (torch.tensor(p, dtype=torch.float64) for p in zip(*points, strict=True))
    summed = by_summation(field, layer(z), x, y).abs().square()
    np.testing.assert_allclose(summed.numpy(), exact, atol=1e-9 * peak)


@pytest.mark.parametrize(("focal", "angle"), [(8.0, 0.0), (8.0, 0.1), (2.0, 0.1)])
def test_one_fourier_transform_errs_by_no_more_than_it_says(focal, angle):
    u = grid(9, 0.02)
    field = lens(256, 0.5, focal, math.sin(angle))
    centre = (focal * math.tan(angle), 0.0)
    error = fourier_error(field.x, field.y, layer(focal), centre, 0.01, field.wavelength)
    turns = turns_to_centre(field.x[None], field.y[:, None], layer(focal), centre, field.wavelength)
    turns = turns + field.x[None] * (field.carrier[0] / WAVE)
    left = field.values * torch.polar(torch.ones_like(turns), 2.0 * math.pi * turns)
    left = PlaneField(left, field.x, field.y, field.wavelength)
    found = by_fourier(left, layer(focal), centre, u, u).abs().square()
    points = [(centre[0] + float(a), float(b)) for b in u[::2] for a in u[::2]]
    exact = np.abs(brute_force(field, focal, points)) ** 2
    worst = np.abs(found[::2, ::2].flatten().numpy() - exact).max() / exact.max()
    # A phase error of w waves changes an amplitude of one by 2·sin(πw) at most.
    assert worst < 2.0 * math.pi * error + 2e-3


def test_light_in_a_plate_is_light_of_a_shorter_wavelength():
    field = lens(256, 0.3, 3.0)
    u = grid(7, 0.02)
    plate = by_spectrum(field, [layer(3.0, 1.5)], (0.0, 0.0), u, u)
    slow = PlaneField(field.values, field.x, field.y, field.wavelength / 1.5)
    air = by_spectrum(slow, [layer(3.0)], (0.0, 0.0), u, u)
    assert torch.allclose(plate.abs(), air.abs(), rtol=1e-6, atol=1e-9 * float(air.abs().max()))
    halves = by_spectrum(field, [layer(1.0, 1.5), layer(2.0, 1.5)], (0.0, 0.0), u, u)
    assert torch.allclose(plate.abs(), halves.abs(), rtol=1e-6)


def test_derivatives_by_the_distance_are_those_of_differences():
    field, u = lens(200, 0.2, 2.0), grid(5, 0.01)

    def spot(z):
        return by_spectrum(field, [Layer(z, 1.0)], (0.0, 0.0), u, u).abs().square().sum()

    z = torch.tensor(2.05, dtype=torch.float64, requires_grad=True)
    (slope,) = torch.autograd.grad(spot(z), z)
    with torch.no_grad():
        difference = (spot(z + 0.01) - spot(z - 0.01)) / 0.02
    assert float(slope) == pytest.approx(float(difference), rel=5e-3)


def test_lengths_of_transforms_are_products_of_small_primes():
    assert [fast_length(n, (2, 3, 5), even=True) for n in (7, 1025, 1153)] == [8, 1080, 1200]
