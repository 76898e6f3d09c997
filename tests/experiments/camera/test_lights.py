"""Bright lights in the pictures of a camera: where they are, what they add, and its derivatives."""

import math

import pytest
import torch

from dolens import InputError, load_lens
from dolens.experiments.camera.views.base import Shot
from dolens.experiments.camera.views.depths import DepthViews
from dolens.experiments.camera.views.lights import RandomLights
from dolens.rendering.psf_renderer import PsfRenderer
from dolens.scene.planar import PlanarScene
from dolens.sensor.noise import BatchShare, generator_of
from dolens.sensor.pixels import Sensor
from dolens.sensor.readout import Readout

SENSOR = Sensor(24, 32, 0.4)
SCENE = PlanarScene((1e6,), (550.0, 550.0, 550.0))


def views(lights):
    renderer = PsfRenderer(SENSOR, (1, 1), 8, 5, jitter=False)
    return DepthViews(SCENE, renderer, Readout(), psf_size=5, lights=lights, seed=3)


@pytest.fixture(scope="module")
def lens():
    return load_lens("cooke_triplet").coated("quarter_wave").requires_grad_(False)


def test_lights_are_even_over_the_sensor_and_around_it():
    lights = RandomLights(100, (10.0, 1000.0), beyond=0.25)
    drawn = lights.drawn(SENSOR, generator_of(0))
    rows, columns = ([getattr(light, key) for light in drawn] for key in ("row", "column"))
    # A quarter of 24 and of 32 pixels beyond the edges at -0.5 and 23.5, and 31.5.
    assert -6.5 <= min(rows) < -4.0 and 27.0 < max(rows) <= 29.5
    assert -8.5 <= min(columns) < -6.0 and 37.0 < max(columns) <= 39.5
    logarithms = [math.log10(light.power[0]) for light in drawn]
    assert min(logarithms) >= 1.0 and max(logarithms) <= 3.0
    assert sum(logarithms) / 100 == pytest.approx(2.0, abs=0.2)


def test_a_picture_has_its_lights_ghosts_and_veil_and_its_truth_a_white_pixel(lens):
    dark = torch.full((2, 3, 34, 42), 0.2, dtype=lens.dtype)
    found = []
    for lights in (None, RandomLights(3, (3e3, 1e4), beyond=0.0, rays=100)):
        camera = views(lights)
        camera.check(lens)
        camera.expose(lens)
        found.append(camera.take(lens, Shot(dark, "train", 5)))
    plain, lit = found
    assert bool((lit.raw > plain.raw).all())
    white = (lit.truth == 1.0) & (plain.truth < 1.0)
    assert white[:, 0, 0].sum((-2, -1)).tolist() == [3, 3]
    assert torch.equal(lit.truth[~white], plain.truth[~white])
    # The brightest pixels are the lights' own, within one for distortion.
    near = torch.nn.functional.max_pool2d(white[:, 0].double(), 3, 1, 1).bool()
    assert bool((lit.raw[:, 0].amax((-2, -1))[..., None, None] > 100.0).all())
    assert bool(near[lit.raw[:, 0] > 1000.0].all())


def test_pictures_of_a_part_of_a_batch_have_the_lights_of_the_whole(lens):
    image = torch.zeros(3, 1, 3, 24, 32, dtype=lens.dtype)
    lights = RandomLights(1, (1e3, 1e4), rays=50, veiled=False)
    lights.begin(lens, SCENE, SENSOR)
    whole, _ = lights.added_to(lens, image, image, 7)
    part, _ = lights.added_to(lens, image[1:], image[1:], 7, BatchShare(1, 3))
    assert torch.equal(part, whole[1:])


@pytest.mark.parametrize(
    ("name", "step"),
    [
        ("surfaces.2.coating.thickness_1", 0.01),
        ("surfaces.3.curvature", 1e-7),
        ("thicknesses.2", 1e-5),
        ("sensor_distance", 1e-5),
    ],
)
def test_the_derivative_of_a_picture_with_lights_is_that_of_differences(lens, name, step):
    """Between the same random numbers; the focal length and the F-number move with the lens."""
    lights = RandomLights(2, (1e4, 1e4), rays=60)
    lights.begin(lens, SCENE, SENSOR)
    image = torch.full((1, 1, 3, 24, 32), 0.2, dtype=torch.float64)
    weight = torch.rand(24, 32, generator=generator_of(1), dtype=torch.float64)

    def total(value):
        found, _ = lights.added_to(lens.with_values({name: value}), image, image, 7)
        # Of ghosts and veil; a light's own pixel is far brighter.
        return (weight * found.clamp(max=50.0)).sum()

    at = dict(lens.named_parameters())[name].detach()
    value = at.clone().requires_grad_()
    slope = float(torch.autograd.grad(total(value), value)[0])
    around = [float(total(at + s)) for s in (step, -step)]
    assert slope == pytest.approx((around[0] - around[1]) / (2.0 * step), rel=2e-3)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"count": 0}, "views.lights.count: 0; allowed: 1 to 100"),
        ({"power": (10.0, 1.0)}, "views.lights.power: .*allowed: 0 < least <= largest"),
        ({"power": ("1e3", "1e4")}, "views.lights.power: .*allowed: 0 < least <= largest"),
        ({"beyond": -1.0}, "views.lights.beyond: -1.0; allowed: 0 or more"),
        ({"sensor_reflectance": 2.0}, "sensor_reflectance: 2.0; allowed: 0 to 1"),
    ],
)
def test_what_is_out_of_range_is_refused(given, message):
    with pytest.raises(InputError, match=message):
        RandomLights(**given)
