"""Glass, air and lenses at other temperatures and pressures."""

import math

import mpmath
import pytest
import torch

from dolens import InputError, load_lens, save_lens
from dolens.optics.glass import Environment, air_index
from dolens.optics.glass_catalog import find_glass
from dolens.optics.materials import index_model, parse_material
from dolens.prescriptions import lens_from_prescription, prescription_of

# Schott's data sheet of N-BK7 (2014): Δn/ΔT in 1e-6/K, relative and absolute, at 1060 nm, e and g.
LINES = (1060.0, 546.074, 435.8343)
PRINTED = {
    (-40.0, -20.0): ((2.4, 2.9, 3.3), (0.3, 0.8, 1.2)),
    (20.0, 40.0): ((2.4, 3.0, 3.5), (1.1, 1.6, 2.1)),
    (60.0, 80.0): ((2.5, 3.1, 3.7), (1.5, 2.1, 2.7)),
}


def index_of_line(glass, line, temperature):
    """Return the index for the light of a spectral line, whose wavelength in air changes a bit."""
    here, standard = (air_index(line / 1000.0, t, 1.0) for t in (temperature, 20.0))
    return glass.at(Environment(temperature, 1.0)).index(line * standard / here)


@pytest.mark.parametrize("interval", PRINTED)
def test_printed_temperature_coefficients(interval):
    glass = find_glass("N-BK7")
    relative, absolute = PRINTED[interval]
    for line, of_air, of_vacuum in zip(LINES, relative, absolute, strict=True):
        n = [index_of_line(glass, line, t) for t in interval]
        air = [air_index(line / 1000.0, t, 1.0) for t in interval]
        assert (n[1] - n[0]) / 20e-6 == pytest.approx(of_air, abs=0.051)
        change = n[1] * air[1] - n[0] * air[0]
        assert change / 20e-6 == pytest.approx(of_vacuum, abs=0.051)


def ciddor(micrometres, celsius, pascal):
    """Return the index of dry air by Ciddor, Applied Optics 35 (1996) 1566, with 450 ppm CO2."""
    square = micrometres**-2
    standard = 1e-8 * (5792105 / (238.0185 - square) + 167917 / (57.362 - square))
    kelvin = celsius + 273.15

    def compressibility(t, kelvin, pascal):
        first = 1.58123e-6 - 2.9331e-8 * t + 1.1043e-10 * t * t
        return 1 - pascal / kelvin * first + (pascal / kelvin) ** 2 * 1.83e-11

    here = pascal / (compressibility(celsius, kelvin, pascal) * kelvin)
    return 1 + standard * here * compressibility(15, 288.15, 101325) * 288.15 / 101325


def test_air_by_another_formula():
    # Values that Ciddor prints: 633 nm, 100 kPa.
    for celsius, printed in ((10, 27774.7), (20, 26824.4), (30, 25937.2)):
        assert (ciddor(0.633, celsius, 1e5) - 1) * 1e8 == pytest.approx(printed, abs=0.06)
    for micrometres in (0.4, 0.4861, 0.5876, 0.7065, 1.0):
        for celsius in (0.0, 15.0, 20.0, 40.0):
            for atmospheres in (0.5, 1.0, 1.1):
                ours = air_index(micrometres, celsius, atmospheres)
                assert abs(ours - ciddor(micrometres, celsius, 101325 * atmospheres)) < 6e-8


@pytest.mark.parametrize("name", ["SCHOTT:N-BK7", "SCHOTT:SF6", "OHARA:S-FPL53", "MISC:ACRYLIC"])
def test_against_fifty_digits(name):
    """The whole chain in mpmath: air, the wavelength in the catalogue's air, dn/dT, and back."""
    glass = find_glass(name)
    d0, d1, d2, e0, e1, resonance, reference = glass.thermal
    temperature, pressure = -17.5, 0.3

    def air(w, t, p):
        w2 = w**2
        n = mpmath.mpf("6432.8") + 2949810 * w2 / (146 * w2 - 1) + 25540 * w2 / (41 * w2 - 1)
        return 1 + n * mpmath.mpf("1e-8") * p / (1 + (t - 15) * mpmath.mpf("3.4785e-3"))

    with mpmath.workdps(50):
        for line in (435.8343, 587.5618, 1013.98):
            w = mpmath.mpf(line) / 1000
            here, then = air(w, temperature, mpmath.mpf(pressure)), air(w, reference, 1)
            light = w * here / then
            n = glass.formula(light, mpmath.mpf(glass.constant), glass.terms)
            t = mpmath.mpf(temperature) - reference
            bracket = d0 * t + d1 * t**2 + d2 * t**3
            bracket += (e0 * t + e1 * t**2) / (light**2 - mpmath.mpf(resonance) ** 2)
            index = (n * then + (n**2 - 1) / (2 * n) * bracket) / here
            found = glass.at(Environment(temperature, pressure)).index(line)
            assert abs(found / index - 1) < 1e-15


def test_the_catalogue_s_own_conditions_change_no_bit():
    for name in ("SCHOTT:N-BK7", "MISC:F_SILICA", "PLASTIC:PMMA", "HOYA:FCD1"):
        glass = find_glass(name)
        reference = glass.thermal.reference if glass.thermal else 20.0
        assert glass.at(Environment(reference, 1.0)).index(550.0) == glass.index(550.0)
    # Ohara measures at 25 °C.
    glass = find_glass("OHARA:S-BSL7")
    assert glass.at(Environment(25.0, 1.0)).index(550.0) == glass.index(550.0)
    assert 1e-6 < abs(glass.at(Environment(20.0, 1.0)).index(550.0) - glass.index(550.0)) < 5e-5


def test_vacuum_and_a_lens_in_vacuum():
    """Relative to vacuum, glass has its absolute index; vacuum itself has 1."""
    vacuum = Environment(20.0, 0.0)
    glass, air = find_glass("N-BK7"), air_index(0.5461, 20.0, 1.0)
    # The same light has a longer wavelength in vacuum.
    assert glass.at(vacuum).index(546.1 * air) == pytest.approx(glass.index(546.1) * air, rel=1e-8)
    assert find_glass("VACUUM").at(vacuum).index(546.1) == pytest.approx(1.0, abs=2e-6)


def test_other_media_keep_their_index():
    here = Environment(80.0, 0.5)
    for text in ("air", "1.5", "1.5168/64.17", "1.5168/64.17/-0.0009"):
        found, usual = (
            parse_material(text, index_model("dfc"), environment) for environment in (here, None)
        )
        assert found == usual and found.index(550.0) == usual.index(550.0)


def test_tensors_and_their_slopes():
    glass = find_glass("N-SF6").at(Environment(60.0, 0.5))
    waves = torch.tensor([450.0, 550.0, 650.0], dtype=torch.float64)
    found = glass.index(waves)
    for wave, index in zip(waves.tolist(), found.tolist(), strict=True):
        assert glass.index(wave) == pytest.approx(index, rel=3e-16)
    slope = torch.func.vmap(torch.func.grad(glass.index))(waves)
    step = 1e-3
    difference = (glass.index(waves + step) - glass.index(waves - step)) / (2 * step)
    assert torch.allclose(slope, difference, rtol=1e-6)


@pytest.mark.parametrize(
    ("values", "said"),
    [((-300.0, 1.0), "above -273.15"), ((20.0, -1.0), "from 0 to 1000 atm"),
     ((float("nan"), 1.0), "temperature nan"), ((20.0, float("inf")), "pressure inf")],
)  # fmt: skip
def test_impossible_surroundings(values, said):
    with pytest.raises(InputError, match=said):
        Environment(*values)


WAVE = 587.5618


def doublet(first="1.6/50", rates=(8.0, 8.0, 8.0), **keys):
    shapes = [
        {"type": "even_asphere", "radius": 40.0, "conic": -0.5, "a4": 2e-6, "a6": -3e-9},
        {"type": "xy_polynomial", "x2": -0.006, "y2": -0.006, "x2y2": 1e-7, "b": 0.01},
        {"type": "conic", "radius": -60.0, "conic": 0.3},
    ]
    media, gaps = [first, "air", "air"], [5.0, 3.0, None]
    rows = {
        str(n): {**shape, "semi_diameter": 8.0, "material": medium, "thermal_expansion": rate}
        | ({"thickness": gap} if gap else {})
        for n, (shape, medium, gap, rate) in enumerate(
            zip(shapes, media, gaps, rates, strict=True), 1
        )
    }
    return lens_from_prescription({"surfaces": rows, "sensor": {"distance": 50.0}, **keys})


@torch.no_grad()
def test_all_of_one_expansion_grows_alike():
    """Glass without dn/dT and a mount of one coefficient: every length is scaled by 1 + αΔT."""
    lens = doublet()
    warm = lens.at(120.0)
    factor = 1.0 + 8e-6 * 100.0
    before, after = lens.first_order(WAVE), warm.first_order(WAVE)
    assert float(after.efl) == pytest.approx(factor * float(before.efl), rel=1e-13)
    assert float(after.bfd) == pytest.approx(factor * float(before.bfd), rel=1e-13)
    gaps = [lens.thicknesses["1"], lens.thicknesses["2"], lens.sensor_distance]
    grown = [warm.thicknesses["1"], warm.thicknesses["2"], warm.sensor_distance]
    # The last gap is held at the edge of the last surface, by the same coefficient.
    for gap, new in zip(gaps, grown, strict=True):
        assert float(new) == pytest.approx(factor * float(gap), rel=1e-13)
    for name, surface in lens.surfaces.items():
        x = torch.linspace(-5.0, 5.0, 9, dtype=torch.float64)
        values = dict(surface.named_parameters())
        scaled = dict(warm.surfaces[name].named_parameters())
        sag = type(surface).sag_and_gradient(values, x, 0.3 * x)[0]
        new = type(surface).sag_and_gradient(scaled, factor * x, 0.3 * factor * x)[0]
        assert torch.allclose(new, factor * sag, rtol=1e-12, atol=1e-15)
        assert warm.surfaces[name].semi_diameter == pytest.approx(8.0 * factor, rel=1e-15)


def plano_convex(**keys):
    rows = {
        "1": {"radius": 50.0, "semi_diameter": 5.0, "thickness": 4.0, "material": "N-BK7"},
        "2": {"type": "plane", "semi_diameter": 5.0, "material": "air"},
    }
    return lens_from_prescription({"surfaces": rows, "sensor": {"distance": 90.0}, **keys})


@torch.no_grad()
def test_the_focal_length_of_a_singlet():
    """1/f = (n - 1)/R with Schott's dn/dT and expansion, 7.1e-6/K."""
    warm = plano_convex().at(70.0)
    n = find_glass("N-BK7").at(Environment(70.0, 1.0)).index(WAVE)
    radius = 50.0 * (1.0 + 7.1e-6 * 50.0)
    assert float(warm.first_order(WAVE).efl) == pytest.approx(radius / (n - 1.0), rel=1e-13)
    assert float(warm.thicknesses["1"]) == pytest.approx(4.0 * (1.0 + 7.1e-6 * 50.0), rel=1e-15)
    # No mount is given, and a plane touches it in one plane: the gap behind it stays.
    assert float(warm.sensor_distance) == 90.0


@torch.no_grad()
def test_an_air_gap_is_held_at_the_edges():
    """Two spheres face each other; the mount is between the edges of their clear apertures."""
    rows = {
        "1": {"type": "plane", "semi_diameter": 6.0, "thickness": 3.0, "material": "SCHOTT:N-BK7"},
        "2": {"radius": -40.0, "semi_diameter": 6.0, "thickness": 2.0, "material": "air",
              "thermal_expansion": 23.6},
        "3": {"radius": 30.0, "semi_diameter": 5.0, "thickness": 3.0, "material": "SCHOTT:SF6"},
        "4": {"type": "plane", "semi_diameter": 5.0, "material": "air"},
    }  # fmt: skip
    lens = lens_from_prescription({"surfaces": rows, "sensor": {"distance": 30.0}})
    change = 60.0

    def sag(radius, height):
        return radius - math.copysign(math.sqrt(radius**2 - height**2), radius)

    first, last = 1.0 + 7.1e-6 * change, 1.0 + 8.1e-6 * change  # N-BK7 and SF6
    s1, s2 = sag(-40.0, 6.0), sag(30.0, 5.0)
    expected = (2.0 - s1 + s2) * (1.0 + 23.6e-6 * change) + first * s1 - last * s2
    assert float(lens.at(80.0).thicknesses["2"]) == pytest.approx(expected, rel=1e-13)


@torch.no_grad()
def test_the_lens_stays_as_it_is_and_comes_back():
    lens = plano_convex()
    kept = prescription_of(lens)
    warm = lens.at(70.0, 0.5)
    assert prescription_of(lens) == kept
    assert (warm.temperature, warm.pressure) == (70.0, 0.5)
    back = warm.at(20.0, 1.0)
    assert float(back.first_order(WAVE).efl) == pytest.approx(
        float(lens.first_order(WAVE).efl), rel=3e-7
    )


@torch.no_grad()
def test_keys_of_a_prescription(tmp_path):
    lens = plano_convex(temperature=70.0, pressure=0.5)
    n = find_glass("N-BK7").at(Environment(70.0, 0.5)).index(WAVE)
    # The radius is that of the prescription: only the index is of its temperature.
    assert float(lens.first_order(WAVE).efl) == pytest.approx(50.0 / (n - 1.0), rel=1e-13)
    save_lens(lens, tmp_path / "lens.yaml")
    again = load_lens(tmp_path / "lens.yaml")
    assert prescription_of(again) == prescription_of(lens)
    assert again.materials == lens.materials
    usual = plano_convex()
    assert "temperature" not in prescription_of(usual)
    assert plano_convex(temperature=20.0).materials[1].index(WAVE) == usual.materials[1].index(WAVE)


def test_expansions_are_kept(tmp_path):
    lens = doublet(rates=(None, 23.6, None))
    save_lens(lens, tmp_path / "lens.yaml")
    assert load_lens(tmp_path / "lens.yaml").thermal_expansions == (None, 23.6, None)


def test_what_is_not_known_is_said(caplog):
    doublet(rates=(None, None, None)).at(60.0)
    assert "no dn/dT of 1.6/50; no expansion of 1.6/50: taken as 0" in caplog.text


@pytest.mark.parametrize(
    ("keys", "said"),
    [({"temperature": "warm"}, "'temperature' must be a number"),
     ({"temperature": -300}, "above -273.15 °C"), ({"pressure": 2000}, "from 0 to 1000 atm")],
)  # fmt: skip
def test_surroundings_that_make_no_sense(keys, said):
    with pytest.raises(InputError, match=said):
        plano_convex(**keys)
