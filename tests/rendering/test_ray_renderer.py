"""Backward rendering: radiometry, orientation, registration, and its twin by convolution."""

import math

import pytest
import torch
from torch.nn import functional

from dolens.errors import InputError
from dolens.optics.rays import Rays
from dolens.rendering.psf import axial_point_spread_functions
from dolens.rendering.ray_renderer import RayRenderer
from dolens.scene.planar import PlanarScene, pinhole_image
from dolens.sensor.pixels import Sensor

DEPTHS, LINES = (8000.0, 6000.0, 4500.0), (656.2725, 587.5618, 486.1327)


def smooth_texture(size: int, seed: int = 0) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    noise = torch.rand(1, 3, size, size, generator=generator, dtype=torch.float64)
    return functional.interpolate(noise[..., ::3, ::3], size=(size, size), mode="bicubic")


def test_a_white_plane_is_white_where_nothing_is_vignetted(wavefront_coding):
    renderer = RayRenderer(Sensor(32, 32, 0.0069), 7)
    white = torch.ones(1, 3, 4, 4, dtype=torch.float64)
    image = renderer.render(wavefront_coding(1.3e-5), PlanarScene(DEPTHS, LINES), white, seed=0)
    assert float(image.mean()) == pytest.approx(1.0, abs=2e-4)
    assert float(image[..., 12:20, 12:20].mean()) == pytest.approx(1.0, abs=5e-5)
    assert float(image.max()) < 1.0 + 1e-3


def test_a_vignetting_lens_darkens_as_much_as_it_stops(triplet):
    # Independent of the renderer's pupil: rays forward from a point of the object fill a wide
    # grid in front of the lens; relative illumination is the ratio of the étendues that pass,
    # ∫cos⁴ over the entrance beam, off axis and on (same patch of object plane).
    sensor = Sensor(1, 1, 0.02)
    depth = 2000.0
    scene = PlanarScene([depth], [587.5618])
    grid = torch.linspace(-9.5, 9.5, 401, dtype=torch.float64)
    gx, gy = torch.meshgrid(grid, grid, indexing="ij")

    def passes(height: float) -> float:
        origin = torch.tensor([0.0, height, -depth], dtype=torch.float64)
        target = torch.stack((gx, gy, torch.zeros_like(gx)), -1)
        direction = target - origin
        direction = direction / direction.norm(dim=-1, keepdim=True)
        hit = triplet.trace(Rays(origin, direction, 587.5618))
        return float((direction[..., 2] ** 4 * hit.valid).sum())

    magnification = scene.magnifications(triplet.system())[0]
    white = torch.ones(1, 1, 2, 2, dtype=torch.float64)
    for image_height in (4.0, 8.0):
        # A tall sensor of one column whose top and bottom pixels lie at the image height.
        rows = 2 * round(image_height / sensor.pixel_pitch) + 1
        tall = Sensor(rows, 1, sensor.pixel_pitch)
        image = RayRenderer(tall, 24, chunk_rays=200_000).render(triplet, scene, white, seed=1)
        corner = 0.5 * float(image[..., :5, :].mean() + image[..., -5:, :].mean())
        expected = passes(image_height / magnification) / passes(0.0)
        # The disc is the axial beam's: pupil aberration off axis is what the tolerance is for.
        assert corner == pytest.approx(expected, rel=0.06)


def test_images_are_upright(wavefront_coding):
    texture = torch.zeros(1, 3, 64, 64, dtype=torch.float64)
    texture[..., :32, 32:] = 1.0  # top right, as the scene is seen
    image = RayRenderer(Sensor(32, 32, 0.0069), 4).render(
        wavefront_coding(), PlanarScene([6000.0], LINES), texture, seed=0
    )[0, 0, 1]
    assert float(image[:8, -8:].mean()) > 0.99
    for other in (image[:8, :8], image[-8:, :8], image[-8:, -8:]):
        assert float(other.mean()) < 0.01


def test_a_point_right_and_above_the_axis_lands_left_and_below_on_the_sensor(wavefront_coding):
    # Sensor.positions says where upright pixels lie; the forward trace is the witness.
    origin = torch.tensor([10.0, 20.0, -6000.0], dtype=torch.float64)
    direction = -origin / origin.norm()
    hit = wavefront_coding().trace(Rays(origin, direction))
    x, y = Sensor(101, 101, 0.0069).positions(torch.tensor(0.0), torch.tensor(100.0))
    assert float(hit.position[0]) < 0 and float(hit.position[1]) < 0
    assert float(x) < 0 and float(y) < 0  # top right pixel


def test_the_same_seed_gives_the_same_image_and_another_another(wavefront_coding):
    lens, scene = wavefront_coding(), PlanarScene([8000.0], LINES)
    renderer, texture = RayRenderer(Sensor(8, 8, 0.0069), 3), smooth_texture(24)
    one, two, three = (renderer.render(lens, scene, texture, seed) for seed in (1, 1, 2))
    assert torch.equal(one, two)
    assert not torch.equal(one, three)


@pytest.mark.parametrize("plate", [0.0, 1.3e-5])
def test_a_render_is_the_texture_convolved_with_the_psf(wavefront_coding, plate):
    # Two independent routes: rays backward through jittered samples, rays forward into a PSF.
    lens, scene = wavefront_coding(plate), PlanarScene(DEPTHS, LINES)
    sensor, margin = Sensor(12, 12, 0.0069), 34
    texture = smooth_texture(12 + 2 * margin)
    image = RayRenderer(sensor, 40, chunk_rays=100_000).render(lens, scene, texture, seed=3)
    psf = axial_point_spread_functions(lens, scene, sensor, 61, 120)
    for d in range(len(DEPTHS)):
        # conv2d correlates; a convolution flips the kernel.
        flipped = psf[d].flip(-1, -2)[:, None]
        full = functional.conv2d(texture, flipped, groups=3)
        top = margin - 30
        expected = full[..., top : top + 12, top : top + 12]
        error = image[:, d] - expected
        # 1600 stratified samples a pixel leave 1.6e-3 of noise.
        assert float(error.square().mean().sqrt()) < 2e-3
        assert float(error.abs().max()) < 1e-2


@pytest.mark.parametrize("depth", DEPTHS)
def test_the_truth_is_registered_to_a_small_fraction_of_a_pixel(wavefront_coding, depth):
    # The full 256×256 sensor's field in 8×8 blocks of 32 pixels.  A ramp shifted by δ changes by
    # δ·slope, so a rendered ramp's offset from the pinhole's is the shift itself.
    lens, scene = wavefront_coding(), PlanarScene([depth], LINES)
    block = 32
    sensor = Sensor(256 // block, 256 // block, 0.0069 * block)
    size = sensor.width + 2
    ramp = torch.arange(size, dtype=torch.float64)
    for columns in (True, False):
        texture = (ramp[None, :] if columns else ramp[:, None]).expand(1, 3, size, size)
        truth = pinhole_image(texture, sensor)
        renderer = RayRenderer(sensor, 24, pixel_area=False)
        image = renderer.render(lens, scene, texture, seed=2)[:, 0]
        # Shading (here cos⁴ and a rare stopped ray) is no shift: divide it out.
        white = renderer.render(lens, scene, torch.ones_like(texture), seed=2)[:, 0]
        shift = ((image / white) - truth)[0] * block  # pixels
        assert float(shift[:, 3:5, 3:5].mean((1, 2)).abs().max()) < 0.01
        # Green defines the scale; red and blue have the lens's lateral colour.
        assert float(shift[1].abs().max()) < 0.05
        assert float(shift.abs().max()) < 0.1


def test_channels_must_match_the_wavelengths(wavefront_coding):
    renderer = RayRenderer(Sensor(4, 4, 0.0069), 2)
    with pytest.raises(InputError, match="one channel a wavelength"):
        renderer.render(
            wavefront_coding(), PlanarScene([8000.0], LINES), torch.ones(1, 2, 4, 4), seed=0
        )


def test_a_lens_that_stops_every_axial_ray_is_an_error(wavefront_coding):
    lens = wavefront_coding()
    with torch.no_grad():
        lens.surfaces["5"].x3.fill_(5.0)  # a plate that reflects everything totally
        lens.surfaces["5"].register_parameter("x", torch.nn.Parameter(torch.tensor(9.0).double()))
    with pytest.raises(InputError, match="no light reaches"):
        RayRenderer(Sensor(4, 4, 0.0069), 2).render(
            lens, PlanarScene([8000.0], LINES), torch.ones(1, 3, 4, 4), seed=0
        )


def test_settings_out_of_range_are_errors():
    with pytest.raises(InputError, match="gradient_fraction"):
        RayRenderer(Sensor(4, 4, 0.01), gradient_fraction=0.0)
    with pytest.raises(InputError, match="pupil_samples"):
        RayRenderer(Sensor(4, 4, 0.01), pupil_samples=0)
    with pytest.raises(InputError, match="pixel_pitch"):
        Sensor(4, 4, -1.0)
    assert math.isclose(Sensor(4, 4, 0.01).pixel_pitch, 0.01)
