"""Indices at other temperatures and pressures: Schott's printed dn/dT, air by another formula."""

import mpmath
import pytest
import torch

from dolens import InputError
from dolens.optics.glass import Environment, air_index
from dolens.optics.glass_catalog import find_glass
from dolens.optics.materials import index_model, parse_material

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
