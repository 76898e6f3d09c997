"""A large sensor seen through windows: where they lie, and that what they show is what is there."""

import math

import pytest
import torch
import yaml

from dolens.errors import InputError
from dolens.experiments.camera.views.base import Shot
from dolens.experiments.camera.views.fields import FieldViews
from dolens.prescriptions import lens_from_prescription
from dolens.rendering.auto.probes import probe_image
from dolens.rendering.psf_renderer import PsfRenderer
from dolens.rendering.ray_renderer import RayRenderer
from dolens.scene.planar import PlanarScene
from dolens.sensor.colour import srgb_to_linear
from dolens.sensor.pixels import Sensor
from dolens.sensor.readout import Readout
from tests.experiments.tiny_experiment import FIXED_WINDOWS, ONE_EPOCH, TINY_DOUBLET

LINES = (656.2725, 587.5618, 486.1327)
WHOLE = Sensor(400, 500, 0.08)


def field_views(renderer=None, **settings):
    renderer = renderer or PsfRenderer(Sensor(32, 40, 0.08), (1, 1), 24, 15)
    return FieldViews(PlanarScene((1e5,), LINES), WHOLE, renderer, Readout(), **settings)


def doublet(root, stop=None):
    prescription = yaml.safe_load((root / "conf/lens/large_fov_doublet.yaml").read_text())
    if stop is not None:
        prescription["surfaces"]["4"]["semi_diameter"] = stop
    return lens_from_prescription(prescription, torch.float32).requires_grad_(False)


def test_zones_lie_at_their_shares_of_the_half_diagonal():
    views = field_views()
    half = 0.5 * math.hypot(WHOLE.height, WHOLE.width)
    for number in range(9):
        windows = views._shown("test", number)
        shares = [math.hypot(w.centre_row, w.centre_column) / half for w in windows[:-1]]
        assert shares[0] < 0.01
        assert shares[1] == pytest.approx(0.5, abs=0.01)
        # As far as a window reaches: its outer corner is the sensor's.
        assert shares[3] == pytest.approx(1.0 - math.hypot(32, 40) / (2 * half), abs=0.01)


@pytest.mark.parametrize(("kind", "power"), [("circle", 2.0), ("radius", 1.0)])
def test_training_windows_are_at_all_distances(kind, power):
    """Even in the distance's square, the area of a circle, or in the distance itself."""
    views = field_views(training_windows=kind)
    reach = 0.5 * math.hypot(WHOLE.height - 32, WHOLE.width - 40)
    windows = [views._shown("train", number)[0] for number in range(400)]
    distance = [math.hypot(w.centre_row, w.centre_column) / reach for w in windows]
    shares = torch.tensor(distance) ** power
    # Uniform from 0 to 1, to three standard errors.
    assert float(shares.max()) <= 1.01
    assert abs(float(shares.mean()) - 0.5) < 3 * math.sqrt(1 / 12 / 400)
    assert float(shares.std()) == pytest.approx(math.sqrt(1 / 12), rel=0.1)
    # On all sides.
    for name in ("centre_row", "centre_column"):
        signs = torch.tensor([getattr(w, name) > 0 for w in windows]).double()
        assert abs(float(signs.mean()) - 0.5) < 3 * math.sqrt(0.25 / 400)


def test_training_windows_fill_the_field():
    views = field_views(training_windows="area")
    windows = [views._shown("train", number)[0] for number in range(400)]
    rows = torch.tensor([w.centre_row for w in windows]) / (WHOLE.height - 32)
    columns = torch.tensor([w.centre_column for w in windows]) / (WHOLE.width - 40)
    for places in (rows, columns):
        assert float(places.abs().max()) <= 0.5
        # Uniform over a side: mean 0 and deviation √(1/12), to three standard errors.
        assert abs(float(places.mean())) < 3 * math.sqrt(1 / 12 / 400)
        assert float(places.std()) == pytest.approx(math.sqrt(1 / 12), rel=0.1)


def test_the_truth_is_registered_with_what_the_lens_shows(root):
    """A stop of a hundredth: a pinhole camera with the doublet's distortion, sharp everywhere."""
    lens = doublet(root, stop=0.05)
    texture = probe_image(64, 72, seed=2).float()
    views = field_views(RayRenderer(Sensor(32, 40, 0.08), 8))
    taken = views.take(lens, Shot(texture, "test", 1))
    assert taken.raw.shape == taken.truth.shape == (1, 5, 3, 32, 40)
    truth = srgb_to_linear(taken.truth)
    light = taken.raw.mean((-2, -1), keepdim=True) / truth.mean((-2, -1), keepdim=True)
    error = (taken.raw / light - truth)[:, :, 1]
    # Green, free of lateral colour: what is left are the pixel's box and a tenth of a pixel.
    contrast = (truth[:, :, 1] - truth[:, :, 1].mean((-2, -1), keepdim=True)).square().mean()
    assert float(error.square().mean((0, 2, 3)).max()) < 0.1 * float(contrast)
    # One pixel off would be three times as bad at least.
    moved = (taken.raw / light).roll(1, -1)[:, :, 1] - truth[:, :, 1]
    inner = (..., slice(2, -2), slice(2, -2))
    assert float(moved[inner].square().mean()) > 3.0 * float(error[inner].square().mean())


def test_functions_and_rays_show_the_same(root):
    lens, texture = doublet(root), probe_image(72, 80, seed=3).float()
    sensor = Sensor(32, 40, 0.08)
    by_rays, by_functions = (
        field_views(renderer).take(lens, Shot(texture, "test", 0)).raw
        for renderer in (RayRenderer(sensor, 24), PsfRenderer(sensor, (2, 2), 24, 21))
    )
    error = (by_rays - by_functions).square().mean((0, 2, 3, 4)).sqrt() * 255
    assert float(error.max()) < 1.0


def test_every_pixel_knows_its_place_in_the_field(root):
    taken = field_views().take(doublet(root), Shot(probe_image(72, 80).float(), "test", 0))
    radius = taken.field.norm(dim=2)
    assert float(radius[0, 0].max()) < 0.1
    assert float(radius.max()) == pytest.approx(1.0, abs=0.01)


def test_the_same_index_gives_the_same_views(root):
    lens, texture, views = doublet(root), probe_image(72, 80).float(), field_views()
    one, again, other = (views.take(lens, Shot(texture, "train", i)).raw for i in (4, 4, 5))
    assert torch.equal(one, again)
    assert not torch.equal(one, other)


def test_a_lens_moves_by_what_windows_show(root):
    lens, texture = doublet(root), probe_image(72, 80).float()
    curvature = lens.surfaces["1"].curvature.detach().clone().requires_grad_()
    taken = field_views().take(
        lens.with_values({"surfaces.1.curvature": curvature}), Shot(texture, "train", 0)
    )
    (slope,) = torch.autograd.grad(taken.raw.square().mean(), curvature)
    assert math.isfinite(float(slope))
    assert float(slope) != 0.0
    # The truth is what chief rays see: it moves with the lens, and says so.
    assert taken.truth.requires_grad


def test_image_and_truth_move_together(root):
    """Against differences of images by rays, whose truth moves with the lens as distortion does."""
    lens = doublet(root).double()
    texture = probe_image(96, 104, seed=5).double().expand(3, -1, -1, -1)
    sensor = Sensor(32, 40, 0.08)
    # At the middle and at half the field, and once anywhere.
    zones = {"axis": 0.0, "0.5": 0.5}
    by_rays = field_views(RayRenderer(sensor, 20), zones=zones)
    by_functions = field_views(PsfRenderer(sensor, (2, 2), 32, 21), zones=zones)
    start = lens.surfaces["1"].curvature.detach().clone()

    def loss(views, curvature):
        taken = views.take(
            lens.with_values({"surfaces.1.curvature": curvature}), Shot(texture, "test", 0)
        )
        return (taken.raw - srgb_to_linear(taken.truth)).square().mean()

    h = 2e-4
    wanted = float(loss(by_rays, start + h) - loss(by_rays, start - h)) / (2.0 * h)
    curvature = start.requires_grad_()
    (found,) = torch.autograd.grad(loss(by_functions, curvature), curvature)
    (of_rays,) = torch.autograd.grad(loss(by_rays, curvature), curvature)
    assert float(found) == pytest.approx(wanted, rel=0.08)
    assert float(of_rays) == pytest.approx(wanted, rel=0.08)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"zones": {"far": 1.5}}, "zones.far"),
        ({"training_windows": "corners"}, "training_windows"),
        ({"renderer": PsfRenderer(Sensor(32, 32, 0.01))}, "pixel_pitch"),
        ({"renderer": PsfRenderer(Sensor(500, 32, 0.08))}, "larger"),
    ],
)
def test_settings_out_of_range_are_errors(settings, message):
    with pytest.raises(InputError, match=message):
        field_views(**settings)


@pytest.mark.parametrize("discriminator", ["none", "double_scale"])
def test_the_experiment_runs_whole(trained, discriminator):
    judged = f"discriminator={discriminator}"
    found = trained(*TINY_DOUBLET, *FIXED_WINDOWS, judged, ONE_EPOCH)
    metrics = found.metrics
    for zone in ("axis", "0.5", "0.7", "full", "field"):
        assert math.isfinite(metrics[f"test/psnr_db/{zone}"])
    assert metrics["operand/edge_thickness/1"] > 0.0
    assert ("train/adversarial" in metrics) == (discriminator == "double_scale")
    # The focal length is held by the last curvature.
    assert float(found.lens().first_order().efl) == pytest.approx(67.57969, rel=1e-5)
    assert "images" in found.figures
