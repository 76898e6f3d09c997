"""Scenes with a depth at every texel: planes that hide one another, in one image."""

import math

import numpy as np
import pytest
import torch
import yaml

from dolens import load_lens
from dolens.errors import InputError
from dolens.prescriptions import lens_from_prescription
from dolens.rendering.psf_renderer import PsfRenderer
from dolens.rendering.ray_renderer import RayRenderer
from dolens.scene.layered import LayeredScene
from dolens.scene.planar import PlanarScene, pinhole_image
from dolens.sensor.pixels import Sensor

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
    renderer = PsfRenderer(Sensor(12, 14, 0.02), (1, 1), 12, 21, "pinhole", depths="one")
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
    plane = renderer.render(triplet.with_values(focus), PlanarScene((depth,), GREEN), colours, 1)
    errors = []
    for gap in (8.0, 4.0, 2.0):
        # Neighbours at 0.3 and 0.7 of a gap of so many pixels of blur's radius.
        per_pixel = (1.0 / NEAR - 1.0 / FAR) / blur_radius(triplet, NEAR, FAR, 0.005)
        around = [1.0 / depth - 0.3 * gap * per_pixel, 1.0 / depth + 0.7 * gap * per_pixel]
        scene = LayeredScene(sorted(1.0 / v for v in around), GREEN)
        textures = torch.cat((colours, torch.full_like(colours, depth)), 1)
        image = renderer.render(triplet.with_values(focus), scene, textures, 1)
        errors.append(rms(image - plane) / GREY)
    assert errors[2] < 1.5
    assert errors[0] > 2.5 * errors[1] > 2.5**2 * errors[2]


@pytest.mark.parametrize("reach", [0, 15])
@pytest.mark.parametrize("renderer", RENDERERS[:3])
def test_white_is_white_at_any_depths(triplet, renderer, reach):
    # Single texels, and blocks larger than the reach, with holes behind them.
    depths = random_depths(60, NEAR, FAR)
    blocks = random_depths(4, NEAR, FAR, 1).repeat_interleave(15, -1).repeat_interleave(15, -2)
    depths[..., 20:] = blocks[..., 20:]
    white = torch.ones(1, 1, 60, 60, dtype=torch.float64)
    focus = focused(triplet, FAR)
    scene = LayeredScene.evenly_spaced(NEAR, FAR, 5, GREEN, inpainting_radius=reach)
    image = renderer.render(triplet.with_values(focus), scene, torch.cat((white, depths), 1), 2)
    plane = renderer.render(triplet.with_values(focus), PlanarScene((2000.0,), GREEN), white, 2)
    assert float((image - plane).abs().max()) < 1e-4


# ------------------------------------------------------------------- closed forms


def test_a_pinhole_sees_the_texture_whatever_the_depths(root):
    prescription = yaml.safe_load((root / "conf/lens/cooke_triplet.yaml").read_text())
    prescription["surfaces"]["4"]["semi_diameter"] = 1e-3
    lens = lens_from_prescription(prescription).double().requires_grad_(False)
    sensor, colours = Sensor(16, 20, 0.02), torch.rand(1, 1, 40, 40).double()
    textures = torch.cat((colours, random_depths(40, 800.0, 7000.0)), 1)
    scene = LayeredScene.evenly_spaced(900.0, 6000.0, 4, GREEN)
    image = RayRenderer(sensor, 2, pixel_area=False).render(lens, scene, textures, 0)
    truth = pinhole_image(scene.colours(textures), sensor)
    # The triplet's distortion moves pixels by a thousandth.
    assert torch.allclose(image[:, 0], truth, atol=4e-3)


def disc(side=192):
    """Points of the unit disc, evenly spread: x, (N,)."""
    place = (np.arange(side) + 0.5) / (0.5 * side) - 1.0
    x, y = np.meshgrid(place, place)
    return x[x * x + y * y < 1.0]


EDGES = [
    (NEAR, "rays", 0.3),
    (NEAR, "psf", 0.3),
    (FAR, "rays", 0.4),
    (FAR, "psf", 0.4),
    (MIDDLE, "rays", 0.5),
    (MIDDLE, "psf", 1.2),
]


@pytest.mark.parametrize(("focus", "kind", "tolerance"), EDGES)
@pytest.mark.parametrize("planes", ["own", "even"])
def test_an_edge_in_front_of_an_edge_is_that_of_a_thin_lens(
    triplet, focus, kind, tolerance, planes
):
    """A dark half plane, nine pixels beside it a step of the background; in grey levels, RMS.

    The witness samples the pupil of a thin lens: nothing of the lens but its pupils, and nothing
    of the renderers.  What the half plane hides it takes to go on as it is beside the edge.
    """
    pitch, width = 0.005, 44
    size = width + 44
    edge, step = size // 2 - 1, size // 2 + 5
    column = torch.arange(size)
    colour = torch.where(column <= edge, 0.2, torch.where(column <= step, 0.9, 0.5)).double()
    depth = torch.where(column <= edge, NEAR, FAR).double()
    textures = torch.stack((colour, depth))[None, :, None].expand(-1, -1, 48, -1)
    near, far = (blur_radius(triplet, d, focus, pitch) for d in (NEAR, FAR))
    pixel = np.arange(width) + 0.5 * (size - width)
    place = pixel[:, None, None] + (np.arange(8)[:, None] + 0.5) / 8 - 0.5
    opacity = np.clip(edge + 1 - (place + near * disc()), 0.0, 1.0)
    background = 0.9 - 0.4 * np.clip(place + far * disc() - step, 0.0, 1.0)
    expected = (0.2 * opacity + (1.0 - opacity) * background).mean((1, 2))
    # Rows are alike but for their rays; of many planes two are enough for the looser tolerance.
    sensor = Sensor(4 if planes == "own" else 2, width, pitch)
    scene = LayeredScene((NEAR, FAR), GREEN)
    if planes == "even":
        # A pixel of blur from plane to plane, and the scene between them: linear interpolation of
        # a blur that is least in between is what is left at the edge in focus.
        scene = LayeredScene.evenly_spaced(1000.0, 9000.0, 15, GREEN)
        tolerance = tolerance + 0.7
    renderer = RayRenderer(sensor, 24)
    if kind == "psf":
        renderer = PsfRenderer(sensor, (1, 1), 48, 31, jitter=False)
    image = renderer.render(triplet.with_values(focused(triplet, focus)), scene, textures, 1)
    found = image[0, 0, 0].mean(0)
    assert rms(found - torch.from_numpy(expected)) < tolerance * GREY


@pytest.mark.parametrize("kind", ["rays", "psf"])
@pytest.mark.parametrize("focus", [NEAR, FAR])
def test_a_steep_slope_is_displaced_by_less_than_a_third_of_a_pixel(triplet, kind, focus):
    """Vergence falls with the column as the texture grows: parallax moves what a pixel sees.

    With blur's radius r + ε x at column x, the ray of the pupil point u meets the surface at
    x = (p + r u)/(1 - ε u).  Over the disc 1/(1 - ε u) is 2 (1 - √(1 - ε²))/ε² on average.
    Here ε is a sixth, far steeper than a wall seen from a metre.
    """
    pitch, size = 0.005, 56
    near, far = (blur_radius(triplet, d, focus, pitch) for d in (NEAR, FAR))
    column = torch.arange(size, dtype=torch.float64)
    share = column / (size - 1)
    first = triplet.first_order(GREEN[0])
    # Linear in the vergence at the entrance pupil, which blur is proportional to.
    distance = 1.0 / (
        (1.0 - share) / (NEAR + first.entrance_pupil.z) + share / (FAR + first.entrance_pupil.z)
    )
    depth = (distance - first.entrance_pupil.z).expand(40, -1)
    textures = torch.stack((column.expand(40, -1) / size, depth))[None]
    sensor = Sensor(4, 16, pitch)
    scene = LayeredScene.evenly_spaced(NEAR, FAR, 9, GREEN)
    renderer = RayRenderer(sensor, 24, pixel_area=False)
    if kind == "psf":
        renderer = PsfRenderer(sensor, (1, 1), 48, 31, jitter=False)
    image = renderer.render(triplet.with_values(focused(triplet, focus)), scene, textures, 1)
    pixel = column[20:36]
    slope = (far - near) / (size - 1)
    mean = 2.0 * (1.0 - math.sqrt(1.0 - slope**2)) / slope**2
    expected = mean * pixel + near * (mean - 1.0) / slope
    shift = size * image[0, 0, 0].mean(0) - expected
    # Planes that share a slope hide one another a little: the limit that `LayeredScene` states.
    assert 0.15 < abs(slope) < 0.17
    assert float(shift.abs().max()) < 2.0 * abs(slope)


@pytest.mark.parametrize(
    ("textures", "said"),
    [
        (torch.ones(1, 1, 8, 8), "one channel a wavelength and the depth"),
        (torch.zeros(1, 2, 8, 8), "must be positive; its least is 0"),
    ],
)
def test_textures_without_a_depth_are_refused(textures, said):
    """Neither colours alone nor a depth of nothing is a scene."""
    with pytest.raises(InputError, match=said):
        LayeredScene((NEAR, FAR), GREEN).on_planes(textures)


def test_planes_go_from_near_to_far():
    """Compositing needs their order."""
    with pytest.raises(InputError, match="near to far"):
        LayeredScene((FAR, NEAR), GREEN)
    with pytest.raises(InputError, match="nearest and farthest"):
        LayeredScene.evenly_spaced(FAR, NEAR, 3, GREEN)
