"""The bank of point spread functions that a restorer for any lens is trained with."""

import math

import pytest
import torch
from torch import Tensor

import dolens
from dolens.diffraction.pixel_psf import quadratic_b_spline
from dolens.diffraction.pupil_fit import regular_pupil
from dolens.errors import InputError
from dolens.experiments.pretraining import pixel_functions as module
from dolens.experiments.pretraining.pixel_functions import pixel_functions
from dolens.experiments.pretraining.random_cameras import cameras, function_bank
from dolens.experiments.pretraining.random_pupils import (
    GREEN,
    HELD_OUT,
    Draw,
    FormulaOptics,
    Prescriptions,
    fitted_pupils,
    within_tolerances,
)
from dolens.files import packaged_configuration
from dolens.rendering.imaging_system import ImagingSystem
from dolens.rendering.psf_renderer import PsfRenderer
from dolens.scene.planar import PlanarScene
from dolens.sensor.pixels import Sensor


def _flat(x: Tensor, y: Tensor) -> Tensor:
    return torch.zeros_like(x)


def _achromatic(wave: float) -> float:
    return 0.0


@pytest.fixture(scope="module")
def bank() -> list:
    return list(cameras(16, torch.Generator().manual_seed(3)))


def test_functions_have_unit_sum_and_lie_about_the_middle(bank):
    square = (torch.arange(65.0) - 32.0).square()
    for camera in bank:
        assert camera.functions.shape == (3, 3, 65, 65)
        assert float(camera.functions.min()) >= 0.0
        torch.testing.assert_close(camera.functions.sum((-2, -1)), torch.ones(3, 3))
        spread = (camera.functions * (square[:, None] + square)).sum((-2, -1)).sqrt()
        # A pixel's own: 1/4 px² along each side.
        assert math.sqrt(0.5) < float(spread.min()) < float(spread.max()) < 14.001, camera.name


def test_a_seed_gives_the_same_cameras_again(bank):
    functions, names = function_bank(3, torch.Generator().manual_seed(3))
    assert functions.dtype == torch.float16
    assert names == [camera.name for camera in bank[:3]]
    assert torch.equal(functions, torch.stack([c.functions for c in bank[:3]]).half())
    _, others = function_bank(1, torch.Generator().manual_seed(4))
    assert others[0] != names[0]


def test_lenses_that_judge_are_not_in_the_bank():
    folder = packaged_configuration() / "lens"
    for name in HELD_OUT:
        assert (folder / f"{name}.yaml").is_file()
    used = set(Prescriptions().files)
    assert len(used) > 60
    assert used.isdisjoint(HELD_OUT)
    for name in used:
        # Zoom lenses that reach the telephoto range are of another form.
        content = (folder / f"{name}.yaml").read_text(encoding="utf-8").lower()
        assert "telephoto" not in content.replace("telephoto zoom", ""), name


def test_no_cameras_are_refused():
    with pytest.raises(InputError, match="count: 0; allowed: at least 1 camera"):
        next(cameras(0, torch.Generator()))


@pytest.mark.parametrize(
    ("file", "field"),
    [("cooke_triplet", (6.0, 10.0)), ("published/wide_us20130321936_ex3", (10.0, 10.0))],
)
def test_a_lens_has_the_functions_that_its_renderer_has(file, field):
    waves, pitch = (620.0, 540.0, 460.0), 4e-3
    lens = dolens.load_lens(packaged_configuration() / "lens" / f"{file}.yaml", dtype=torch.float64)
    twice = [wave for wave in waves for _ in range(2)]
    fit = fitted_pupils(lens, field, twice, lateral_colour=False)
    assert fit is not None
    functions, held = pixel_functions(lambda samples: regular_pupil(fit, samples), [0.0], pitch)
    assert held > 0.97
    x, y = (fit.wavefront.centre[2] / pitch).tolist()
    sensor = Sensor(1, 1, pitch, centre_row=y, centre_column=-x)
    imaging = ImagingSystem.of(lens.system(), PlanarScene((1e8,), waves), sensor)
    renderer = PsfRenderer(sensor, (1, 1), 32, 65, jitter=False, diffraction="wave")
    expected = renderer.point_spread_functions(imaging, 0).functions[0, 0]
    expected = expected / expected.sum((-2, -1), keepdim=True)
    expected = expected.detach()
    off = (functions[0, ::2] - expected).abs().sum((-2, -1))
    mirrored = (functions[0, ::2] - expected.flip(-1)).abs().sum((-2, -1))
    # Its chief rays pass the middle of the exit pupil, these the middle of the stop.
    assert float(off.max()) < 0.03
    assert float(mirrored.min()) > 0.2


def test_tolerances_change_a_lens_and_leave_the_bank_s_as_it_is():
    lens = dolens.load_lens(packaged_configuration() / "lens" / "quartet.yaml")
    before = {name: value.clone() for name, value in lens.state_dict().items()}
    made = within_tolerances(lens, Draw(torch.Generator().manual_seed(0)), 1.0)
    tilts = [v for name, v in made.named_parameters() if name.endswith("tilt_x")]
    assert tilts
    assert all(0.0 < abs(float(tilt.detach())) <= math.radians(0.05) for tilt in tilts)
    assert all(torch.equal(before[name], value) for name, value in lens.state_dict().items())


def test_an_ideal_lens_has_airy_s_pattern_integrated_over_pixels():
    f_number, pitch, near = 4.0, 1.5e-3, 8
    optics = FormulaOptics(f_number, [GREEN], _flat, _achromatic)
    functions, held = pixel_functions(optics.at, [0.0], pitch)
    cells = 24
    fine = (torch.arange((2 * near + 3) * cells, dtype=torch.float64) + 0.5) / cells
    fine = fine - (near + 1.5)
    v = math.pi * pitch / (1e-6 * GREEN * f_number) * torch.hypot(fine[:, None], fine)
    airy = (2.0 * torch.special.bessel_j1(v) / v).square()
    airy = airy * math.pi * (pitch / cells / (2e-6 * GREEN * f_number)) ** 2
    pixels = torch.arange(-near, near + 1, dtype=torch.float64)
    matrix = quadratic_b_spline(fine - pixels[:, None])
    expected = matrix @ airy @ matrix.mT
    found = held * functions[0, 0, 32 - near : 33 + near, 32 - near : 33 + near].double()
    assert held == pytest.approx(0.98, abs=0.01)
    assert float((found - expected).abs().max() / expected.max()) < 0.01


def test_a_defocused_lens_has_a_disc_of_its_geometric_radius():
    optics = FormulaOptics(2.0, [GREEN], _flat, _achromatic)
    pitch, radius = 10e-3, 12.0
    # Marginal rays have the slope tan u' with sin u' = 1/(2N).
    shift = radius * pitch / math.tan(math.asin(0.25))
    functions, _ = pixel_functions(optics.at, [shift], pitch)
    square = (torch.arange(65.0) - 32.0).square()
    variance = float((functions[0, 0] * (square[:, None] + square)).sum()) - 0.5
    # Equal light per area of direction cosines: up to 3 % more outside than in an even disc.
    assert variance == pytest.approx(0.5 * radius**2, rel=0.03)


def _transfer(optics: FormulaOptics, shifts: list[float], pitch: float) -> Tensor:
    functions, _ = pixel_functions(optics.at, shifts, pitch)
    return torch.fft.rfft2(functions.mean(1))[:, :16, :16].abs()


def test_a_cubic_plate_s_transfer_hardly_depends_on_defocus_where_a_lens_s_does():
    waves = [530.0, 550.0]

    def plate(x: Tensor, y: Tensor) -> Tensor:
        return 15.0 * GREEN * (x**3 + y**3)

    changes = []
    for shape in (plate, _flat):
        optics = FormulaOptics(8.0, waves, shape, _achromatic)
        shifts = [optics.shift_of(w20) for w20 in (0.0, 3.0)]
        sharp, moved = _transfer(optics, shifts, 15e-3)
        changes.append(float((sharp - moved).abs().max()))
    assert changes[0] < 0.03
    assert changes[1] > 0.5


def test_rays_alone_give_a_strong_plate_s_function_as_waves_do(monkeypatch):
    def plate(x: Tensor, y: Tensor) -> Tensor:
        return 20.0 * GREEN * (x**3 + y**3)

    optics = FormulaOptics(4.0, [530.0, 550.0], plate, _achromatic)
    waves, _ = pixel_functions(optics.at, [0.0], 20e-3)
    monkeypatch.setattr(module, "_MOST", 1)
    rays, _ = pixel_functions(optics.at, [0.0], 20e-3)
    difference = float((rays.mean(1) - waves.mean(1)).abs().sum())
    assert 1e-4 < difference < 0.06
