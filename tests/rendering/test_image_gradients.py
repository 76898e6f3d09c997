"""Derivatives of images: autograd beside differences of the same render with the same samples."""

import math

import pytest
import torch

from dolens import load_lens
from dolens.diffraction.pixel_psf import PixelWindow, wave_kernels
from dolens.errors import InputError
from dolens.prescriptions import lens_from_prescription
from dolens.prescriptions.build import prescription_of
from dolens.rendering.auto.probes import probe_texture
from dolens.rendering.gradient_check import gradient_rows
from dolens.rendering.psf_renderer import PsfRenderer
from dolens.rendering.ray_renderer import RayRenderer
from dolens.scene.planar import PlanarScene, pinhole_image
from dolens.sensor.pixels import Sensor

LINES = (656.2725, 587.5618, 486.1327)


def triplet(root):
    return load_lens(root / "conf/lens/cooke_triplet.yaml", dtype=torch.float64)


def squared_error(lens, renderer, depth, texture_scale="magnification"):
    """To what a pinhole of the lens as it begins sees."""
    sensor = renderer.sensor
    scene = PlanarScene((depth,), LINES, texture_scale=texture_scale).fixed_for(lens.system())
    textures = probe_texture(sensor, 3, 0)[:1]
    truth = pinhole_image(textures, sensor)[:, None]

    def loss(values, seed):
        return (
            (renderer.render(lens.with_values(values), scene, textures, seed) - truth)
            .square()
            .mean()
        )

    return loss


def rows_of(lens, renderer, depth, names, seeds=(0, 1), step=None, **options):
    loss = squared_error(lens, renderer, depth, **options)
    return {row.name: row for row in gradient_rows(loss, lens, names, seeds, step)}


SMALL_STEP = 1e-6  # where no sample crosses an edge, there is no noise to drown


def whole_field(pixels, share=1.0, diagonal=36.346):
    return Sensor(pixels, pixels, share * diagonal / math.sqrt(2.0) / pixels)


FRONT = ["surfaces.1.curvature", "surfaces.2.curvature", "thicknesses.1", "thicknesses.2"]
BEHIND_THE_STOP = ["surfaces.4.curvature", "surfaces.6.curvature", "sensor_distance"]


@pytest.mark.parametrize("depth", [1000.0, 1e6])
def test_what_changes_the_magnification_has_the_render_s_derivative(root, depth):
    # In front of the stop nothing moves what the sensor sees of it: no noise of edges remains.
    renderer = RayRenderer(whole_field(12), 6)
    for row in rows_of(triplet(root), renderer, depth, FRONT, (0,), SMALL_STEP).values():
        assert row.difference != 0.0
        assert row.error < 1e-3, row


def test_edges_that_clip_the_field_have_their_part_of_the_derivative(root):
    # The rear rims vignette the corners; without edges' terms these are 7 to 9 % off.
    renderer = RayRenderer(whole_field(16), 24)
    for row in rows_of(triplet(root), renderer, 1000.0, BEHIND_THE_STOP).values():
        assert row.agrees(0.03), row


def test_the_bias_of_a_squared_error_falls_with_the_rays(root):
    """A render has the error e and the noise ν of its samples: its squared error is e² + E[ν²] on
    average, and the derivative of E[ν²] is a bias that more rays take away.  Times the error of
    another render, of its own samples, its derivative has none.
    """
    lens, name = triplet(root), "thicknesses.4"
    start = lens.get_parameter(name).detach()
    sensor, scene = whole_field(16), PlanarScene((1000.0,), LINES).fixed_for(lens.system())
    textures = probe_texture(sensor, 3, 0)[:1]
    truth = pinhole_image(textures, sensor)[:, None]

    def errors(rays, seed, value):
        return (
            RayRenderer(sensor, rays).render(lens.with_values({name: value}), scene, textures, seed)
            - truth
        )

    def slope(rays, seed, other=None):
        value = start.clone().requires_grad_()
        one = errors(rays, seed, value)
        factor = one if other is None else 2.0 * errors(rays, other, start)
        return torch.autograd.grad((one * factor).mean(), value)[0]

    step = 0.04  # mm, so large that samples at edges make little noise
    with torch.no_grad():
        up, down = (
            torch.stack([errors(96, seed, start + way).square().mean() for seed in range(6)])
            for way in (step, -step)
        )
    differences = (up - down) / (2.0 * step)
    reference = differences.mean()
    spread = differences.std() / math.sqrt(6.0) / reference.abs()
    assert float(spread) < 0.01
    shares = {
        rays: float(torch.stack([slope(rays, seed) for seed in range(count)]).mean() / reference)
        for rays, count in ((2, 20), (4, 10), (12, 4))
    }
    # See docs/gradients.md.
    assert 0.75 < shares[2] < 0.88
    assert 0.90 < shares[4] < 0.97
    assert abs(shares[12] - 1.0) < 0.02
    products = torch.stack([slope(2, seed, seed + 20) for seed in range(20)]) / reference
    noise = math.hypot(float(products.std()) / math.sqrt(20.0), float(spread))
    assert noise < 0.04
    assert abs(float(products.mean()) - 1.0) < 2.0 * noise


def test_a_wider_stop_blurs_more_by_the_derivative(root):
    # The stop alone limits the light, and its image is the disc that is sampled.
    lens = load_lens(root / "conf/lens/large_fov_doublet.yaml", dtype=torch.float64)
    name = "surfaces.4.semi_diameter"
    for sensor in (Sensor(8, 8, 0.02), whole_field(8, diagonal=48.437)):
        row = rows_of(lens, RayRenderer(sensor, 6), 1e6, [name], (0,), SMALL_STEP)[name]
        assert row.error < 1e-3, row


def test_white_corners_darken_by_the_derivative(root):
    """A white plane: nothing but vignetting and cos⁴ remains."""
    lens, sensor = triplet(root), whole_field(10)
    scene, white = PlanarScene((1000.0,), LINES[1:2]), torch.ones(1, 1, 40, 40).double()
    corner = torch.zeros(10, 10).double()
    corner[:2, :2] = corner[-2:, -2:] = 1.0 / 8.0

    def loss(values, seed):
        renderer = RayRenderer(sensor, 64)
        return (
            renderer.render(lens.with_values(values), scene, white, seed)[0, 0, 0] * corner
        ).sum()

    # A wider stop lets more light through on the axis, which the corner is measured by.
    names = ["surfaces.3.semi_diameter", "surfaces.4.semi_diameter", "sensor_distance"]
    for row, sign in zip(gradient_rows(loss, lens, names, (0, 1, 2, 3)), (1, -1, 1), strict=True):
        assert sign * row.difference > 5.0 * row.noise, row
        assert row.agrees(0.03), row


@pytest.mark.parametrize("registration", ["chief_rays", "pinhole"])
def test_functions_follow_distortion_and_magnification(root, registration):
    size = 15 if registration == "chief_rays" else 31
    renderer = PsfRenderer(whole_field(16, 0.6), (2, 2), 8, size, registration)
    names = ["surfaces.1.curvature", "thicknesses.2"]
    for row in rows_of(triplet(root), renderer, 1000.0, names, (0,), SMALL_STEP).values():
        assert row.error < 1e-3, row


@pytest.mark.parametrize("diffraction", ["limit", "wave"])
def test_diffraction_follows_the_aperture(root, diffraction):
    """A wider stop: a smaller Airy disc, and more of the aberrations."""
    lens = load_lens(root / "conf/lens/wavefront_coding.yaml", dtype=torch.float64)
    with torch.no_grad():
        lens.sensor_distance.fill_(95.86)
    # Pixels of 2 µm show it.
    renderer = PsfRenderer(
        Sensor(8, 8, 0.002), (1, 1), 12, 31, "pinhole", "functions", diffraction=diffraction
    )
    names = ["surfaces.1.semi_diameter", "sensor_distance", "surfaces.5.x2y"]
    for row in rows_of(lens, renderer, 6000.0, names, (0,), 1e-5).values():
        assert row.difference != 0.0
        assert row.error < 2e-3, row


@pytest.mark.parametrize("number", [3, 4])
def test_a_vignetted_pupil_s_light_follows_both_of_its_edges(root, number):
    """By waves, of the triplet at 19 degrees, relative to an axial point's: a wider stop lets more
    light through on the axis, a wider surface 3 more at the edge of the field.
    """
    lens, name = triplet(root), f"surfaces.{number}.semi_diameter"
    point = torch.tensor([[0.0, 340.0, -1000.0]])
    radius = torch.tensor(lens.surfaces[str(number)].semi_diameter).double().requires_grad_()

    def light(radius):
        return wave_kernels(
            lens.system({name: radius}), point, LINES[1], None, PixelWindow(0.012, 41)
        ).sum()

    (slope,) = torch.autograd.grad(light(radius), radius)
    with torch.no_grad():
        difference = (light(radius + 0.05) - light(radius - 0.05)) / 0.1
    assert abs(float(difference)) > 0.05
    assert float(slope) == pytest.approx(float(difference), rel=0.01)


def test_the_reference_s_gradients_are_those_of_the_kernels(root):
    lens, found = triplet(root), []
    for backend in ("reference", "cpu"):
        lens.backend = backend
        loss = squared_error(lens, RayRenderer(whole_field(6), 5), 1000.0)
        names = [*FRONT, *BEHIND_THE_STOP, "surfaces.4.semi_diameter"]
        values = {n: p.detach().clone().requires_grad_() for n, p in lens.named_parameters()
                  if n in names}  # fmt: skip
        values["surfaces.4.semi_diameter"] = torch.tensor(3.86).double().requires_grad_()
        found.append(torch.autograd.grad(loss(values, 3), list(values.values())))
    for one, other in zip(*found, strict=True):
        assert float(one) == pytest.approx(float(other), rel=1e-8)


def test_poses_move_the_image_by_the_derivative(root):
    prescription = prescription_of(triplet(root))
    prescription["elements"] = {"middle": {"surfaces": [3, 4], "tilt_x": 0.5, "decenter_y": 0.05}}
    lens = lens_from_prescription(prescription, torch.float64)
    names = ["elements.middle.tilt_x", "elements.middle.decenter_y", "elements.middle.shift_z"]
    renderer = RayRenderer(whole_field(14, 0.5), 16)
    for row in rows_of(lens, renderer, 1000.0, names, seeds=(0, 1, 2)).values():
        assert row.agrees(0.03), row


def test_a_scene_fixed_in_the_world_punishes_another_magnification(root):
    """What follows the lens's magnification is free to grow; what is fixed is not."""
    lens, name = triplet(root), "thicknesses.2"
    found = {
        texture_scale: rows_of(lens, RayRenderer(whole_field(12, 0.5), 8), 1000.0, [name],
                         texture_scale=texture_scale)[name]
        for texture_scale in ("magnification", "fixed")
    }  # fmt: skip
    for row in found.values():
        assert row.error < 5e-3, row
    assert found["fixed"].autograd != pytest.approx(found["magnification"].autograd, rel=0.1)


def test_a_world_must_be_fixed_for_a_lens(root):
    with pytest.raises(InputError, match="fixed_for"):
        PlanarScene((1000.0,), LINES, texture_scale="fixed").magnifications(triplet(root).system())
    with pytest.raises(InputError, match=r"scene\.texture_scale: 'sky' is unknown"):
        PlanarScene((1000.0,), LINES, texture_scale="sky")
