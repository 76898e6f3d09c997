"""A lens at another temperature: homologous scaling, the lensmaker's equation, gaps of a mount."""

import math

import pytest
import torch

from dolens import InputError, load_lens, save_lens
from dolens.optics.glass import Environment
from dolens.optics.glass_catalog import find_glass
from dolens.prescriptions import lens_from_prescription, prescription_of

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
