"""Point spread, encircled energy, MTF, wavefront error and illumination of a lens's fields."""

import math

import numpy as np
import pytest
import torch
from scipy.optimize import brentq

from dolens import load_lens
from dolens.analysis.conditions import conditions, field_scans
from dolens.analysis.modulation_transfer import diffraction_limited_transfer, modulation
from dolens.diffraction.huygens import huygens_point_spread
from dolens.diffraction.illumination import relative_illumination
from dolens.diffraction.modulation_transfer import diffraction_modulation
from dolens.diffraction.point_spread import diffraction_encircled_energy, point_spread
from dolens.diffraction.wavefront_map import wavefront_errors
from dolens.errors import InputError
from dolens.optics.surfaces.clear_aperture import Circle, ClearAperture
from dolens.prescriptions import lens_from_prescription
from dolens.rendering.imaging_system import ImagingSystem
from dolens.rendering.relative_illumination import relative_illumination as by_pixels
from dolens.scene.planar import PlanarScene
from dolens.sensor.pixels import Sensor
from tests.diffraction.perfect_lenses import hyperbola, hyperbola_height

AXIS = [(0.0, 0.0)]
WAVE = 500.0
# sin u' of the marginal ray of a hyperbola of focal length 50 at the height 2.5.
SINE = brentq(lambda sine: hyperbola_height(sine, 50.0) - 2.5, 0.01, 0.1)
F_NUMBER = 0.5 / SINE


@pytest.fixture(scope="module")
def perfect():
    return hyperbola()


def test_airy_s_disc_holds_83_8_percent(perfect):
    """1 - J₀² - J₁² at the dark rings of a perfect circular pupil: Born and Wolf, table 8.2."""
    rings = np.array([1.21967, 2.23313, 3.23832]) * WAVE * 1e-3 * F_NUMBER
    found = diffraction_encircled_energy(perfect, conditions(perfect, AXIS, [WAVE]), rings)
    assert found.energy[0].tolist() == pytest.approx([0.8378, 0.9099, 0.9376], abs=2e-3)
    assert found.airy_radius_um == pytest.approx(rings[0], rel=6e-3)
    assert found.diffraction == (True,)


def test_a_perfect_lens_has_a_strehl_ratio_of_one_and_all_of_its_light(perfect):
    where = conditions(perfect, AXIS, [WAVE])
    found = point_spread(perfect, where, cells=64)
    assert float(found.strehl_ratio) == pytest.approx(1.0, abs=5e-3)
    half = float(found.half_width_um)
    # Beyond radius r of Airy's pattern 2λN/(π²r) of the light is left.
    beyond = 2.0 * WAVE * 1e-3 * F_NUMBER / (math.pi**2 * half)
    assert 1.0 - float(found.held) == pytest.approx(beyond, rel=0.15)
    assert found.irradiance.shape == (1, 64, 64)
    assert torch.allclose(found.irradiance, found.irradiance.flip(1), atol=1e-9)
    errors = wavefront_errors(perfect, where)
    assert float(errors.rms) < 1e-6 and float(errors.strehl_ratio) == pytest.approx(1.0)


def test_mtf_of_a_perfect_lens_is_the_diffraction_limit(perfect):
    frequency = torch.linspace(0.0, 220.0, 23, dtype=torch.float64)
    found = diffraction_modulation(perfect, conditions(perfect, AXIS, [WAVE]), frequency)
    expected = diffraction_limited_transfer(frequency, WAVE, F_NUMBER)
    for curve in (found.tangential, found.sagittal, found.tangential_limit):
        np.testing.assert_allclose(curve[0], expected, atol=2e-3)


def overlap(a, b, distance):
    """The area that two discs share (Weisstein, "Circle-circle intersection", equation 14)."""
    if distance <= abs(a - b):
        return math.pi * min(a, b) ** 2
    if distance >= a + b:
        return 0.0
    first = (distance**2 + a**2 - b**2) / (2.0 * distance)
    second = distance - first
    return sum(
        r * r * math.acos(d / r) - d * math.sqrt(r * r - d * d)
        for r, d in ((a, first), (b, second))
    )


def test_mtf_of_an_obscured_pupil_is_o_neill_s():
    """The autocorrelation of a ring, O'Neill, J. Opt. Soc. Am. 46, 285 (1956): with the share ε
    of the radius that is blocked, (A(1, 1) - 2·A(1, ε) + A(ε, ε))/(π·(1 - ε²)).
    """
    inner = 1.0
    share = brentq(lambda sine: hyperbola_height(sine, 50.0) - inner, 0.005, 0.1) / SINE
    lens = hyperbola(50.0, ClearAperture(Circle(2.5), Circle(inner)))
    frequency = torch.linspace(0.0, 190.0, 20, dtype=torch.float64)
    found = diffraction_modulation(lens, conditions(lens, AXIS, [WAVE]), frequency)
    shear = (2.0 * frequency * WAVE * 1e-6 * F_NUMBER).tolist()
    expected = [
        (overlap(1.0, 1.0, d) - 2.0 * overlap(1.0, share, d) + overlap(share, share, d))
        / (math.pi * (1.0 - share**2))
        for d in shear
    ]
    for curve in (found.tangential[0], found.sagittal[0]):
        np.testing.assert_allclose(curve, expected, atol=2e-3)
    wrong = np.abs(found.tangential[0].numpy() - expected)[1:].max()
    assert wrong < 3.0 * float(found.sampling_error) + 1e-4


def test_defocus_lowers_the_strehl_ratio_by_its_sinc():
    """W = δ·sin²u'/2 at the rim: rms W/√12, Strehl ratio (sin πW/λ / (πW/λ))²."""
    defocus = 0.15
    lens = hyperbola(defocus=defocus)
    waves = 0.5 * defocus * SINE**2 / (WAVE * 1e-6)
    where = conditions(lens, AXIS, [WAVE])
    errors = wavefront_errors(lens, where)
    assert float(errors.rms) == pytest.approx(waves / math.sqrt(12.0), rel=5e-3)
    assert float(errors.peak_to_valley) == pytest.approx(waves, rel=0.05)
    expected = np.sinc(waves) ** 2
    assert float(errors.strehl_ratio) == pytest.approx(expected, abs=3e-3)
    found = point_spread(lens, where, cells=65)
    assert float(found.strehl_ratio) == pytest.approx(expected, abs=5e-3)


def test_mtf_of_the_triplet_on_the_axis_is_optiland_s(triplet, reference):
    """Its Fourier transform spaces frequencies by the paraxial F-number: a percent of the slope."""
    table = reference("field_curves_optiland.json")
    found = diffraction_modulation(
        triplet, conditions(triplet, AXIS, [587.5618]), table["frequency_per_mm"]
    )
    np.testing.assert_allclose(found.tangential[0], table["axial_mtf"], atol=6e-3)


@pytest.mark.parametrize("field", [(0.0, 14.0), (9.0, 10.0)])
def test_mtf_is_the_fourier_transform_of_the_point_spread_function(triplet, field):
    """The one is an autocorrelation of the pupil, the other an irradiance on the sensor."""
    frequency = torch.tensor([0.0, 15.0, 40.0], dtype=torch.float64)
    lines = [656.2725, 486.1327]
    where = conditions(triplet, [field], lines)
    mtf = diffraction_modulation(triplet, where, frequency)
    psf = point_spread(triplet, where, cells=192, half_width_um=120.0)
    step = 2.0 * 0.12 / 192
    place = (torch.arange(192, dtype=torch.float64) + 0.5) * step - 0.12
    tangents = torch.deg2rad(torch.tensor(field, dtype=torch.float64)).tan()
    along = tangents / tangents.norm()
    for way, curve in (
        (along, mtf.tangential),
        (torch.stack((along[1], -along[0])), mtf.sagittal),
    ):
        height = way[0] * place[None] + way[1] * place[:, None]
        phase = 2.0 * math.pi * frequency[:, None, None] * height
        light = psf.irradiance[0] / psf.irradiance.sum()
        found = torch.hypot((light * phase.cos()).sum((1, 2)), (light * phase.sin()).sum((1, 2)))
        np.testing.assert_allclose(curve[0], found, atol=0.02)


def test_coarse_patterns_lose_by_diffraction_what_a_blurred_image_hardly_notices(root):
    """Far from the diffraction limit both transfer functions are one."""
    lens = load_lens(root / "conf/lens/double_gauss.yaml").requires_grad_(False)
    frequency = [0.0, 4.0, 8.0]
    where = conditions(lens, [(0.0, 15.4)], [587.5618])
    wave = diffraction_modulation(lens, where, frequency)
    rays = modulation(lens, where, frequency)
    assert wave.diffraction == (True,)
    np.testing.assert_allclose(wave.tangential, rays.tangential, atol=0.03)
    np.testing.assert_allclose(wave.sagittal, rays.sagittal, atol=0.03)


def test_wavefronts_too_steep_are_left_to_rays(root):
    lens = load_lens(root / "conf/lens/lb1757.yaml").requires_grad_(False)
    where = conditions(lens, AXIS, [587.5618])
    found = point_spread(lens, where, cells=16)
    assert found.diffraction == (False,) and found.reasons[0].startswith("rays alone")
    assert float(found.held) > 0.98 and torch.isnan(found.strehl_ratio).all()
    mtf = diffraction_modulation(lens, where, [0.0, 0.1])
    rays = modulation(lens, where, [0.0, 0.1])
    assert torch.allclose(mtf.tangential, rays.tangential, atol=0.02)
    assert torch.isnan(mtf.tangential_limit).all()
    energy = diffraction_encircled_energy(lens, where, [1e3, 3e4])
    assert float(energy.energy[0, 1]) == pytest.approx(1.0)


def test_fields_in_the_dark_are_gaps(triplet):
    """Beyond some 31° the triplet's apertures overlap no more."""
    scene = [(0.0, 0.0), (0.0, 45.0)], [587.5618]
    where = conditions(triplet, *scene)
    found = point_spread(triplet, where, cells=16)
    assert found.reasons[1] == "no light passes" and torch.isnan(found.irradiance[1]).all()
    curves = (
        diffraction_modulation(triplet, where, [0.0, 10.0]).sagittal,
        diffraction_encircled_energy(triplet, where, [5.0, 10.0]).energy,
        wavefront_errors(triplet, where).rms,
    )
    for values in curves:
        assert torch.isnan(values[:, 0]).tolist() == [False, True]
    (scan,) = field_scans(triplet, None, 45.0, 2)
    assert relative_illumination(triplet, scan).relative.tolist() == [pytest.approx(1.0), 0.0]


def test_a_pinhole_loses_light_by_the_fourth_power_of_the_cosine():
    plane = {"type": "plane", "material": "air", "semi_diameter": 0.05}
    lens = lens_from_prescription({"surfaces": {"1": plane}, "sensor": {"distance": 20.0}})
    (scan,) = field_scans(lens, None, 40.0, 5)
    found = relative_illumination(lens, scan)
    np.testing.assert_allclose(found.relative, found.cosine_fourth, rtol=1e-3)
    angles = torch.deg2rad(scan.coordinate)
    np.testing.assert_allclose(found.cosine_fourth, angles.cos() ** 4)
    np.testing.assert_allclose(found.image_height, 20.0 * angles.tan(), rtol=1e-6)


def test_illumination_is_what_pixels_see(triplet):
    """Rays from the pixels to the scene meet the same pupil from behind."""
    (scan,) = field_scans(triplet, None, 20.0, 3)
    found = relative_illumination(triplet, scan)
    pitch = 0.8
    sensor = Sensor(1, 45, pitch)
    imaging = ImagingSystem.of(triplet.system(), PlanarScene((1e7,), (587.5618,)), sensor)
    x = sensor.positions(torch.zeros(45), torch.arange(45).double())[0]
    seen = by_pixels(imaging)[0, 0]
    order = x.argsort()
    expected = np.interp(found.image_height, x[order], seen[order])
    np.testing.assert_allclose(found.relative, expected / float(seen[22]), rtol=0.01)


def test_windows_that_make_no_sense_are_refused(perfect):
    for wrong in ({"cells": 1}, {"half_width_um": 0.0}):
        with pytest.raises(InputError, match="window"):
            point_spread(perfect, conditions(perfect, AXIS, [WAVE]), **wrong)
    with pytest.raises(InputError, match="pairs"):
        point_spread(perfect, conditions(perfect, [], [WAVE]))


def test_the_corners_of_a_pupil_s_box_are_dark(root):
    """Strong aspheres: polynomials fitted to the round pupil swing wildly in the box's corners,
    where no ray is.  The transform of the fitted pupil is that of the rays' wavelets.
    """
    lens = load_lens(root / "conf/lens/published/mobile_us7535658_odd.yaml").requires_grad_(False)
    field = [(0.0, 0.0)]
    where = conditions(lens, field, [587.5618])
    found = point_spread(lens, where, cells=7 * 9, half_width_um=4.0)
    assert found.diffraction == (True,)
    sums = huygens_point_spread(lens, where, cells=7, half_width_um=4.0, rays=96)
    wrong = (sums.irradiance[0] - found.irradiance[0, 4::9, 4::9]).abs().max()
    assert float(wrong / sums.irradiance.max()) < 0.02
