"""Wavefront maps and Zernike coefficients against closed forms of mirrors, and Optiland."""

import math

import pytest
import torch
from scipy.integrate import quad

from dolens import load_lens
from dolens.analysis.conditions import conditions
from dolens.diffraction.point_spread import marechal, strehl_ratios
from dolens.diffraction.wavefront_map import wavefront_maps
from dolens.prescriptions import lens_from_prescription

WAVELENGTH = 500.0
LAMBDA = 500e-6


def mirror(radius=1000.0, aperture=20.0, conic=0.0, defocus=0.0):
    """A concave mirror that is its own stop; the sensor `defocus` mm beyond its paraxial focus."""
    row = {
        "type": "conic",
        "radius": -radius,
        "conic": conic,
        "semi_diameter": aperture,
        "material": "mirror",
    }
    sensor = {"distance": -0.5 * radius - defocus}
    lens = lens_from_prescription({"surfaces": {"1": row}, "sensor": sensor})
    return lens.requires_grad_(False)


def coefficients(lens, field=(0.0, 0.0), order="fringe", **options):
    maps = wavefront_maps(lens, conditions(lens, [field], [WAVELENGTH]), **options)
    fit = maps.zernike(order)
    return dict(zip(fit.names, fit.coefficients[0, 0].tolist(), strict=True)), maps


def test_a_paraboloid_is_perfect_on_the_axis():
    found, maps = coefficients(mirror(conic=-1.0, aperture=100.0))
    assert float(maps.rms) < 1e-8
    assert max(map(abs, found.values())) < 1e-8


def test_a_sphere_s_spherical_aberration():
    """It departs from the paraboloid by r⁴/(8R³), and light goes there twice: W₀₄₀ = a⁴/(4R³),
    early at the rim.  ρ⁴ = (Z9 + 3·Z4 + 2)/6.
    """
    found, _ = coefficients(mirror(aperture=20.0))
    w040 = 20.0**4 / (4.0 * 1000.0**3) / LAMBDA
    # The next order is (a/R)² of it.
    assert found["spherical"] == pytest.approx(w040 / 6.0, rel=2e-3)
    assert found["defocus"] == pytest.approx(w040 / 2.0, rel=2e-3)
    rest = [
        value for name, value in found.items() if name not in ("spherical", "defocus", "piston")
    ]
    assert max(map(abs, rest)) < 1e-3 * w040


def test_a_paraboloid_s_coma():
    """W = W₁₃₁·ρ³·cos, W₁₃₁ = θa³/R², for the stop at the mirror; its tangential blur subtends
    3θ/(16N²) (Schroeder, Astronomical Optics, section 6.1).  Z8 = W₁₃₁/3.
    """
    theta, radius, aperture = math.radians(0.1), 1000.0, 20.0
    found, _ = coefficients(mirror(radius, aperture, -1.0), (0.0, 0.1))
    w131 = theta * aperture**3 / radius**2 / LAMBDA
    f_number = 0.5 * radius / (2.0 * aperture)
    assert 3.0 * w131 * LAMBDA / aperture == pytest.approx(3.0 * theta / (16.0 * f_number**2))
    assert abs(found["coma y"]) == pytest.approx(w131 / 3.0, rel=1e-3)
    assert abs(found["coma x"]) < 1e-6


def test_a_mirror_s_astigmatism():
    """Foci along the chief ray differ by Rθ²/2 (tangential cos θ·R/2, sagittal R/(2·cos θ)), which
    is 2·W₂₂₂·(f/a)², and Z5 half of W₂₂₂.  The tangential fan, along y, focuses first: early light.
    """
    theta, radius, aperture = math.radians(1.0), 1000.0, 10.0
    found, _ = coefficients(mirror(radius, aperture, -1.0), (0.0, 1.0))
    w222 = 0.5 * radius * theta**2 * aperture**2 / (2.0 * (0.5 * radius) ** 2) / LAMBDA
    # y²  = ρ²·sin² is (ρ² - ρ²·cos 2φ)/2: minus half goes with cos 2φ.
    assert found["astigmatism 0°"] == pytest.approx(-0.5 * w222, rel=2e-3)
    assert abs(found["astigmatism 45°"]) < 1e-6


def test_defocus_is_early_where_the_sensor_is_too_far():
    """A sensor δ beyond the focus: marginal light is early by δ·(1 - cos u'), δ·a²/(2f²) = 2·Z4."""
    shift, aperture, focal = 0.05, 10.0, 500.0
    found, _ = coefficients(mirror(2.0 * focal, aperture, -1.0, shift))
    assert found["defocus"] == pytest.approx(
        0.5 * shift * aperture**2 / (2 * focal**2) / LAMBDA, rel=2e-3
    )


@pytest.mark.parametrize("waves", [0.2, 1.0])
def test_balanced_spherical_aberration_and_its_strehl_ratio(waves):
    """With W₀₂₀ = -W₀₄₀ the RMS is W₀₄₀/(6√5), and the ratio |∫exp(2πi·W·(t² - t))dt|² (Born and
    Wolf, 9.1.4); Maréchal's exp(-(2πσ)²) is near where W is small.
    """
    radius = 1000.0
    aperture = (4.0 * waves * LAMBDA * radius**3) ** 0.25
    # W₀₂₀ = δ·a²/(2f²).
    shift = -waves * LAMBDA * 2.0 * (0.5 * radius / aperture) ** 2
    lens = mirror(radius, aperture, 0.0, shift)
    found, maps = coefficients(lens, samples=128)
    assert float(maps.rms) == pytest.approx(waves / (6.0 * math.sqrt(5.0)), rel=3e-3)
    assert abs(found["defocus"]) < 5e-3 * waves
    ratios = strehl_ratios(lens, conditions(lens, [(0.0, 0.0)], [WAVELENGTH]))
    parts = [
        quad(lambda t, f=f: f(2.0 * math.pi * waves * (t * t - t)), 0.0, 1.0)[0]
        for f in (math.cos, math.sin)
    ]
    exact = parts[0] ** 2 + parts[1] ** 2
    assert float(ratios.peak) == pytest.approx(exact, rel=2e-3)
    assert float(ratios.marechal) == pytest.approx(
        math.exp(-((2 * math.pi * waves) ** 2) / 180.0), rel=5e-3
    )
    assert float(ratios.sampling_error) < 1e-3


def test_marechal_s_formula():
    """A fourteenth of a wave is a ratio of 0.8."""
    assert float(marechal(torch.tensor(1.0 / 14.0))) == pytest.approx(0.8176, abs=1e-4)


def test_hubble_s_telescope_has_no_coma(root):
    """A Ritchey-Chrétien; a paraboloid of the same aperture and F-number has θa/(16N²) of it."""
    lens = load_lens(root / "conf/lens/published/ritchey_chretien_hst.yaml").requires_grad_(False)
    maps = wavefront_maps(lens, conditions(lens, [(0.0, 0.0), (0.0, 0.1)], [632.8]))
    fit = maps.zernike()
    paraboloid = math.radians(0.1) * 1200.0 / (16.0 * 24.0**2) / 632.8e-6 / 3.0
    coma = fit.coefficients[1, 0, fit.names.index("coma y")]
    assert paraboloid > 0.1
    assert abs(float(coma)) < 0.03 * paraboloid
    # The sensor's distance is given to 0.1 mm and the conics to seven digits: some 0.01 waves.
    assert float(maps.rms[0]) < 0.02


def test_the_triplet_s_coefficients_are_optiland_s(root, reference):
    """See tests/reference/zernike_optiland.py; its piston is about the chief ray, ours the mean's.

    At 20° apertures cut the disc: what 37 terms leave depends a little on where rays are.
    """
    document = reference("zernike_optiland.json")
    lens = load_lens(root / "conf/lens/cooke_triplet.yaml").requires_grad_(False)
    fields = [(0.0, case["field"]) for case in document["cases"]]
    maps = wavefront_maps(lens, conditions(lens, fields, [document["wavelength_nm"]]), samples=48)
    for order in ("fringe", "standard"):
        found = maps.zernike(order).coefficients[:, 0]
        expected = torch.tensor([case[order] for case in document["cases"]]).double()
        wrong = (found - expected)[:, 1:].abs().amax(1)
        assert bool((expected[:, 1:].abs().amax(1) > 0.1).all())
        assert float(wrong[0]) < 2e-7
        assert float(wrong[1]) < 5e-6
        assert float(wrong[2]) < 5e-4


def test_standard_coefficients_sum_to_the_variance(root):
    """Over the full disc, without piston; the axis of the triplet is not vignetted."""
    lens = load_lens(root / "conf/lens/cooke_triplet.yaml").requires_grad_(False)
    maps = wavefront_maps(lens, conditions(lens, [(0.0, 0.0)], [587.5618]))
    found = maps.zernike("standard").coefficients[0, 0, 1:]
    assert float(found.square().sum().sqrt()) == pytest.approx(float(maps.rms), rel=5e-4)


def test_a_folded_mirror_has_the_wavefront_of_the_straight_one(root):
    """The Newtonian's flat turns the light by 90°; its paraboloid is perfect on the axis."""
    lens = load_lens(root / "conf/lens/published/newtonian_200_f5.yaml").requires_grad_(False)
    maps = wavefront_maps(lens, conditions(lens, [(0.0, 0.0), (0.0, 0.1)], [550.0]))
    assert float(maps.rms[0]) < 1e-3
    fit = maps.zernike()
    w131 = math.radians(0.1) * 100.0**3 / 2000.0**2 / 550e-6
    assert abs(float(fit.coefficients[1, 0, fit.names.index("coma y")])) == pytest.approx(
        w131 / 3.0, rel=0.01
    )


def test_fields_without_light_are_nan_and_spoil_no_other(root):
    lens = load_lens(root / "conf/lens/cooke_triplet.yaml").requires_grad_(False)
    maps = wavefront_maps(lens, conditions(lens, [(0.0, 80.0), (0.0, 5.0)], [587.5618]), samples=24)
    fit = maps.zernike()
    assert math.isnan(float(maps.rms[0])) and math.isnan(float(maps.peak_to_valley[0]))
    assert bool(fit.coefficients[0].isnan().all())
    assert bool(fit.coefficients[1].isfinite().all())
