"""Scenes with a depth at every texel: planes that hide one another, in one image."""

import math

import numpy as np
import pytest
import torch
import yaml

from dolens import load_lens
from dolens.errors import InputError
from dolens.imaging.layers import LayeredScene
from dolens.imaging.psf_renderer import PsfRenderer
from dolens.imaging.ray_renderer import RayRenderer
from dolens.imaging.scene import PlanarScene, pinhole_image
from dolens.imaging.sensor import Sensor
from dolens.prescriptions import lens_from_prescription

LINES, GREEN = (656.2725, 587.5618, 486.1327), (587.5618,)
GREY = 1.0 / 255.0
NEAR, FAR = 1200.0, 6000.0
MIDDLE = 2.0 / (1.0 / NEAR + 1.0 / FAR)


@pytest.fixture
def backend():
    """The fused traces: their equality with the reference is tested elsewhere."""
    return "auto"


@pytest.fixture(scope="module")
def triplet(root):
    """At F/19, where a thin lens of the same pupils says where the light goes."""
    prescription = yaml.safe_load((root / "conf/lens/cooke_triplet.yaml").read_text())
    prescription["surfaces"]["4"]["semi_diameter"] = 1.0
    return lens_from_prescription(prescription).double().requires_grad_(False)


def focused(lens, depth):
    """Values that focus the lens at a depth, by Newton's x·x' = f²."""
    first = lens.first_order(GREEN[0])
    distance = first.bfd + first.efl**2 / (depth + first.ffd)
    return {"sensor_distance": distance.detach()}


def blur_radius(lens, depth, focus, pitch):
    """Signed radius in pixels: where the ray of the pupil's edge meets a plane, seen by a pinhole.

    The ray from the pupil's edge a to the point (0, s₀) in focus is at a (1 - s/s₀) at the distance
    s; the pinhole's magnification is F/s, by the angular magnification of the pupils.
    """
    first = lens.first_order(GREEN[0])
    entrance, exit_pupil = first.entrance_pupil, first.exit_pupil
    sensor = first.focus - first.bfd + focused(lens, focus)["sensor_distance"]
    scale = entrance.diameter / exit_pupil.diameter * (sensor - exit_pupil.z)
    distances = (1.0 / (depth + entrance.z), 1.0 / (focus + entrance.z))
    return float(0.5 * entrance.diameter * scale / pitch * (distances[0] - distances[1]))


def noise(size, smoothness=1.5, seed=3, channels=1):
    """Smooth over a few texels, of zero mean and unit variance."""
    generator = torch.Generator().manual_seed(seed)
    white = torch.randn(1, channels, size, size, generator=generator, dtype=torch.float64)
    frequency = torch.fft.fftfreq(size).double()[:, None].square()
    frequency = frequency + torch.fft.rfftfreq(size).double().square()
    shape = torch.exp(-2.0 * (math.pi * smoothness) ** 2 * frequency)
    filtered = torch.fft.irfft2(torch.fft.rfft2(white) * shape, s=(size, size))
    return filtered / filtered.std()


def random_depths(size, near, far, seed=0):
    """Every texel at a depth of its own, in vergence evenly distributed."""
    share = torch.rand(1, 1, size, size, generator=torch.Generator().manual_seed(seed)).double()
    return 1.0 / ((1.0 - share) / near + share / far)


def rms(image):
    return float(image.square().mean().sqrt())


# ------------------------------------------------------------------- agreement with planes


RENDERERS = [
    RayRenderer(Sensor(12, 14, 0.02), 4),
    PsfRenderer(Sensor(12, 14, 0.02), (1, 1), 12, 21, "pinhole"),
    PsfRenderer(Sensor(12, 14, 0.02), (2, 2), 12, 21),
    PsfRenderer(Sensor(12, 14, 0.02), (1, 2), 12, 5, illumination="functions"),
]


@pytest.mark.parametrize("renderer", RENDERERS)
def test_one_layer_is_the_plane(root, renderer):
    # At F/5 and far from the axis, with vignetting and light that falls beyond the functions.
    lens = load_lens(root / "conf/lens/cooke_triplet.yaml", dtype=torch.float64)
    lens.requires_grad_(False)
    colours = 0.5 + 0.1 * noise(40, channels=3).expand(2, -1, -1, -1)
    textures = torch.cat((colours, random_depths(40, 500.0, 5000.0).expand(2, -1, -1, -1)), 1)
    window = Sensor(12, 14, 0.02, centre_row=300.0, centre_column=-200.0)
    renderer = type(renderer)(**{**vars(renderer), "sensor": window})
    options = {"wavelengths": LINES, "texture_centre": (300.0, -200.0)}
    plane = renderer.render(lens, PlanarScene((2500.0,), **options), colours, 1)
    layer = renderer.render(lens, LayeredScene((2500.0,), **options), textures, 1)
    assert layer.shape == plane.shape == (2, 1, 3, 12, 14)
    assert float(plane.max()) < 0.9
    assert torch.allclose(layer, plane, rtol=0, atol=1e-9)


def test_one_function_for_all_layers_makes_one_plane_of_them(triplet):
    # Without a blur of their own nothing tells planes apart, but holes at edges do: so no edges.
    colours = 0.5 + 0.1 * noise(64)
    textures = torch.cat((colours, torch.full_like(colours, 2000.0)), 1)
    renderer = PsfRenderer(Sensor(12, 14, 0.02), (1, 1), 12, 21, depths="one")
    scene = LayeredScene((1200.0, 1900.0, 2300.0, 6000.0), GREEN)
    layers = renderer.render(triplet, scene, textures, 1)
    (depth,) = renderer.shared(scene).depths
    plane = renderer.render(triplet, PlanarScene((depth,), GREEN), colours, 1)
    assert torch.allclose(layers, plane, rtol=0, atol=1e-9)


@pytest.mark.parametrize("kind", ["rays", "psf"])
def test_between_planes_the_error_falls_with_the_square_of_their_distance(triplet, kind):
    sensor, focus = Sensor(24, 24, 0.005), focused(triplet, FAR)
    renderer = RayRenderer(sensor, 8)
    if kind == "psf":
        renderer = PsfRenderer(sensor, (1, 1), 48, 41, jitter=False)
    colours = 0.5 + 0.15 * noise(64)
    depth = 1900.0
    plane = renderer.render(triplet, PlanarScene((depth,), GREEN), colours, 1, focus)
    errors = []
    for gap in (8.0, 4.0, 2.0):
        # Neighbours at 0.3 and 0.7 of a gap of so many pixels of blur's radius.
        per_pixel = (1.0 / NEAR - 1.0 / FAR) / blur_radius(triplet, NEAR, FAR, 0.005)
        around = [1.0 / depth - 0.3 * gap * per_pixel, 1.0 / depth + 0.7 * gap * per_pixel]
        scene = LayeredScene(sorted(1.0 / v for v in around), GREEN)
        textures = torch.cat((colours, torch.full_like(colours, depth)), 1)
        image = renderer.render(triplet, scene, textures, 1, focus)
        errors.append(rms(image - plane) / GREY)
    assert errors[2] < 1.0
    assert errors[0] > 2.5 * errors[1] > 2.5**2 * errors[2]


@pytest.mark.parametrize("reach", [0, 15])
@pytest.mark.parametrize("renderer", RENDERERS[:3])
def test_white_is_white_at_any_depths(triplet, renderer, reach):
    # Single texels, and blocks larger than the reach, with holes behind them.
    depths = random_depths(60, NEAR, FAR)
    depths[..., 20:] = (
        random_depths(4, NEAR, FAR, 1)
        .repeat_interleave(15, -1)[..., 20:, :]
        .repeat(1, 1, 15, 1)[..., :60, :40]
    )
    white = torch.ones(1, 1, 60, 60, dtype=torch.float64)
    focus = focused(triplet, FAR)
    scene = LayeredScene.evenly_spaced(NEAR, FAR, 5, GREEN, reach=reach)
    image = renderer.render(triplet, scene, torch.cat((white, depths), 1), 2, focus)
    plane = renderer.render(triplet, PlanarScene((2000.0,), GREEN), white, 2, focus)
    assert float((image - plane).abs().max()) < 1e-4
