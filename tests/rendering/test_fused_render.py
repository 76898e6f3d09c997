"""The fused renderer: the reference's image and gradients, with the reference's samples."""

import pytest
import torch
from torch.nn import functional

from dolens import load_lens
from dolens.errors import InputError
from dolens.kernels import rendering
from dolens.optics.rays import Rays, Status
from dolens.prescriptions import lens_from_prescription
from dolens.rendering.differentiable_geometry import differentiable_geometry
from dolens.rendering.exit_pupil import sampled_exit_pupil
from dolens.rendering.ray_renderer import PixelRays, RayRenderer
from dolens.scene.planar import PlanarScene
from dolens.sensor.pixels import Sensor

LINES = (656.2725, 587.5618, 486.1327)
SMALL = Sensor(9, 20, 0.0069)

# Tilted and decentred, with a rectangular stop and a spline: every kind of step behind one another.
POSED_LENS = {
    "name": "Tilted asphere and corrector",
    "surfaces": {
        "1": {"type": "conic", "radius": 40.0, "conic": -0.5, "semi_diameter": 9.0,
              "thickness": 5.0, "material": "1.5168/64.17"},
        "2": {"type": "even_asphere", "radius": -60.0, "a4": 1e-6, "a6": 1e-9,
              "semi_diameter": 9.0, "thickness": 3.0, "material": "air"},
        "3": {"type": "plane", "semi_diameter": 5.0, "thickness": 2.0, "material": "air"},
        "4": {"type": "xy_polynomial", "x2": 1e-4, "xy": 1e-5, "x3": 2e-5, "y3": -1e-5, "b": 0.03,
              "semi_diameter": 9.0, "thickness": 2.0, "material": "1.5168/64.17"},
        "5": {"type": "plane", "semi_diameter": 9.0, "material": "air"},
    },
    "stop": 3,
    "elements": {"corrector": {"surfaces": [4, 5], "tilt_x": 2.0, "decenter_y": 0.3}},
    "sensor": {"distance": 36.0},
}  # fmt: skip


def texture(size, images=1, channels=3, dtype=torch.float64):
    """Smooth, so that float32's coordinates do not decide which texel's slope is seen."""
    generator = torch.Generator().manual_seed(4)
    coarse = torch.rand(images, channels, size // 3, size // 3, generator=generator)
    return functional.interpolate(coarse.to(dtype), size=(size, size + 3), mode="bicubic")


@pytest.fixture(params=["wavefront_coding", "cooke_triplet", "large_fov_doublet", "posed"])
def any_lens(request, root):
    if request.param == "posed":
        return lens_from_prescription(POSED_LENS)
    lens = load_lens(root / "conf" / "lens" / f"{request.param}.yaml")
    if request.param == "wavefront_coding":
        with torch.no_grad():
            lens.surfaces["5"].x3.fill_(1.3e-5)
            lens.surfaces["5"].x2y.fill_(-4e-6)
            lens.surfaces["5"].y3.fill_(1.1e-5)
    return lens


def singlet(last: dict):
    """A lens whose last surface, the first that a renderer's rays meet, is given."""
    front = {"type": "sphere", "radius": 30.0, "semi_diameter": 6.0, "thickness": 4.0,
             "material": "1.5168/64.17"}  # fmt: skip
    back = {"type": "sphere", "radius": -60.0, "semi_diameter": 6.0, "thickness": 2.0,
            "material": "air"}  # fmt: skip
    surfaces = {"1": front, "2": back, "3": {"semi_diameter": 5.0, **last}}
    return lens_from_prescription(
        {"name": "Singlet", "surfaces": surfaces, "stop": 1, "sensor": {"distance": 36.0}}
    )


LAST_SURFACES = {
    "a stop in air": {"type": "plane", "material": "air"},
    "glass": {"type": "conic", "radius": -80.0, "conic": 0.3, "material": "1.62/60.0"},
    "hardly any refraction": {"type": "sphere", "radius": -40.0, "material": "1.002/20.0"},
    # Steep: blue is totally reflected at the rim before red is.
    "total reflection": {
        "type": "even_asphere",
        "radius": 14.0,
        "a4": 4e-4,
        "material": "1.9/17.0",
    },
}


@pytest.mark.parametrize("last", LAST_SURFACES)
def test_wavelengths_part_at_the_first_surface_they_meet(last):
    lens, scene = singlet(LAST_SURFACES[last]), PlanarScene([3000.0], LINES)
    for pitch in (0.0069, 0.6):
        compare(lens, RayRenderer(Sensor(9, 20, pitch), 5), scene, texture(40))
    if last == "total reflection":
        ended = []
        system, renderer = lens.system(), RayRenderer(Sensor(9, 20, 0.6), 5)
        pupil = sampled_exit_pupil(system, LINES, renderer.sensor)
        view = renderer._view(system, scene, (40, 43), 5, pupil)
        ray, _ = PixelRays(scene, renderer.sensor, view).samples(system, pupil, 0, 180)
        for wavelength in LINES:
            hit = lens.sensor_to_scene(Rays.from_components(ray, wavelength), first=3)
            ended.append(hit.status == Status.TIR)
        assert bool((ended[2] & ~ended[0]).any())


def image_and_gradients(lens, backend, renderer, scene, textures, weight, seed=5):
    """The image, and gradients of its weighted sum by name."""
    lens.backend = backend
    inputs = {"textures": textures.clone().requires_grad_(), **dict(lens.named_parameters())}
    image = renderer.render(lens, scene, inputs["textures"], seed)
    found = torch.autograd.grad((image * weight).sum(), list(inputs.values()))
    return image.detach(), dict(zip(inputs, found, strict=True))


def compare(lens, renderer, scene, textures):
    sensor = renderer.sensor
    shape = (len(textures), len(scene.depths), textures.shape[1], sensor.height, sensor.width)
    weight = torch.randn(shape, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    expected = image_and_gradients(lens, "reference", renderer, scene, textures, weight)
    found = image_and_gradients(lens, "cpu", renderer, scene, textures, weight)
    size = float(expected[0].abs().max())
    assert size > 0
    assert float((found[0] - expected[0]).abs().max()) < 1e-11 * size
    for name, gradient in expected[1].items():
        error = float((found[1][name] - gradient).abs().max())
        assert error <= 1e-10 * float(gradient.abs().max()), name


def test_image_and_gradients_are_the_reference_s(any_lens):
    # Far off the axis as well: some rays are vignetted, and neighbours of rays that fail count.
    wide = 0.6 * (any_lens.sensor_diameter or 10.0) / 20
    scene = PlanarScene((8000.0, 4500.0), LINES)
    compare(any_lens, RayRenderer(SMALL, 3), scene, texture(40, images=2))
    compare(any_lens, RayRenderer(Sensor(9, 20, wide), 3), scene, texture(40))


def test_pixels_may_be_sampled_at_their_centres(wavefront_coding):
    renderer = RayRenderer(SMALL, 4, pixel_area=False)
    compare(wavefront_coding(1e-5).requires_grad_(), renderer, PlanarScene([6000.0], LINES),
            texture(40))  # fmt: skip


@pytest.mark.parametrize("size", [(1, 1), (1, 5), (6, 1), (2, 2)])
def test_textures_of_a_texel_s_width_go_on_at_their_edge(wavefront_coding, size):
    generator = torch.Generator().manual_seed(2)
    textures = torch.rand(1, 1, *size, generator=generator, dtype=torch.float64)
    scene = PlanarScene([6000.0], LINES[:1])
    lens, renderer = wavefront_coding(1e-5), RayRenderer(SMALL, 2)
    images, gradients = [], []
    for backend in ("reference", "cpu"):
        lens.backend = backend
        inputs = textures.clone().requires_grad_()
        images.append(renderer.render(lens, scene, inputs, 0))
        gradients.append(torch.autograd.grad(images[-1].square().sum(), inputs)[0])
    assert torch.allclose(*images, rtol=1e-12, atol=0)
    assert torch.allclose(*gradients, rtol=1e-10, atol=1e-12)


def test_replayed_chunks_give_the_reference_s_estimate(wavefront_coding):
    lens = wavefront_coding(1e-5).requires_grad_()
    renderer = RayRenderer(SMALL, 3, chunk_rays=9 * 50, gradient_fraction=0.5)
    compare(lens, renderer, PlanarScene([8000.0], LINES), texture(40))


def test_single_precision_errs_no_more_than_the_reference(wavefront_coding):
    scene, renderer = PlanarScene((8000.0, 4500.0), LINES), RayRenderer(SMALL, 4)
    lens, textures = wavefront_coding(1e-5), texture(40)
    image = {}
    for dtype in (torch.float64, torch.float32):
        for backend in ("reference", "cpu"):
            lens.backend = backend
            image[dtype, backend] = renderer.render(lens.to(dtype), scene, textures, 3).double()
    true = image[torch.float64, "reference"]
    error = {b: float((image[torch.float32, b] - true).square().mean().sqrt())
             for b in ("reference", "cpu")}  # fmt: skip
    assert error["cpu"] < 1.3 * error["reference"] < 1e-3


def test_threads_and_repetition_change_no_bit(wavefront_coding):
    lens, scene = wavefront_coding(1e-5).requires_grad_(), PlanarScene([8000.0], LINES)
    renderer, textures = RayRenderer(Sensor(40, 40, 0.0069), 4), texture(60)
    weight = torch.ones(1, 1, 3, 40, 40, dtype=torch.float64)
    threads, results = torch.get_num_threads(), []
    try:
        for count in (1, 2, 3, 1):
            torch.set_num_threads(count)
            results.append(image_and_gradients(lens, "cpu", renderer, scene, textures, weight))
    finally:
        torch.set_num_threads(threads)
    for image, gradients in results[1:]:
        assert torch.equal(image, results[0][0])
        for name, gradient in gradients.items():
            assert torch.equal(gradient, results[0][1][name]), name


def test_a_gradient_of_the_textures_alone_needs_no_lens(wavefront_coding):
    lens, scene = wavefront_coding(1e-5), PlanarScene([8000.0], LINES)
    renderer, gradients = RayRenderer(SMALL, 3), []
    for backend in ("reference", "cpu"):
        lens.backend = backend
        inputs = texture(40).requires_grad_()
        image = renderer.render(lens, scene, inputs, 0)
        gradients.append(torch.autograd.grad(image.square().sum(), inputs)[0])
    assert torch.allclose(*gradients, rtol=1e-10, atol=1e-14)


def test_the_image_does_not_depend_on_the_chunks(wavefront_coding):
    lens, scene = wavefront_coding(1e-5), PlanarScene([8000.0], LINES)
    one, two = (RayRenderer(SMALL, 3, chunk_rays=n).render(lens, scene, texture(40), 0)
                for n in (100, 10_000))  # fmt: skip
    assert torch.allclose(one, two, rtol=1e-12, atol=0)


def test_traces_by_kernels_serve_where_no_renderer_is_fused(wavefront_coding):
    # What a GPU does: the reference's samples and lookup about a fused trace.
    lens, scene = wavefront_coding(1e-5), PlanarScene([8000.0], LINES)
    renderer, system = RayRenderer(SMALL, 3), lens.system()
    view = renderer._view(system, scene, (40, 43), 0, sampled_exit_pupil(system, LINES, SMALL))
    moving = differentiable_geometry(system, scene, view)
    rays, shown = PixelRays(scene, SMALL, view), scene.on_planes(texture(40))
    images = [
        rays.light(system.traced_by(backend), moving, shown, 0, 180)
        for backend in ("reference", "cpu")
    ]
    assert torch.allclose(*images, rtol=1e-11, atol=0)


def test_second_derivatives_are_an_error(wavefront_coding):
    lens = wavefront_coding(1e-5)
    lens.backend = "cpu"
    x3 = torch.tensor(1e-5, dtype=torch.float64, requires_grad=True)
    coded = lens.with_values({"surfaces.5.x3": x3})
    image = RayRenderer(SMALL, 2).render(coded, PlanarScene([8000.0], LINES), texture(40), 0)
    (gradient,) = torch.autograd.grad(image.square().sum(), x3, create_graph=True)
    with pytest.raises(InputError, match="first derivatives only"):
        torch.autograd.grad(gradient, x3)


def test_the_operators_are_what_pytorch_asks_of_one(wavefront_coding, monkeypatch):
    # Schema, shapes without data, and registration of the derivative.
    calls, lens = [], wavefront_coding(1e-5).requires_grad_()
    lens.backend, operator = "cpu", rendering.render

    def render(*arguments):
        calls.append(arguments)
        return operator(*arguments)

    monkeypatch.setattr(rendering, "render", render)
    RayRenderer(Sensor(3, 4, 0.0069), 2).render(lens, PlanarScene([6000.0], LINES), texture(12), 0)
    detached = [a.detach() if isinstance(a, torch.Tensor) else a for a in calls[0]]
    for index in (0, 1, 2, 3, 4):
        detached[index].requires_grad_()
    tests = ("test_schema", "test_faketensor", "test_autograd_registration")
    torch.library.opcheck(operator, tuple(detached), test_utils=tests)
