"""The renderer that chooses: what it predicts, what it picks, and how wrong that is."""

import functools
import logging
import math

import pytest
import torch
from scipy.integrate import dblquad

from dolens import load_lens
from dolens.diffraction.pixel_psf import diffraction_transfer, with_diffraction_limit
from dolens.diffraction.propagation import MOST_SAMPLES
from dolens.errors import InputError
from dolens.prescriptions import lens_from_prescription
from dolens.rendering.auto.auto_renderer import AutoRenderer
from dolens.rendering.auto.field_grid import psf_cost
from dolens.rendering.auto.probes import (
    GREY_LEVEL,
    grey_levels,
    probe_image,
    probe_power,
    probe_texture,
    reference,
)
from dolens.rendering.exit_pupil import ExitPupil, axial_exit_pupil
from dolens.rendering.imaging_system import ImagingSystem
from dolens.rendering.psf_grid import wave_cost
from dolens.rendering.psf_renderer import PsfRenderer
from dolens.rendering.ray_renderer import RayRenderer
from dolens.scene.planar import PlanarScene
from dolens.sensor.pixels import Sensor

LINES = (656.2725, 587.5618, 486.1327)


def coded(root, dtype=torch.float32):
    lens = load_lens(root / "conf/lens/wavefront_coding.yaml", dtype=dtype)
    with torch.no_grad():
        lens.surfaces["5"].x3.fill_(1.5e-5)
        lens.surfaces["5"].y3.fill_(1.5e-5)
    return lens.requires_grad_(False)


@pytest.fixture(scope="module")
def planned(root):
    """A renderer that has planned the same scene for a tolerance, with its choice; made once."""
    scene = PlanarScene((8000.0, 4500.0), LINES)

    @functools.cache
    def plan(tolerance):
        auto = AutoRenderer(Sensor(64, 64, 0.0069), tolerance)
        return auto, auto.make_plan(coded(root), scene)

    return plan


def measured(image, pair):
    """RMS error in grey levels of an image against the mean of two renders, without their noise."""
    noise = 0.25 * (pair[0] - pair[1]).square().mean()
    squared = (image - 0.5 * (pair[0] + pair[1])).square().mean() - noise
    return math.sqrt(max(float(squared), 0.0)) / GREY_LEVEL


def test_the_probe_has_the_power_that_is_said():
    image, side = probe_image(256, 256), 256
    assert float(image.min()) >= 0.0
    assert float(image.max()) <= 1.0
    power = probe_power(side)
    assert float(power[1:].sum() + power[0, 1:].sum()) == pytest.approx(0.2**2, rel=1e-12)
    # Clipping takes a few per cent of the contrast.
    assert float(image.std(dim=(-2, -1)).mean()) == pytest.approx(0.2, rel=0.05)


@pytest.mark.parametrize("shift", [(0, 1), (2, 1)])
def test_predicted_errors_are_those_on_the_probe(shift):
    # The error of moving an image by whole pixels, and of darkening it by one per cent.
    kernel = torch.zeros(7, 7, dtype=torch.float64)
    kernel[3, 3], kernel[3 + shift[0], 3 + shift[1]] = -1.0, 0.99
    image = probe_image(256, 256)
    moved = 0.99 * image.roll(shift, (-2, -1)) - image
    inner = moved[..., 8:-8, 8:-8]
    found = float(inner.square().mean().sqrt()) / GREY_LEVEL
    assert float(grey_levels(kernel)) == pytest.approx(found, rel=0.1)


def test_the_transfer_function_is_the_pupil_s_overlap_with_itself():
    # The area that two discs shifted by s diameters share, over a disc's, by quadrature.
    pitch, wavelength, f_number, side = 0.002, 500.0, 8.0, 16
    transfer = diffraction_transfer(side, side, pitch, wavelength, f_number)
    cutoff = 1.0 / (wavelength * 1e-6 * f_number)
    for row, column in ((1, 0), (3, 4), (0, 8)):
        s = math.hypot(row, column) / side / pitch / cutoff
        expected = 0.0
        if s < 1.0:
            half = math.sqrt(1.0 - s * s)
            area, _ = dblquad(
                lambda x, y: 1.0,
                -half,
                half,
                lambda y, s=s: s - math.sqrt(1.0 - y * y),
                lambda y, s=s: math.sqrt(1.0 - y * y) - s,
            )
            expected = area / math.pi
        assert float(transfer[row, column]) == pytest.approx(expected, abs=1e-9)


def test_a_point_becomes_an_airy_disc_of_unit_light():
    point = torch.zeros(1, 201, 201, dtype=torch.float64)
    point[0, 100, 100] = 1.0
    disc = with_diffraction_limit(point, 0.0004, [550.0], 8.0)[0]
    # 0.16 λN: finely sampled, so values are the irradiance at points: π/(4 λ² N²) at the centre.
    peak = math.pi * 0.0004**2 / (4.0 * (550e-6 * 8.0) ** 2)
    assert float(disc[100, 100]) == pytest.approx(peak, rel=0.03)
    # The first dark ring, at 1.22 λN or 13.42 pixels, and the light within it (Airy: 83.8 %).
    place = torch.arange(201.0) - 100.0
    radius = torch.hypot(place[:, None], place[None])
    assert float(disc[100, 113:115].max()) < 2e-3 * peak
    within = float(disc[radius < 13.42].sum())
    assert within == pytest.approx(0.838, abs=0.03)
    assert float(disc.sum()) == pytest.approx(1.0, abs=1e-12)
    # A window keeps all light.  Of it 2/(π²·r) would fall beyond the radius r in units of λN, and
    # beyond a square of half side 9.1 λN the mean of that over all azimuths: (4/π)·sin(π/4) of it.
    beyond = 2.0 / (math.pi**2 * 9.1) * (4.0 / math.pi) * math.sin(0.25 * math.pi)
    assert within == pytest.approx(0.838 / (1.0 - beyond), abs=3e-3)


@pytest.mark.parametrize("tolerance", [4.0, 1.0])
def test_the_plan_keeps_its_tolerance_against_independent_renders(root, planned, tolerance):
    lens, sensor = coded(root), Sensor(64, 64, 0.0069)
    scene = PlanarScene((8000.0, 4500.0), LINES)
    auto, choice = planned(tolerance)
    assert choice.error < tolerance
    # Another image, other samples.
    texture = probe_image(112, 112, seed=5)
    pair = [RayRenderer(sensor, 16).render(lens, scene, texture, seed)[0] for seed in (11, 12)]
    geometric = auto.without_diffraction()  # rays have none
    image = geometric.render(lens, scene, texture.float(), 3)[0]
    assert measured(image, pair) < 1.2 * tolerance


def test_without_variables_no_gradients_are_compared(planned):
    assert "auto/gradient_cosine" not in planned(4.0)[0].numbers()


def test_less_tolerance_costs_more(root, planned):
    lens = coded(root)
    scene, costs = PlanarScene((8000.0, 4500.0), LINES), []
    for tolerance in (4.0, 1.0, 0.25):
        _, choice = planned(tolerance)
        assert choice.renderer.model == PsfRenderer.model
        costs.append(psf_cost(choice.renderer, scene, len(lens.surfaces)))
    assert costs[0] < costs[1] < costs[2]


def test_a_scene_gets_no_more_than_it_needs(root):
    """A pinhole camera without dispersion: one function for all fields, depths and colours."""
    lens = lens_from_prescription(
        {
            "name": "Pinhole",
            "surfaces": {"1": {"type": "aperture", "semi_diameter": 0.02, "material": "occluder"}},
            "stop": 1,
            "sensor": {"distance": 20.0},
        },
        torch.float32,
    )
    choice = AutoRenderer(Sensor(64, 64, 0.1), 1.0, gradients=False).make_plan(
        lens, PlanarScene((4000.0, 1000.0), LINES)
    )
    renderer = choice.renderer
    assert renderer.model == PsfRenderer.model
    assert renderer.fields == (1, 1)
    assert (renderer.depths, renderer.colours) == ("one", "one")
    assert renderer.registration == "pinhole"


def test_colours_are_shared_for_images_but_not_for_gradients(root):
    lens, sensor = coded(root), Sensor(48, 48, 0.0069)
    scene = PlanarScene((8000.0,), LINES)
    chosen = [
        AutoRenderer(sensor, 4.0, gradients).make_plan(lens, scene).renderer.colours
        for gradients in (True, False)
    ]
    assert chosen == ["each", "one"]


def test_diffraction_is_modelled_where_it_shows(root):
    # The same lens, in focus, before a sensor of fine and one of coarse pixels.
    lens = load_lens(root / "conf/lens/wavefront_coding.yaml", dtype=torch.float32)
    with torch.no_grad():
        lens.sensor_distance.fill_(float(lens.first_order().bfd))
    scene = PlanarScene((1e7,), LINES[1:2])
    for pitch, models in ((0.002, ("limit", "wave")), (0.2, ("none",))):
        choice = AutoRenderer(Sensor(32, 32, pitch), 1.0).make_plan(lens, scene)
        assert choice.renderer.diffraction in models
    unasked = AutoRenderer(Sensor(32, 32, 0.002), 1.0, diffraction=False).make_plan(lens, scene)
    assert unasked.renderer.diffraction == "none"
    assert any("would change" in line for line in unasked.lines())


def test_a_wavefront_too_steep_for_waves_leaves_the_image_to_rays(root):
    """So many turns cross the pupil 40 mm out of focus, seen 1.5 m wide; no plan dies of it."""
    lens = load_lens(root / "conf/lens/cooke_triplet.yaml", dtype=torch.float64)
    system = lens.requires_grad_(False).system()
    scene, sensor = PlanarScene((100.0,), LINES[1:2]), Sensor(21, 21, 0.5)
    imaging = ImagingSystem(system, scene, sensor, axial_exit_pupil(system, LINES))
    points = tuple(torch.zeros(1, dtype=torch.float64) for _ in "xy")
    samples, reason = wave_cost(imaging, points, 3001, True)
    assert samples == MOST_SAMPLES
    assert "too steep for diffraction" in reason


def test_the_plan_is_kept_logged_and_counted(root, caplog):
    lens, sensor = coded(root), Sensor(32, 32, 0.0069)
    scene = PlanarScene((8000.0,), LINES)
    auto = AutoRenderer(sensor, 2.0)
    assert auto.rays_per_image(scene) == 0
    texture = probe_image(64, 64).float()
    with caplog.at_level(logging.INFO, logger="dolens"):
        first = auto.render(lens, scene, texture, 1)
    choice = auto.choice
    assert "fields" in caplog.text
    assert "pupil samples" in caplog.text
    assert "auto/error_grey_levels" in choice.numbers()
    assert auto.rays_per_image(scene) > 0
    again = auto.render(lens, scene, texture, 1)
    assert auto.choice is choice
    assert torch.equal(first, again)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_the_image_and_its_gradient_come_in_the_lens_s_precision(root, dtype):
    lens, scene = coded(root, dtype), PlanarScene((8000.0,), LINES)
    auto = AutoRenderer(Sensor(24, 24, 0.0069), 2.0)
    x3 = torch.tensor(1.5e-5, dtype=dtype, requires_grad=True)
    texture = probe_image(56, 56).to(dtype)
    image = auto.render(lens.with_values({"surfaces.5.x3": x3}), scene, texture, 1)
    (slope,) = torch.autograd.grad(image.square().sum(), x3)
    assert image.dtype == slope.dtype == dtype
    assert float(slope) != 0.0


def test_the_reference_says_how_well_it_knows(root):
    lens, sensor = coded(root), Sensor(48, 48, 0.0069)
    scene, texture = PlanarScene((8000.0,), LINES), probe_image(96, 96)
    coarse, fine = (
        reference(RayRenderer(sensor, n), lens, scene, texture, seed=n) for n in (4, 16)
    )
    assert fine.noise < 0.4 * coarse.noise
    # An image that is as noisy as one of the renders errs by that noise.
    image = RayRenderer(sensor, 4).render(lens, scene, texture, 99)
    assert fine.error(image) == pytest.approx(math.sqrt(2.0) * coarse.noise, rel=0.1)


def test_a_photograph_of_the_user_s_is_a_probe_as_well(root):
    """Black and white stripes have more contrast than the built-in probes: the plan errs more, by
    what an independent render says.
    """
    lens, sensor = coded(root), Sensor(32, 32, 0.0069)
    scene = PlanarScene((6000.0,), LINES)
    stripes = (torch.arange(96) // 8 % 2).double().expand(1, 3, 96, 96)
    errors = []
    for photographs in (None, stripes):
        auto = AutoRenderer(sensor, 4.0, gradients=False, diffraction=False)
        auto.prepare(lens, scene, photographs=photographs)
        errors.append(auto.choice.error)
    assert errors[1] > 1.05 * errors[0]
    # Functions of the seed that they were tried with: few samples make others err otherwise.
    image = auto.choice.renderer.render(lens, scene, stripes, 1)
    pair = [RayRenderer(sensor, 40).render(lens, scene, stripes, 31 + i) for i in range(2)]
    assert errors[1] == pytest.approx(measured(image, pair), rel=0.15)


def test_a_plan_is_made_for_the_stop_as_it_is_varied(root):
    """A semi-diameter is among the values of a lens, though no parameter of it."""
    lens, scene = coded(root), PlanarScene((6000.0,), LINES)
    radius = torch.tensor(0.5 * lens.surfaces["1"].semi_diameter, dtype=lens.dtype)
    values = {"surfaces.1.semi_diameter": radius, "surfaces.5.x3": torch.zeros_like(radius)}
    smaller = lens.with_values(values).storing_its_values()
    assert smaller.surfaces["1"].semi_diameter == float(radius)
    assert lens.surfaces["1"].semi_diameter == pytest.approx(2.0 * float(radius))
    auto = AutoRenderer(Sensor(16, 16, 0.0069), 4.0, gradients=False, diffraction=False)
    auto.prepare(lens.with_values(values), scene)
    assert auto.choice.error < 4.0


def test_photographs_of_any_size_fit_the_probe():
    sensor = Sensor(10, 20, 0.01)
    for height, width in ((5, 200), (200, 5)):
        image = torch.linspace(0.0, 1.0, height * width).reshape(1, 1, height, width)
        found = probe_texture(sensor, 3, 0, image.expand(1, 3, -1, -1))
        assert found.shape == (3, 3, 74, 84)
        assert torch.equal(found[:2], probe_texture(sensor, 3, 0))
        # Its middle lies in the middle.
        middle = image[0, 0, height // 2, width // 2].double()
        assert float(found[2, 0, 37, 42]) == pytest.approx(float(middle))


def test_a_tolerance_must_be_positive():
    with pytest.raises(InputError, match="tolerance"):
        AutoRenderer(Sensor(4, 4, 0.01), 0.0)


SETTINGS = {"fields": [2, 3], "size": 21, "pupil": [10.0, 2.5, 2.0]}
OLDER_STATES = {
    "of a whole sensor": {
        "model": "psf", "settings": SETTINGS, "bits": 64, "error": 0.5, "uncertainty": 0.1
    },
    "of windows": {"settings": SETTINGS, "errors": {"axis": 0.5, "edge": 0.2}, "uncertainty": 0.1},
}  # fmt: skip


@pytest.mark.parametrize("state", OLDER_STATES.values(), ids=OLDER_STATES.keys())
def test_plans_of_older_checkpoints_are_taken_up(root, state):
    sensor = Sensor(16, 16, 0.0069)
    auto = AutoRenderer(sensor).load_state(coded(root), state)
    pupil = ExitPupil(10.0, 2.5, 2.0)
    assert auto.choice.renderer == PsfRenderer(sensor, (2, 3), size=21, pupil=pupil)
    assert auto.choice.error == 0.5
    assert auto.choice.dtype == (torch.float64 if "bits" in state else torch.float32)
    assert auto.state()["settings"]["fields"] == [2, 3]


@pytest.mark.parametrize(
    "change", [{"model": "wavelets"}, {"settings": {"rings": 3}}, {"bits": 16}]
)
def test_a_plan_that_cannot_be_read_is_one_line_that_says_what_can(root, change):
    state = OLDER_STATES["of a whole sensor"] | change
    with pytest.raises(InputError, match=r"cannot be read .* allowed: psf, rays") as error:
        AutoRenderer(Sensor(16, 16, 0.0069)).load_state(coded(root), state)
    assert "\n" not in str(error.value)
