"""Thin achromats: against Seidel sums of the traced lens, and against what textbooks say."""

import pytest
import torch

from dolens import InputError
from dolens.lens_search.glass.choice import GlassChoice, choose_glasses, glass_set
from dolens.lens_search.glass.thin_achromats import _seidel, best_achromats, thin_achromats
from dolens.optics.materials import abbe_number, index_d
from dolens.optics.seidel import seidel
from tests.lenses import lens_of_rows

F, D, E, C = 486.1327, 587.5618, 546.074, 656.2725


def catalogue(middle=D, **keys):
    chosen = choose_glasses(GlassChoice(("SCHOTT",), **keys))
    return glass_set(chosen.glasses, (F, middle, C))


@pytest.fixture(scope="module")
def schott():
    return catalogue()


def pair(glasses, *names):
    numbers = [glasses.names.index(f"SCHOTT:{name}") for name in names]
    return thin_achromats(glasses.indices, torch.tensor([numbers]))


def test_powers_and_secondary_spectrum_are_the_textbook_s(schott):
    found = pair(schott, "N-BK7", "F2")
    crown, flint = (schott.glasses[n].glass for n in found.glasses[0].tolist())
    v1, v2 = abbe_number(crown), abbe_number(flint)
    powers = [v1 / (v1 - v2), -v2 / (v1 - v2)]
    assert found.powers[0].tolist() == pytest.approx(powers, rel=1e-12)
    curvatures = [p / (index_d(g) - 1) for p, g in zip(powers, (crown, flint), strict=True)]
    assert found.total_curvatures[0].tolist() == pytest.approx(curvatures, rel=1e-12)
    partial = [(g.index(F) - g.index(D)) / (g.index(F) - g.index(C)) for g in (crown, flint)]
    expected = -(partial[0] - partial[1]) / (v1 - v2)
    assert found.secondary_spectrum[0] == pytest.approx(expected, rel=1e-3)
    # The usual figure for an ordinary achromat is about f/2000.
    assert 1.0 / found.secondary_spectrum[0] == pytest.approx(2000.0, rel=0.02)


@torch.no_grad()
@pytest.mark.parametrize("names", [("N-BK7", "F2"), ("N-SF10", "N-BAK4"), ("N-FK51A", "N-KZFS4")])
def test_aberrations_are_those_of_the_traced_lens(schott, names):
    found = pair(schott, *names)
    focal, height, field = 100.0, 2.0, 0.01
    radii = [float(focal / c) for c in found.curvatures[0]]
    media = [f"SCHOTT:{name}" for name in names]
    thin = 1e-7
    front = {"radius": radii[0], "semi_diameter": height, "thickness": thin, "material": media[0]}
    rows = front, (radii[1], thin, media[1]), (radii[2], 0.0, "air")
    lens = lens_of_rows(*rows, semi_diameter=3.0, sensor=100.0, stop=1)
    assert lens.first_order(D).efl.item() == pytest.approx(focal, rel=1e-6)
    for at, line in enumerate((F, D, C)):
        sums = seidel(lens.system(), line, field)
        spherical = float(sums.spherical.sum()) / height**4 * focal**3
        assert float(found.spherical[0, at]) == pytest.approx(spherical, abs=2e-5)
        if line == D:
            coma = float(sums.coma.sum()) / (height**3 * field) * focal**2
            assert float(found.coma[0]) == pytest.approx(coma, rel=1e-4, abs=2e-5)
            petzval = float(sums.petzval.sum()) / (height**2 * field**2) * focal
            assert float(found.petzval[0]) == pytest.approx(petzval, rel=1e-4)
    foci = [float(lens.first_order(line).focus) for line in (F, D, C)]
    assert foci[0] == pytest.approx(foci[2], abs=1e-6)
    assert foci[0] - foci[1] == pytest.approx(focal * float(found.secondary_spectrum[0]), rel=1e-4)


def test_the_bending_leaves_no_spherical_aberration_or_the_least(schott):
    pairs = torch.combinations(torch.arange(0, len(schott.names), 5), 2)
    found = thin_achromats(schott.indices, pairs)
    found = found.take((found.strength < 15.0).nonzero()[:, 0])
    left = found.spherical[:, 1].abs()
    corrected = left < 1e-8
    assert 0.3 < corrected.double().mean() < 1.0
    for change in (-0.02, 0.02):
        bent = _seidel(schott.indices[found.glasses][..., 1], found.curvatures + change)[0].abs()
        assert (bent[~corrected] >= left[~corrected]).all()


@pytest.mark.parametrize(
    ("names", "share"),
    [(("BAK1", "BASF52"), 0.79), (("BK7", "KZFSN4"), 0.75), (("BK7", "KZFN2"), 0.73)],
)
def test_secondary_spectra_of_published_objectives(names, share):
    """Traced objectives of telescope-optics.net, 9.2.1: e against F and C, over a usual one's."""
    glasses = catalogue(E)
    usual = pair(glasses, "BK7", "F2").secondary_spectrum
    assert float(pair(glasses, *names).secondary_spectrum / usual) == pytest.approx(share, abs=0.06)


def test_what_textbooks_say_of_pairs(schott):
    """Kingslake, Lens Design Fundamentals: a large difference of V makes weak elements; secondary
    spectra are alike but for those of fluor crowns with short flints, which are small.
    """
    usual, weaker = pair(schott, "N-BK7", "F2"), pair(schott, "N-BK7", "N-SF2")
    assert float(weaker.strength) < float(usual.strength)
    for names in (("N-BK7", "N-SF2"), ("N-BK7", "N-SF5"), ("N-BAK4", "N-SF10"), ("K7", "F2")):
        change = pair(schott, *names).secondary_spectrum / usual.secondary_spectrum
        assert 0.9 < float(change) < 1.1
    for names in (("N-FK51A", "N-KZFS4"), ("N-FK51A", "N-KZFS11"), ("LITHOTEC-CAF2", "N-KZFS4")):
        assert pair(schott, *names).secondary_spectrum.abs() < 0.35 * usual.secondary_spectrum
    # Without fluor crowns, short flints shorten it at the price of strong elements.
    short = pair(schott, "N-BK7", "N-KZFS4")
    assert float(short.secondary_spectrum) < 0.8 * float(usual.secondary_spectrum)
    assert float(short.strength) > 1.4 * float(usual.strength)


def test_the_best_pairs_of_the_catalogue(schott):
    best = best_achromats(schott.indices, 100.0, 5.0, 10)
    errors = best.wavefront_error(100.0, 5.0)
    assert (errors.diff() >= 0.0).all()
    assert (best.strength <= 8.0).all()
    usual = pair(schott, "N-BK7", "F2").wavefront_error(100.0, 5.0)
    assert (errors < usual / 2.5).all()
    # Each has a crown of low dispersion, and by far the most with a short flint or a lanthanum one.
    for row in best.glasses.tolist():
        names = [schott.names[n] for n in row]
        assert any("FK" in name or "CAF2" in name for name in names), names
    assert any("KZF" in schott.names[n] for n in best.glasses[0].tolist())
    # Both orders of a pair were tried.
    turned = thin_achromats(schott.indices, best.glasses.flip(1))
    assert (turned.wavefront_error(100.0, 5.0) >= errors).all()


def test_among_the_usual_glasses_the_usual_pairs_are_best():
    """Crowns and flints of the normal line: secondary spectra are alike, weak elements win."""
    names = ("N-BK7", "N-K5", "N-BAK4", "N-SK16", "F2", "N-F2", "N-SF2", "N-SF5", "N-LAK12")
    glasses = catalogue(names=names)
    best = best_achromats(glasses.indices, 100.0, 5.0, 3)
    for row in best.glasses.tolist():
        pair_of_names = {glasses.names[n].partition(":")[2] for n in row}
        assert pair_of_names & {"N-BK7", "N-K5"}
        assert pair_of_names & {"F2", "N-F2", "N-SF2", "N-SF5"}


def test_costs_come_on_top(schott):
    free = best_achromats(schott.indices, 100.0, 5.0, 1)
    cost = torch.zeros(len(schott.names)).double()
    cost[free.glasses[0]] = 1.0
    other = best_achromats(schott.indices, 100.0, 5.0, 1, cost=cost)
    assert not set(other.glasses[0].tolist()) & set(free.glasses[0].tolist())


def test_what_is_wrong_is_said(schott):
    with pytest.raises(InputError, match="short, a middle and a long"):
        thin_achromats(schott.indices[:, :2], torch.tensor([[0, 1]]))
    with pytest.raises(InputError, match=r"strength of 0\.1 or less"):
        best_achromats(schott.indices, 100.0, 5.0, 1, most_strength=0.1)
    with pytest.raises(InputError, match="must be positive"):
        best_achromats(schott.indices, 100.0, 0.0, 1)
