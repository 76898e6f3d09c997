"""Which glasses a search may use: what a catalogue says of them decides, and silence is no yes."""

from math import log2

import pytest
import torch

from dolens import InputError
from dolens.lens_search.glass.choice import GlassChoice, choose_glasses, glass_set
from dolens.optics.glass_catalog import find_glass

LINES = (486.1327, 587.5618, 656.2725)
# The numbers are Schott's of 2017; the prices are its own, relative to N-BK7.
CATALOGUE = """CC three crowns, a flint and one of which little is said
NM N-BK7 2 517642.251 1.5168 64.17 0 1 4
ED 7.1 8.3 2.51 -9.0E-04 0
CD 1.03961212 6.00069867E-3 2.31792344E-1 2.00179144E-2 1.01046945 1.03560653E+2
TD 1.86E-06 1.31E-08 -1.37E-11 4.34E-07 6.27E-10 1.7E-01 2.0E+01
OD 1.0 1.0 0.0 1.0 2.3 2.3
LD 0.3 2.5
NM F2 2 620364.360 1.62004 36.37 0 1
ED 8.2 9.2 3.60 0.0002 0
CD 1.34533359 0.00997743871 0.209073176 0.0470450767 0.937357162 111.886764
TD 1.51E-06 1.56E-08 -2.78E-11 9.34E-07 1.04E-09 2.5E-01 2.0E+01
OD 1.6 1.0 0.0 1.0 2.3 1.3
LD 0.32 2.5
NM N-KZFS4 2 613445.300 1.61336 44.49 0 0
ED 7.3 8.2 3.00 -0.0100 0
CD 1.35055424 0.0087628207 0.197575506 0.0371767201 1.09962992 90.3866994
OD 1.0 1.0 3.4 1.2 1.0
LD 0.334 2.325
NM OLD 2 517642.251 1.5168 64.17 0 2
CD 1.03961212 6.00069867E-3 2.31792344E-1 2.00179144E-2 1.01046945 1.03560653E+2
OD -1 -1 -1 -1 -1 -1
LD 0.3 2.5
"""


@pytest.fixture
def own(tmp_path, monkeypatch):
    (tmp_path / "own.agf").write_text(CATALOGUE)
    (tmp_path / "silent.agf").write_text("NM X 1 0 1.5 60\nCD 2.25 0 0.01\nLD 0.4 0.7\n")
    monkeypatch.setenv("DOLENS_GLASS", str(tmp_path))


def names(**keys):
    chosen = choose_glasses(GlassChoice(**{"catalogues": ("OWN",), **keys}))
    return [glass.glass.name.partition(":")[2] for glass in chosen.glasses]


@pytest.mark.parametrize(
    ("keys", "left"),
    [
        ({}, ["N-BK7", "F2", "N-KZFS4", "OLD"]),
        ({"names": ("n-*",)}, ["N-BK7", "N-KZFS4"]),
        ({"names": ("own:F2", "OLD")}, ["F2", "OLD"]),
        ({"without": ("OLD",)}, ["N-BK7", "F2", "N-KZFS4"]),
        ({"status": ("preferred",)}, ["N-BK7", "F2"]),
        ({"status": ("preferred", "standard")}, ["N-BK7", "F2", "N-KZFS4"]),
        ({"price": 1.6}, ["N-BK7", "F2"]),
        ({"price": 1.5}, ["N-BK7"]),
        ({"density": 3.0}, ["N-BK7", "N-KZFS4"]),
        ({"resistance": {"SR": 2.0}}, ["N-BK7", "F2"]),
        ({"resistance": {"AR": 2.0, "PR": 1.0}}, ["N-KZFS4"]),
        ({"dn_dt": (0.0, 2.0)}, ["N-BK7"]),
    ],
)
def test_limits(own, keys, left):
    assert names(**keys) == left


def test_why_a_glass_is_left_out_is_said(own):
    chosen = choose_glasses(GlassChoice(("own",), price=1.5))
    assert chosen.left_out == {
        "price is above its limit": ("OWN:F2",),
        "price is not given": ("OWN:N-KZFS4", "OWN:OLD"),
    }


def test_dn_dt_is_schott_s_formula_at_its_own_temperature(own):
    """TIE-19: dn_abs/dT = (n² - 1)/(2n) (D0 + E0/(λ² - λtk²)) at the reference temperature."""
    glass, *_ = choose_glasses(GlassChoice(("OWN",), names=("N-BK7",))).glasses
    n, wavelength = glass.glass.index(587.5618), 0.5875618
    bracket = 1.86e-6 + 4.34e-7 / (wavelength**2 - 0.17**2)
    assert glass.dn_dt == pytest.approx((n**2 - 1) / (2 * n) * bracket, rel=1e-8)


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        ({"catalogues": ("SCHOTT",), "price": 2.0}, "SCHOTT gives no price .* schott.agf"),
        ({"catalogues": ("SCHOTT",), "status": ("preferred",)}, "SCHOTT gives no status"),
        ({"catalogues": ("OWN", "SILENT"), "density": 3.0}, "SILENT gives no density"),
        ({"catalogues": ("SILENT",), "resistance": {"CR": 1}}, "SILENT gives no CR"),
        ({"catalogues": ("SILENT",), "dn_dt": (-1, 1)}, "SILENT gives no dn_dt"),
        ({"catalogues": ("SCHOT",)}, "did you mean 'SCHOTT'"),
        ({"catalogues": ()}, "one at least"),
        ({"names": ("NBK7",)}, "did you mean 'N-BK7'"),
        ({"without": ("K*",)}, "'K\\*' is the name of no glass"),
        ({"status": ("prefered",)}, "did you mean 'preferred'"),
        ({"resistance": {"XR": 1}}, "'XR' is unknown"),
        ({"price": 0.5}, r"no glass is left \(price is above its limit: 2; price is not given: 2"),
        ({"dn_dt": (2.0, 1.0)}, "leaves nothing"),
    ],
)
def test_what_cannot_be_limited_is_an_error(own, keys, message):
    with pytest.raises(InputError, match=message):
        names(**keys)


def test_a_set_of_glasses(own):
    chosen = choose_glasses(GlassChoice(("OWN",)))
    glasses = glass_set(chosen.glasses, LINES)
    for row, name in zip(glasses.indices, ("N-BK7", "SCHOTT:F2", "N-KZFS4"), strict=False):
        exact = [find_glass(name).index(line) for line in LINES]
        torch.testing.assert_close(row, torch.tensor(exact).double(), atol=1e-6, rtol=0.0)
    numbers = torch.tensor([2, -1])
    mixed = glasses.index(glasses.coordinates[[0, 1]], numbers)
    assert torch.equal(mixed[0], glasses.indices[2])
    torch.testing.assert_close(mixed[1], glasses.indices[1], atol=1e-9, rtol=0.0)
    # OLD has the coefficients of N-BK7, which comes first.
    apart = glass_set(chosen.glasses, LINES, apart=0.01)
    assert apart.names == ("OWN:N-BK7", "OWN:F2", "OWN:N-KZFS4")
    assert apart.left_out == {"equal to another one": ("OWN:OLD",)}


def test_costs(own):
    chosen = choose_glasses(GlassChoice(("OWN",), names=("N-BK7", "F2")))
    glasses = glass_set(chosen.glasses, LINES)
    costs = glasses.costs({"price": 10.0, "density": 1.0, "dn_dt": 0.0})
    # Prices are 1 and 1.6, densities 2.51 and 3.6: their powers of two.
    expected = [0.1 * log2(price) + 0.01 * log2(d) for price, d in ((1.0, 2.51), (1.6, 3.6))]
    assert costs.tolist() == pytest.approx(expected)
    everything = glass_set(choose_glasses(GlassChoice(("OWN",))).glasses, LINES)
    with pytest.raises(InputError, match="2 of 4 glasses do not give it, for example OWN:N-KZFS4"):
        everything.costs({"price": 1.0})
    with pytest.raises(InputError, match="costs 'weight' is unknown"):
        GlassChoice(("OWN",), costs={"weight": 1.0})


def test_a_wavelength_beyond_the_range_of_every_glass_leaves_none(own):
    chosen = choose_glasses(GlassChoice(("OWN",)))
    with pytest.raises(InputError, match=r"no glass is left \(no index .*: 4"):
        glass_set(chosen.glasses, (4000.0,))
