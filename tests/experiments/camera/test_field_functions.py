"""A restorer is told the function of each image's own place: it is what the lens does there."""

import math

import pytest
import torch

from dolens.experiments.camera.as_built import AsBuilt, Manufacture
from dolens.experiments.camera.evaluation import restored_by_rivals
from dolens.experiments.camera.made_lenses import images_of_made_lenses
from dolens.experiments.camera.views.base import Shot
from dolens.experiments.camera.views.fields import FieldViews
from dolens.experiments.camera.views.truth import field_functions
from dolens.experiments.commands.apply import apply_run
from dolens.experiments.commands.apply_options import Options
from dolens.reconstruction import WienerTVRestoration, psnr_db
from dolens.rendering.psf_renderer import PsfRenderer
from dolens.rendering.ray_renderer import RayRenderer
from dolens.scene.planar import PlanarScene
from dolens.sensor.colour import srgb_to_linear
from dolens.sensor.display import write_picture
from dolens.sensor.pixels import Sensor
from dolens.sensor.readout import Readout
from tests.experiments.camera.test_field_views import LINES, WHOLE, doublet
from tests.experiments.conftest import finished_run
from tests.experiments.runs import Finished
from tests.experiments.tiny_experiment import ONE_EPOCH, TINY_DOUBLET, UNPICTURED

ZONE = {"0.5": 0.5}
# Blur of some four pixels, whole in its window; test images as sharp in noise as functions are.
COARSE = (
    *(o for o in TINY_DOUBLET if not o.startswith("evaluation_renderer")),
    "views.sensor={height: 400, width: 400, pixel_pitch: 0.08}",
    "psf_size=21",
    "renderer.sensor.height=48",
    "renderer.sensor.width=48",
    "data.margin=24",
)
GENERAL = (*(o for o in COARSE if not o.startswith("network")),)


def views_of(size, truth):
    """Windows whose middle 8 pixels are all that a function of `size` pixels tells of."""
    window = Sensor(size + 7, size + 7, WHOLE.pixel_pitch)
    return FieldViews(
        PlanarScene((1e5,), LINES),
        WHOLE,
        PsfRenderer(window, (1, 1), 24, size),
        Readout(),
        evaluation_renderer=RayRenderer(window, 24),
        zones=ZONE,
        truth=truth,
    )


def smooth(side, seed=0, cell=6):
    """A texture (1, 3, side, side) without detail that pixels and texels would blur."""
    generator = torch.Generator().manual_seed(seed)
    coarse = torch.rand(1, 3, *[-(-side // cell)] * 2, generator=generator)
    return torch.nn.functional.interpolate(coarse, (side, side), mode="bicubic").clamp(0.0, 1.0)


def convolved(truth, function):
    """Σ PSF(e)·S(p - e), where all of it is known."""
    flipped = function.flip(-2, -1)[:, None].to(truth)
    return torch.nn.functional.conv2d(truth[None], flipped, groups=3)[0]


def grey_levels(error):
    return float(255.0 * error.square().mean().sqrt())


@pytest.mark.parametrize("number", [0, 1, 3])
@pytest.mark.parametrize(
    ("truth", "size", "most"),
    [("chief_rays", 21, 1.5), ("centroids", 21, 1.5), ("pinhole", 41, 5.0)],
)
def test_an_image_is_its_truth_convolved_with_the_function_of_its_place(
    root, truth, size, most, number
):
    """Windows at azimuths of their own, and one anywhere, against rays.

    A pinhole's truth lacks the distortion, of which the function has the shift of the middle only.
    """
    lens, views = doublet(root), views_of(size, truth)
    taken = views.take(lens, Shot(smooth(size + 87), "test", number))
    functions = views.functions_of_images(lens, taken, "test")
    assert functions.shape == (2, 1, 3, size, size)
    (of_zone,) = views.point_spread_functions(lens)
    inner = slice(size // 2, -(size // 2))
    for view, own in enumerate(functions[:, 0]):
        seen, true = taken.raw[0, view, :, inner, inner], srgb_to_linear(taken.truth[0, view])
        error = grey_levels(convolved(true, own) - seen)
        assert error < most
        assert grey_levels(convolved(true, of_zone) - seen) > 2.5 * error


def test_coma_lateral_colour_and_light_are_in_the_function_and_distortion_is_not(root):
    lens = doublet(root)
    half = 0.5 * math.hypot(WHOLE.height, WHOLE.width) * WHOLE.pixel_pitch
    along = torch.tensor([0.0, 0.7, 0.7], dtype=torch.float64) * half
    angle = torch.tensor([0.0, 0.4, 2.5], dtype=torch.float64)
    points = along * torch.cos(angle), along * torch.sin(angle)
    offset = torch.arange(21.0) - 10.0

    def centroids(truth):
        """Rows and columns (2, 3 places, 3 colours) of the light, from the middle; and light."""
        found = field_functions(lens, PlanarScene((1e5,), LINES), WHOLE, points, truth, 21, "none")
        functions = found.functions[:, 0]
        assert torch.allclose(functions.sum((-2, -1)), torch.ones(3, 3), atol=1e-5)
        moments = [(functions * p).sum((-2, -1)) for p in (offset[:, None], offset)]
        return torch.stack(moments), found.light

    by_chief_rays, light = centroids("chief_rays")
    assert by_chief_rays[:, 0].abs().max() < 0.02  # on the axis
    assert torch.allclose(light[0], torch.ones(3), atol=0.01)
    assert light[1].max() < 0.8
    # Coma moves the light along the radius, which lies at the places' own azimuths: rows grow with
    # y, and columns against x.
    radius = torch.stack((torch.sin(angle), -torch.cos(angle))).float()
    moved = (by_chief_rays[:, :, 1] * radius).sum(0)[1:]
    across = (by_chief_rays[:, :, 1] * torch.stack((radius[1], -radius[0]))).sum(0)[1:]
    assert moved.abs().min() > 10 * across.abs().max()
    assert moved.abs().min() > 0.1
    assert torch.allclose(moved[0], moved[1], atol=0.02)
    lateral = ((by_chief_rays[:, :, 0] - by_chief_rays[:, :, 2]) * radius).sum(0)[1:]
    assert lateral.abs().min() > 0.8
    # A calibration by centroids has coma's shift, at the reference wavelength, in the truth.
    by_centroids, _ = centroids("centroids")
    assert by_centroids[:, :, 1].abs().max() < 0.02
    assert torch.allclose(
        by_centroids[:, 1:, 0] - by_centroids[:, 1:, 2],
        by_chief_rays[:, 1:, 0] - by_chief_rays[:, 1:, 2],
        atol=0.02,
    )


@pytest.mark.parametrize("diffraction", ["none", "limit"])
@pytest.mark.parametrize("truth", ["chief_rays", "centroids", "pinhole"])
def test_functions_are_differentiable_in_the_lens(root, truth, diffraction):
    """Against differences, in parameters that move coma, lateral colour, focus and distortion."""
    lens = doublet(root).double()
    names = [*(f"surfaces.{n}.curvature" for n in (1, 2, 3)), "thicknesses.3", "sensor_distance"]
    start = {name: value.detach().clone() for name, value in lens.variables(names).items()}
    points = tuple(torch.tensor(p, dtype=torch.float64) for p in ([10.0, -6.0], [3.0, 9.0]))
    weight = smooth(41)[0].double()

    def total(values):
        found = field_functions(
            lens.with_values(values),
            PlanarScene((1e5,), LINES),
            WHOLE,
            points,
            truth,
            41,
            diffraction,
        )
        return (found.functions * found.light[:, None, :, None, None] * weight).sum()

    values = {name: value.clone().requires_grad_() for name, value in start.items()}
    gradient = torch.autograd.grad(total(values), list(values.values()))
    for (name, value), found in zip(start.items(), gradient, strict=True):
        step = 1e-4 * abs(float(value))
        with torch.no_grad():
            ends = [float(total({**start, name: value + s})) for s in (step, -step)]
        assert float(found) == pytest.approx((ends[0] - ends[1]) / (2.0 * step), rel=2e-3), name


def test_untrained_restorers_are_told_the_function_of_each_image(made):
    """Whatever the camera's own network is told, and in windows anywhere too."""
    module = made(*COARSE)
    views, values, rival = module.views, module.variables(), WienerTVRestoration()
    textures = torch.cat([smooth(200, seed)[..., :120, :120] for seed in (1, 2)])
    with torch.no_grad():
        taken, told = module.take(values, Shot(textures, "test", 1))
        assert told is None
        found = restored_by_rivals(module, taken, told, values)["tv"]
        functions = views.functions_of_images(module.lens.with_values(values), taken, "test")
        noise = torch.tensor(views.readout.noise)
        restored = [
            rival(raw[None], own, None, noise)
            for raw, own in zip(taken.raw.flatten(0, 1), functions, strict=True)
        ]
        assert torch.allclose(found.flatten(0, 1), torch.cat(restored), atol=1e-6)
        of_zones = views.point_spread_functions(module.lens.with_values(values))
        gains = []
        for view in range(1, 5):
            wrong = rival(taken.raw[:, view], of_zones[min(view, 3)][None], None, noise)
            pair = (psnr_db(f, taken.truth[:, view]) for f in (found[:, view], wrong))
            gains.append(float((next(pair) - next(pair)).mean()))
    assert min(gains) > 1.0


def test_images_of_made_lenses_are_restored_by_their_own_functions(made):
    module = made(*GENERAL)
    values, batch = module.variables(), smooth(96).expand(2, -1, -1, -1)
    given = {"surfaces.1.curvature": {"half_range": 0.02, "relative": True}}
    found = {}
    for calibration in ("design", "own"):
        settings = AsBuilt(calibration=calibration, lenses_per_step=2)
        manufacture = Manufacture(settings, given, module.lens, module.views)
        with torch.no_grad():
            lenses = manufacture.for_step(module.lens.with_values(values), 0)
            taken, functions = images_of_made_lenses(
                module, manufacture, lenses, values, batch, None
            )
            for number, lens in enumerate(lenses):
                of = values if calibration == "design" else lens.values
                own = module.views.functions_of_images(module.lens.with_values(of), taken, "train")
                assert torch.allclose(functions[number], own[number : number + 1], atol=2e-5)
        found[calibration] = torch.cat(functions)
    assert (found["design"] - found["own"]).abs().max() > 1e-3


def test_the_loss_behind_a_restorer_that_is_told_functions_is_differentiable(made):
    """Images, truths and what the restorer is told move with the lens, against differences."""
    module = made(*GENERAL, "lens_dtype=float64", "renderer.pupil_samples=32", "readout=ideal")
    module.network.double()
    textures, scaled = smooth(96, cell=4).double().expand(2, -1, -1, -1), module.variables.scaled

    def loss(at, told=None):
        scaled.data.copy_(at)
        taken, functions = module.take(module.variables(), Shot(textures, "train", 0))
        restored = module.restore(taken, functions if told is None else told)
        return (restored - taken.truth).square().mean(), functions

    start, step = scaled.detach().clone(), 0.02
    value, functions = loss(start)
    (gradient,) = torch.autograd.grad(value, scaled)
    (held,) = torch.autograd.grad(loss(start, functions.detach())[0], scaled)
    with torch.no_grad():
        shifts = step * torch.eye(len(start), dtype=start.dtype)
        ends = [[float(loss(start + sign * shift)[0]) for sign in (1, -1)] for shift in shifts]
    differences = torch.tensor([(a - b) / (2.0 * step) for a, b in ends], dtype=start.dtype)
    assert (gradient - differences).norm() < 0.02 * differences.norm()
    # With what is told held, it would be another derivative.
    assert (held - differences).norm() > 0.2 * differences.norm()


def test_wrong_calibrations_of_places_are_refused(refused):
    refused("miscalibrations: depth, ", *GENERAL, "miscalibrations=wrong")


@pytest.fixture(scope="module")
def field_run(root, tmp_path_factory):
    """The folder of a run whose sensor has 120 by 120 pixels, twice as large as functions tell."""
    return finished_run(
        root,
        tmp_path_factory.mktemp("field"),
        *GENERAL,
        *(ONE_EPOCH, UNPICTURED),
        "learning_rates.optics=0.1",
    )


def test_a_field_camera_trains_its_lens_through_a_held_restorer(field_run):
    metrics = Finished(field_run).metrics
    for zone in ("", "/axis", "/0.5", "/0.7", "/full", "/field", "/worst"):
        for name in ("psnr_db", "tv_psnr_db"):
            assert math.isfinite(metrics[f"test/{name}{zone}"])
        assert metrics[f"test/psnr_db{zone}"] > metrics[f"test/raw_psnr_db{zone}"]
    initial, final = (
        (field_run / f"lens/{name}.yaml").read_text() for name in ("initial", "final")
    )
    assert initial != final


def test_a_whole_picture_is_restored_by_place(field_run, tmp_path):
    write_picture(tmp_path / "a.png", smooth(96, cell=5)[0], 16)
    found = {}
    for window in (64, 448):
        options = Options(window=window, bits=16)
        _, camera, (applied,) = apply_run(field_run, [tmp_path / "a.png"], options, out=tmp_path)
        assert f"windows of {window} pixels, each" in camera.where
        found[window] = applied.metrics
    # In the larger window the function of the sensor's middle is told of all places.
    assert found[64]["psnr_db"] > found[448]["psnr_db"] + 1.0
    assert found[64]["psnr_db"] > found[64]["raw_psnr_db"] + 2.0
