"""Images of point sources by rays traced forward: light, smoothness, derivatives."""

import math

import pytest
import torch
from torch.func import jvp

from dolens.errors import InputError
from dolens.rendering.psf import bin_rays
from dolens.rendering.spot_image import SpotImager
from dolens.sensor.pixels import Sensor

SENSOR = Sensor(48, 40, 0.1)
NAMES = ("tilt_x", "tilt_y", "decenter_x", "decenter_y", "shift_z")


def posed(lens, values):
    """The lens's system with tilts (rad), decentres and shift (mm), and the source's place (mm)."""
    named = {f"elements.lens.{n}": v for n, v in zip(NAMES, values[:5], strict=True)}
    return lens.system(named), values[5:]


POINT = torch.tensor([0.1, -0.05, 0.2, -0.3, 0.5, 1.0, 2.0, -860.0], dtype=torch.float64)


def test_pixels_get_all_the_light_and_keep_its_centroid():
    """A B-spline's values sum to one and their first moment is the ray's own place.

    A patch narrower than a pixel says less of where in the pixel it lies.
    """
    generator = torch.Generator().manual_seed(0)
    rows, columns = 3.0 + 20.0 * torch.rand(2, 500, generator=generator, dtype=torch.float64)
    weight = torch.rand(500, generator=generator, dtype=torch.float64)
    for subpixels in (1, 3):
        image = bin_rays(rows, columns, weight, 30, 26, subpixels)
        assert float(image.sum()) == pytest.approx(float(weight.sum()), rel=1e-12)
        down = (image.sum(1) * torch.arange(30)).sum() / image.sum()
        wanted = float((weight * rows).sum() / weight.sum())
        assert float(down) == pytest.approx(wanted, abs=1e-11 if subpixels == 1 else 5e-3)


def test_the_patch_widens_by_what_is_said():
    """The variance of one ray's pixels: a pixel's own 1/12, and the tent's 1/(6·s²)."""
    place = torch.linspace(9.5, 10.5, 401, dtype=torch.float64)[:-1, None]
    one = torch.ones_like(place)
    for subpixels in (1, 2, 4):
        image = bin_rays(place, one * 10.0, one, 21, 21, subpixels).sum(-1)
        far = torch.arange(21) - place
        variance = float((image * far.square()).sum(-1).mean())
        assert variance == pytest.approx(1.0 / 12.0 + 1.0 / (6.0 * subpixels**2), rel=1e-3)


@pytest.mark.parametrize("subpixels", [1, 2, 3, 16])
def test_a_pixel_integrates_the_tent_over_its_square(subpixels):
    """Against sums of the tent, 1 - |t|·s of half-width 1/s, on a fine grid."""
    width = 1.0 / subpixels
    t = (torch.arange(20000, dtype=torch.float64) + 0.5) / 10000 - 1.0
    weight = (1.0 - t.abs()) / 10000
    for place in (3.0, 3.2, 3.47, 3.5, 2.61):
        at = torch.tensor([place], dtype=torch.float64)
        found = bin_rays(at, at.new_zeros(1), torch.ones_like(at), 7, 1, subpixels)[:, 0]
        pixel = (place + width * t).round().long()
        wanted = torch.zeros(7, dtype=torch.float64).index_add(0, pixel, weight)
        # Half of the patch is in one row of pixels for each of the columns that it covers.
        assert torch.allclose(found / found.sum(), wanted, atol=2e-4)


def test_light_behind_an_untilted_lens_is_its_solid_angle(singlet):
    """Of a rim of radius a at the sag s, seen from z: 2π(1 - cos), to the rim's soft edge."""
    rim, sag = 12.7, 51.5 - math.sqrt(51.5**2 - 12.7**2)
    source = torch.tensor([0.0, 0.0, -300.0], dtype=torch.float64)
    wanted = 2.0 * math.pi * (1.0 - 1.0 / math.sqrt(1.0 + (rim / (300.0 + sag)) ** 2))
    found = SpotImager(SENSOR, 622.5, 200_000, rim=0.002).image(singlet.system(), source)
    assert float(found.flux) == pytest.approx(wanted, rel=3e-4)


def test_the_image_is_where_the_chief_ray_lands(singlet):
    """A source on the axis has a centred image, and every seed the same one to its sampling."""
    source = torch.tensor([0.0, 0.0, -864.0], dtype=torch.float64)
    images = [
        SpotImager(SENSOR, 622.5, 100_000, seed=seed).image(singlet.system(), source)
        for seed in (0, 1)
    ]
    assert float(images[0].centroid.norm()) < 1e-4
    assert float(images[0].image.sum()) == pytest.approx(1.0, rel=1e-12)
    assert float((images[0].image - images[1].image).abs().max() / images[0].image.max()) < 0.02


@pytest.mark.parametrize("number", range(8))
def test_derivatives_are_those_of_differences_with_the_same_rays(singlet, number):
    """By forward mode, of every pixel and of the light, for tilts, shifts and the source."""
    imager = SpotImager(SENSOR, 622.5, 20_000, rays_at_a_time=7_000)

    def whole(values):
        system, source = posed(singlet, values)
        found = imager.image(system, source)
        return torch.cat([found.image.flatten(), found.centroid, 1e3 * found.flux[None]])

    direction = torch.zeros_like(POINT)
    direction[number] = 1.0
    _, derivative = jvp(whole, (POINT,), (direction,))
    # The spline's derivative has kinks: differences of two sizes, extrapolated, still miss 1e-4.
    h = 1e-6 * max(1.0, abs(float(POINT[number])))
    difference = (whole(POINT + h * direction) - whole(POINT - h * direction)) / (2.0 * h)
    scale = float(difference.abs().max())
    assert scale > 0.0
    assert float((derivative - difference).abs().max()) < 1e-4 * scale


def test_gradients_do_not_depend_on_how_many_rays_are_traced_at_a_time(singlet):
    gradients = []
    for at_a_time in (20_000, 3_000):
        values = POINT.clone().requires_grad_()
        system, source = posed(singlet, values)
        found = SpotImager(SENSOR, 622.5, 20_000, rays_at_a_time=at_a_time).image(system, source)
        found.image.square().sum().backward()
        gradients.append(values.grad)
    assert torch.allclose(*gradients, rtol=1e-9)


def test_light_beyond_the_disc_of_rays_is_an_error(singlet):
    """At 60° light would pass the rim far out in the vertex plane."""
    values = torch.zeros(8, dtype=torch.float64)
    values[0], values[7] = math.radians(60.0), -864.0
    system, source = posed(singlet, values)
    with pytest.raises(InputError, match=r"imager\.reach: light passes the lens beyond 1\.05"):
        SpotImager(SENSOR, 622.5, 5_000, reach=1.05).image(system, source)


@pytest.mark.parametrize(
    ("settings", "message"),
    [({"rays": 0}, "imager.rays"), ({"rim": 0.0}, "imager.rim"), ({"reach": 1.0}, "imager.reach")],
)
def test_settings_out_of_range_are_errors(settings, message):
    with pytest.raises(InputError, match=message):
        SpotImager(SENSOR, 622.5, **settings)
