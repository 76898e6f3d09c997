"""Rendering by point spread functions: what the ray renderer converges to, for less."""

import math
from dataclasses import replace

import pytest
import torch
import yaml

from dolens import load_lens
from dolens.errors import InputError
from dolens.optics.elements import Element, ElementState
from dolens.optics.trace import trace_surfaces
from dolens.prescriptions import lens_from_prescription
from dolens.rendering.auto.probes import probe_image
from dolens.rendering.exit_pupil import rays_to_exit_pupil, sampled_exit_pupil
from dolens.rendering.imaging_system import ImagingSystem
from dolens.rendering.psf import axial_point_spread_functions
from dolens.rendering.psf_grid import field_point_spread_functions
from dolens.rendering.psf_renderer import PsfRenderer
from dolens.rendering.ray_renderer import RayRenderer
from dolens.rendering.relative_illumination import relative_illumination
from dolens.scene.planar import PlanarScene
from dolens.sensor.pixels import Sensor

LINES = (656.2725, 587.5618, 486.1327)
GREY = 1.0 / 255.0


def texture(size, smoothness=2.5):
    """Noise of a photograph's kind, smooth over a few texels, between 0 and 1."""
    generator = torch.Generator().manual_seed(3)
    noise = torch.randn(1, 3, size, size, generator=generator, dtype=torch.float64)
    frequency = torch.fft.fftfreq(size).double()[:, None].square()
    frequency = frequency + torch.fft.rfftfreq(size).double().square()
    filtered = torch.fft.irfft2(
        torch.fft.rfft2(noise) * torch.exp(-2.0 * (math.pi * smoothness) ** 2 * frequency),
        s=(size, size),
    )
    return (0.5 + 0.15 * filtered / filtered.std()).clamp(0.0, 1.0)


def lens_by_name(root, name):
    lens = load_lens(root / "conf" / "lens" / f"{name}.yaml", dtype=torch.float64)
    if name == "wavefront_coding":
        with torch.no_grad():
            lens.surfaces["5"].x3.fill_(1.5e-5)
            lens.surfaces["5"].y3.fill_(1.2e-5)
    return lens.requires_grad_(False)


def error_in_grey_levels(image, references):
    """RMS error against the mean of two renders, without their own noise."""
    one, two = references
    noise = 0.25 * (one - two).square().mean()
    squared = (image - 0.5 * (one + two)).square().mean() - noise
    return math.sqrt(max(float(squared), 0.0)) / GREY


# Lens, sensor's side of 64 pixels in mm, settings, and the error that they are good for.
CASES = [
    ("wavefront_coding", 0.44, {"fields": (1, 1), "registration": "pinhole", "size": 41}, 0.3),
    ("cooke_triplet", 25.7, {"fields": (1, 1), "size": 15}, 0.5),
    ("large_fov_doublet", 34.2, {"fields": (5, 5), "size": 31}, 0.5),
    ("nikon", 1.35, {"fields": (1, 1), "size": 15}, 0.5),
]


@pytest.mark.parametrize(("name", "side", "settings", "tolerance"), CASES)
def test_the_image_is_what_rays_converge_to(root, name, side, settings, tolerance):
    lens, sensor = lens_by_name(root, name), Sensor(64, 64, side / 64)
    scene, textures = PlanarScene((5000.0,), LINES), texture(96)
    references = [RayRenderer(sensor, 16).render(lens, scene, textures, seed) for seed in (1, 2)]
    image = PsfRenderer(sensor, pupil_samples=40, **settings).render(lens, scene, textures, 5)
    assert error_in_grey_levels(image, references) < tolerance


def test_distortion_is_not_to_be_had_without_the_chief_rays(root):
    # The doublet at 35 degrees: shifts of pixels, which one function cannot hold.
    lens, sensor = lens_by_name(root, "large_fov_doublet"), Sensor(64, 64, 34.2 / 64)
    scene, textures = PlanarScene((5000.0,), LINES), texture(96)
    references = [RayRenderer(sensor, 12).render(lens, scene, textures, seed) for seed in (1, 2)]
    errors = [
        error_in_grey_levels(
            PsfRenderer(sensor, (1, 1), 32, 31, registration).render(lens, scene, textures, 5),
            references,
        )
        for registration in ("chief_rays", "pinhole")
    ]
    assert errors[1] > 3.0 * errors[0]


def test_gradients_of_the_plate_are_those_of_rays(root):
    lens, sensor = lens_by_name(root, "wavefront_coding"), Sensor(48, 48, 0.0069)
    scene, textures = PlanarScene((8000.0,), LINES), texture(96, smoothness=1.5)
    weight = texture(48, smoothness=2.0)[:, None] - 0.5

    def gradient(renderer, seed):
        plate = torch.tensor([1.5e-5, 1e-6, -1e-6, 1.2e-5]).double().requires_grad_()
        values = {f"surfaces.5.{n}": plate[i] for i, n in enumerate(("x3", "x2y", "xy2", "y3"))}
        image = renderer.render(lens.with_values(values), scene, textures, seed)
        return torch.autograd.grad((image * weight).sum(), plate)[0]

    rays = gradient(RayRenderer(sensor, 16), 0)
    functions = gradient(PsfRenderer(sensor, (1, 1), 40, 41, "pinhole"), 0)
    assert float(torch.cosine_similarity(rays, functions, dim=0)) > 0.99
    assert 0.95 < float(functions.norm() / rays.norm()) < 1.05


@pytest.mark.parametrize("fields", [(1, 1), (2, 3)])
@pytest.mark.parametrize("registration", ["pinhole", "chief_rays"])
def test_gradients_are_finite_differences(root, fields, registration):
    lens, sensor = lens_by_name(root, "wavefront_coding"), Sensor(16, 20, 0.0069)
    scene, textures = PlanarScene((8000.0, 4500.0), LINES), texture(72)
    # Registration moves with the lens and carries no gradient, which interpolation between fields
    # makes up for to second order only; curvature of the texture is what that leaves.
    renderer = PsfRenderer(sensor, fields, 12, 31, registration, illumination="functions")
    weight = texture(20)[:, None, :, :16] - 0.5

    def value(x3):
        return (
            renderer.render(lens.with_values({"surfaces.5.x3": x3}), scene, textures, 4) * weight
        ).sum()

    x3 = torch.tensor(1.3e-5, dtype=torch.float64, requires_grad=True)
    (slope,) = torch.autograd.grad(value(x3), x3)
    step = 1e-9
    with torch.no_grad():
        difference = (value(x3 + step) - value(x3 - step)) / (2.0 * step)
    assert float(slope) == pytest.approx(float(difference), rel=2e-3)


def test_functions_of_a_symmetric_lens_are_turned_along_with_the_field(root):
    # Of the same lens with and without an element that could be tilted, which ends the symmetry.
    lens = lens_by_name(root, "cooke_triplet")
    system, scene = lens.system(), PlanarScene((4000.0, 2500.0), LINES)
    pose = dict(Element(1, 2).requires_grad_(False).named_parameters())
    movable = replace(system, elements=[ElementState(1, 2, pose, (0.0, 0.0, 0.0))])
    assert system.rotationally_symmetric
    assert not movable.rotationally_symmetric
    imaging = ImagingSystem.of(system, scene, Sensor(64, 64, 0.02))
    angles = torch.tensor([0.0, 0.7, 2.0, 3.5]).double()
    points = 6.0 * torch.cos(angles), 6.0 * torch.sin(angles)
    found = [
        field_point_spread_functions(replace(imaging, system=lens), points, 21, 96, None, True)
        for lens in (system, movable)
    ]
    size = float(found[1].functions.max())
    assert float((found[0].functions - found[1].functions).abs().max()) < 0.03 * size
    assert torch.allclose(found[0].light, found[1].light, rtol=5e-3)


def test_the_function_on_the_axis_is_the_axial_one(root):
    # Backwards from the pixel and forwards from the point: the same light.
    lens = lens_by_name(root, "wavefront_coding")
    sensor, scene = Sensor(1, 1, 0.0069), PlanarScene((8000.0, 4500.0), LINES)
    zero = torch.zeros(1, dtype=torch.float64)
    imaging = ImagingSystem.of(lens.system(), scene, sensor)
    found = field_point_spread_functions(imaging, (zero, zero), 61, 160, None, False)
    forward = axial_point_spread_functions(lens, scene, sensor, 61, 160)
    difference = (found.functions[0] - forward).abs().sum((-2, -1))
    assert float(difference.max()) < 0.02
    assert float((found.functions.sum((-2, -1)) - 1.0).abs().max()) < 1e-3


def test_illumination_follows_cos4_where_nothing_clips(root):
    # A singlet's stop in front of a plane-parallel world: the doublet's rear stop is its exit
    # pupil, and a pixel at field angle θ sees it in cos⁴ θ, for a small pupil.
    prescription = yaml.safe_load((root / "conf/lens/large_fov_doublet.yaml").read_text())
    prescription["surfaces"]["4"]["semi_diameter"] = 0.4
    lens = lens_from_prescription(prescription)
    system, sensor = lens.system(), Sensor(3, 101, 0.1)
    imaging = ImagingSystem.of(system, PlanarScene((5000.0,), LINES[:1]), sensor)
    pupil, found = imaging.pupil, relative_illumination(imaging)
    x, y = sensor.positions(*torch.meshgrid(torch.arange(3.0), torch.arange(101.0), indexing="ij"))
    distance = float(system.vertices[-1].detach()) - pupil.z
    cosine = distance / torch.sqrt(distance**2 + x * x + y * y)
    assert torch.allclose(found[0], cosine.double() ** 4, rtol=2e-4)


def test_one_function_serves_depths_and_colours_when_asked(root):
    lens, sensor = lens_by_name(root, "cooke_triplet"), Sensor(24, 24, 0.02)
    scene, textures = PlanarScene((50000.0, 45000.0), LINES), texture(40)
    each = PsfRenderer(sensor, (1, 1), 32, 15)
    image = each.render(lens, scene, textures, 0)
    shared = replace(each, depths="one", colours="one").render(lens, scene, textures, 0)
    assert shared.shape == image.shape == (1, 2, 3, 24, 24)
    # At 50 m a tenth of the distance changes nothing; colours differ by their focus.
    one_depth = replace(each, depths="one").render(lens, scene, textures, 0)
    assert float((one_depth - image).abs().max()) < 0.2 * GREY
    assert float((shared - image).abs().max()) < 20 * GREY


def test_a_window_is_a_part_of_the_whole(root):
    lens, scene = lens_by_name(root, "cooke_triplet"), PlanarScene((5000.0,), LINES)
    sensor, textures = Sensor(96, 96, 0.2), texture(128)
    window = sensor.window(60, 10, 24, 30)
    # The texture's part that the window sees, with 16 texels of margin on each side.
    part = textures[..., 60:116, 10:72]
    centre = (60 + 28 - 64.0, 10 + 31 - 64.0)
    local = replace(scene, texture_centre=centre)
    whole = PsfRenderer(sensor, (1, 1), 32, 15).render(lens, scene, textures, 0)
    shown = PsfRenderer(window, (1, 1), 32, 15).render(lens, local, part, 0)
    expected = whole[..., 60:84, 10:40]
    # The window has its own function, the whole the axial one.
    assert float((shown - expected).square().mean().sqrt()) < 1.5 * GREY
    by_rays = RayRenderer(window, 40).render(lens, local, part, 0)
    assert float((shown - by_rays).square().mean().sqrt()) < 1.5 * GREY


def test_light_from_beyond_the_axial_pupil_is_not_lost(root):
    """The triplet's exit pupil grows off the axis: all rays that pass, on a square about it."""
    lens = lens_by_name(root, "cooke_triplet")
    system, sensor = lens.system(), Sensor(3, 3, 12.0)
    pupil = sampled_exit_pupil(system, LINES, sensor)
    assert pupil.radius > 1.03 * pupil.axial_radius
    scene = PlanarScene((5000.0,), LINES[1:2])
    found = relative_illumination(ImagingSystem(system, scene, sensor, pupil), 40_000)
    side = (torch.arange(700).double() + 0.5) / 350 - 1.0
    across, down = torch.meshgrid(
        1.5 * pupil.radius * side, 1.5 * pupil.radius * side, indexing="ij"
    )
    for row, column in ((0, 0), (1, 0)):
        x, y = sensor.positions(torch.tensor(row).double(), torch.tensor(column).double())
        ray = rays_to_exit_pupil(x, y, system.vertices[-1], across, down, pupil.z)
        traced = trace_surfaces(system, ray, LINES[1], sense=-1.0)
        light = torch.where(traced.valid, ray.n**4, 0.0).sum() * (3.0 * pupil.radius / 700) ** 2
        squared = (float(system.vertices[-1]) - pupil.z) ** 2
        axial = math.pi * pupil.axial_radius**2 * squared / (squared + pupil.axial_radius**2)
        assert float(found[0, row, column]) == pytest.approx(float(light) / axial, rel=2e-3)


def test_windows_beyond_the_sensor_are_errors():
    with pytest.raises(InputError, match="not within"):
        Sensor(10, 10, 0.1).window(5, 0, 6, 4)


def test_light_beyond_the_window_is_counted(root):
    lens, sensor = lens_by_name(root, "wavefront_coding"), Sensor(8, 8, 0.0069)
    renderer, scene = PsfRenderer(sensor, (1, 1), 48, 9), PlanarScene((8000.0,), LINES)
    imaging = ImagingSystem.of(lens.system(), scene, sensor)
    found = renderer.point_spread_functions(imaging, 0)
    kept = found.functions.sum((-2, -1)).min()
    assert 0.05 < float(found.truncated) < 0.95
    assert float(found.truncated) == pytest.approx(
        1.0 - float(kept) / float(found.light[0, 0]), abs=0.02
    )


def test_waves_and_rays_show_the_same_but_for_fringes(root):
    # Behind the plate aberrations are of many wavelengths, and what is left are a caustic's
    # fringes; the product with a perfect pupil's transfer function has none of these.
    lens = lens_by_name(root, "wavefront_coding")
    sensor, scene = Sensor(40, 40, 0.0069), PlanarScene((8000.0,), LINES)
    image = {}
    for diffraction in ("none", "limit", "wave"):
        renderer = PsfRenderer(
            sensor, (1, 1), 64, 61, "pinhole", illumination="functions", diffraction=diffraction
        )
        image[diffraction] = renderer.render(lens, scene, probe_image(120, 120), 1)
    errors = {
        name: float((image[name] - image["wave"]).square().mean().sqrt()) / GREY
        for name in ("none", "limit")
    }
    assert 0.5 < errors["none"] < 1.5
    assert 0.5 < errors["limit"] < 1.5


def test_a_perfect_pupil_s_diffraction_is_the_wave_s_where_the_lens_is_sharp(root):
    lens = load_lens(root / "conf/lens/wavefront_coding.yaml").requires_grad_(False)
    with torch.no_grad():
        lens.sensor_distance.fill_(float(lens.first_order(object_distance=8000.0).image) - 10.5)
    sensor, scene = Sensor(40, 40, 0.0069), PlanarScene((8000.0,), LINES[1:2])
    image = {}
    for diffraction in ("none", "limit", "wave"):
        renderer = PsfRenderer(
            sensor, (1, 1), 64, 61, "pinhole", illumination="functions", diffraction=diffraction
        )
        image[diffraction] = renderer.render(lens, scene, probe_image(120, 120)[:, :1], 1)
    errors = {
        name: float((image[name] - image["wave"]).square().mean().sqrt()) / GREY
        for name in ("none", "limit")
    }
    assert errors["limit"] < 0.3 * errors["none"]


def test_gradients_through_waves_are_finite_differences(root):
    lens = lens_by_name(root, "wavefront_coding")
    sensor, scene = Sensor(12, 12, 0.0069), PlanarScene((8000.0,), LINES[:1])
    renderer = PsfRenderer(
        sensor, (1, 1), 8, 41, "pinhole", illumination="functions", diffraction="wave"
    )
    textures = texture(60)[:, :1]
    weight = texture(12)[:, None, :1] - 0.5

    def value(x3):
        return (
            renderer.render(lens.with_values({"surfaces.5.x3": x3}), scene, textures, 4) * weight
        ).sum()

    x3 = torch.tensor(1.3e-5, dtype=torch.float64, requires_grad=True)
    (slope,) = torch.autograd.grad(value(x3), x3)
    step = 1e-9
    with torch.no_grad():
        difference = (value(x3 + step) - value(x3 - step)) / (2.0 * step)
    assert float(slope) == pytest.approx(float(difference), rel=1e-2)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"fields": (0, 1)}, "fields"),
        ({"size": 10}, "odd"),
        ({"pupil_samples": 0}, "pupil_samples"),
        ({"registration": "none"}, "registration: 'none'"),
        ({"depths": "all"}, "depths: 'all'"),
    ],
)
def test_settings_out_of_range_are_errors(settings, message):
    with pytest.raises(InputError, match=message):
        PsfRenderer(Sensor(4, 4, 0.01), **settings)
