"""Media: indices of the models and of dispersion formulas, model glass, and what is unknown."""

import math

import mpmath
import pytest
import torch

from dolens import InputError
from dolens.optics.dispersion import cauchy, polynomial, sellmeier, sellmeier_squared
from dolens.optics.glass_catalog import find_glass
from dolens.optics.materials import abbe_number, index_d, index_model, parse_material


@pytest.mark.parametrize("name", ["dfc", "do", "paper"])
def test_indices(reference, name):
    # `paper` has the lines of `do` and air 1 (tests/reference/README.md).
    data = reference("index.json")["data"]["do" if name == "paper" else name]
    model = index_model(name)
    assert model.lines == tuple(float(line) for line in data["lines_nm"])
    assert model.air == (1.0 if name == "paper" else float(data["n_air"]))
    assert len(data["materials"]) == 17
    for glass, expected in data["materials"].items():
        material = parse_material(glass, model)
        assert material.a == pytest.approx(float(expected["A"]), rel=1e-15)
        assert material.b == pytest.approx(float(expected["B_nm2"]), rel=1e-14)
        for wavelength, index in expected["n"].items():
            assert material.index(float(wavelength)) == pytest.approx(float(index), rel=1e-15)
        nm = torch.tensor([float(w) for w in expected["n"]], dtype=torch.float64)
        exact = torch.tensor([float(n) for n in expected["n"].values()], dtype=torch.float64)
        assert ((material.index(nm) - exact).abs() / exact).max() <= 2.3e-16 * 2


def test_media_without_dispersion():
    assert parse_material("air", index_model("do")).index(500.0) == 1.000293
    assert parse_material(" AIR ", index_model("dfc")).index(500.0) == 1.0
    assert parse_material("occluder", index_model("do")).index(500.0) == 1.0


@pytest.mark.parametrize("text", ["plexiglas", "1.5168/", "/64", "1.5168/64.17/x", "nan", ""])
def test_unknown_material(text):
    with pytest.raises(InputError, match=r"unknown material .*allowed: air, occluder, .*nd/Vd"):
        parse_material(text, index_model("dfc"))


@pytest.mark.parametrize(
    ("text", "meant"), [("aire", "air"), ("Arr", "air"), ("occluded", "occluder")]
)
def test_nearest_material(text, meant):
    with pytest.raises(InputError, match=f"unknown material '{text}'; did you mean '{meant}'"):
        parse_material(text, index_model("dfc"))


@pytest.mark.parametrize("text", ["0.09/60", "1.5/0", "15/60"])
def test_impossible_glass(text):
    with pytest.raises(InputError, match=f"material '{text}': nd must be from 0.1 to 10 and Vd"):
        parse_material(text, index_model("dfc"))


@pytest.mark.parametrize("model", ["dfc", "do", "paper"])
def test_a_number_is_the_index_at_every_wavelength(model):
    medium = parse_material(1.5, index_model(model))
    assert medium.index(200.0) == medium.index(5000.0) == 1.5
    for same in ("1.5", " 1.50 ", "15e-1"):
        assert parse_material(same, index_model(model)) == medium
    assert parse_material(medium.name, index_model(model)) == medium
    assert parse_material("1.5001", index_model(model)) != medium


@pytest.mark.parametrize("text", ["0.09", "-1.5", "0", "5165", "550.0", "1e999"])
def test_impossible_index(text):
    with pytest.raises(InputError, match=f"material '{text}': a constant index must be from 0.1"):
        parse_material(text, index_model("dfc"))


@pytest.mark.parametrize("text", ["0.99972", "0.9"])
def test_indices_below_that_of_air(text):
    """Vacuum has 0.99972 relative to air."""
    assert parse_material(text, index_model("dfc")).index(550.0) == float(text)


@pytest.mark.parametrize(("nd", "vd"), [(1.5168, 64.17), (1.80518, 25.43), (1.43875, 94.93)])
def test_index_and_abbe_number_come_back(nd, vd):
    """`dfc` stands on the very lines that nd and Vd are defined on."""
    glass = parse_material(f"{nd}/{vd}", index_model("dfc"))
    assert index_d(glass) == pytest.approx(nd, rel=1e-15)
    assert abbe_number(glass) == pytest.approx(vd, rel=1e-12)
    assert abbe_number(parse_material("air", index_model("dfc"))) == math.inf


def test_unknown_index_model():
    with pytest.raises(InputError, match="'dcf' is unknown; did you mean 'dfc'"):
        index_model("dcf")


C, D, F, G = 656.2725, 587.5618, 486.1327, 435.8343


def partial_dispersion(medium):
    return (medium.index(G) - medium.index(F)) / (medium.index(F) - medium.index(C))


@pytest.mark.parametrize(
    ("nd", "vd", "deviation"),
    [(1.5168, 64.17, -0.0009), (1.80518, 25.36, 0.0092), (1.43875, 94.93, 0.0508), (1.7, 30.0, 0)],
)
def test_what_is_given_comes_back(nd, vd, deviation):
    glass = parse_material(f"{nd}/{vd}/{deviation}", index_model("dfc"))
    assert index_d(glass) == pytest.approx(nd, rel=1e-15)
    assert abbe_number(glass) == pytest.approx(vd, rel=1e-12)
    assert partial_dispersion(glass) == pytest.approx(0.6438 - 0.001682 * vd + deviation, rel=1e-11)


def test_conrady_s_formula_at_fifty_digits():
    glass = parse_material("1.5168/64.17/-0.0009", index_model("dfc"))
    with mpmath.workdps(50):
        c, d, f, g = (
            mpmath.mpf(line) / 1000 for line in ("656.2725", "587.5618", "486.1327", "435.8343")
        )
        spread = mpmath.mpf("0.5168") / mpmath.mpf("64.17")
        partial = (
            mpmath.mpf("0.6438")
            - mpmath.mpf("0.001682") * mpmath.mpf("64.17")
            - mpmath.mpf("0.0009")
        )
        power = mpmath.mpf("-3.5")
        rows = mpmath.matrix([[1, 1 / d, d**power], [0, 1 / f - 1 / c, f**power - c**power],
                              [0, 1 / g - 1 / f, g**power - f**power]])  # fmt: skip
        n0, a, b = mpmath.lu_solve(rows, mpmath.matrix(["1.5168", spread, partial * spread]))
        for nm in (404.6561, 546.074, 706.5188, 1013.98):
            w = mpmath.mpf(nm) / 1000
            assert abs(glass.index(nm) / (n0 + a / w + b * w**power) - 1) < 1e-14


@pytest.mark.parametrize("name", ["SCHOTT:N-BK7", "SCHOTT:F2", "OHARA:S-BSL7", "SCHOTT:N-SK16"])
def test_glass_on_the_normal_line_is_met_by_nd_and_vd(name):
    glass = find_glass(name)
    model = parse_material(f"{index_d(glass)!r}/{abbe_number(glass)!r}/0", index_model("dfc"))
    for nm in (486.1327, 546.074, 656.2725, 706.5188):
        assert abs(model.index(nm) - glass.index(nm)) < 3e-5
    assert abs(model.index(G) - glass.index(G)) < 5e-5


def test_a_tensor_and_its_slope():
    glass = parse_material("1.7/30/0.01", index_model("dfc"))
    waves = torch.tensor([450.0, 650.0], dtype=torch.float64, requires_grad=True)
    (slope,) = torch.autograd.grad(glass.index(waves).sum(), waves)
    for wave, of_it in zip(waves.tolist(), slope.tolist(), strict=True):
        difference = (glass.index(wave + 0.01) - glass.index(wave - 0.01)) / 0.02
        assert of_it == pytest.approx(difference, rel=1e-6)


def test_the_name_reads_back_as_the_same_medium():
    model = index_model("dfc")
    glass = parse_material("1.5168/64.17/-9e-4", model)
    assert parse_material(glass.name, model) == glass
    assert glass != parse_material("1.5168/64.17", model)


@pytest.mark.parametrize("text", ["1.5/60/4.0", "1.5/60/-2"])
def test_an_impossible_deviation(text):
    with pytest.raises(InputError, match=rf"material '{text}': ΔPgF must be from -1 to 1"):
        parse_material(text, index_model("dfc"))


MICROMETRES = torch.tensor([0.3650146, 0.4358343, 0.5875618, 0.6562725, 1.0139, 2.3], dtype=float)


def exact(formula, wavelength, constant, terms):
    square, n = wavelength**2, mpmath.mpf(constant)
    if formula == "sellmeier":
        return mpmath.sqrt(
            1 + n + sum(b * square / (square - mpmath.mpf(c) ** 2) for b, c in terms)
        )
    if formula == "sellmeier squared":
        return mpmath.sqrt(1 + n + sum(b * square / (square - mpmath.mpf(c)) for b, c in terms))
    series = n + sum(mpmath.mpf(a) * wavelength**e for a, e in terms)
    return mpmath.sqrt(series) if formula == "polynomial" else series


# Malitson (1965), fused silica; Schott, N-BK7; Hoya, FCD1, with one more term; a Cauchy series.
CASES = {
    "sellmeier": (sellmeier, 0.01, (
        (0.6961663, 0.0684043), (0.4079426, 0.1162414), (0.8974794, 9.896161))),
    "sellmeier squared": (sellmeier_squared, 0.0, (
        (1.03961212, 0.00600069867), (0.231792344, 0.0200179144), (1.01046945, 103.560653))),
    "polynomial": (polynomial, 2.21811314, (
        (-5.79942715e-3, 2.0), (8.34706797e-3, -2.0), (6.50465284e-5, -4.0), (8.51421839e-6, -6.0),
        (-5.88522718e-7, -8.0), (1.1e-8, -10.0), (2.0e-6, 4.0))),
    "cauchy": (cauchy, 1.44, ((0.0042, -2.0), (0.00011, -4.0), (3e-4, 1.5))),
}  # fmt: skip


@pytest.fixture(params=CASES)
def case(request):
    formula, constant, terms = CASES[request.param]

    def reference(wavelength):
        return exact(request.param, wavelength, constant, terms)

    with mpmath.workdps(50):
        points = [mpmath.mpf(float(w)) for w in MICROMETRES]
        yield (
            formula,
            constant,
            terms,
            [reference(w) for w in points],
            [mpmath.diff(reference, w) for w in points],
        )


def relative(value, reference):
    return abs(mpmath.mpf(float(value)) / reference - 1)


def test_index(case):
    formula, constant, terms, indices, _ = case
    tensor = formula(MICROMETRES, constant, terms)
    assert tensor.dtype == torch.float64 and tensor.shape == MICROMETRES.shape
    single = formula(MICROMETRES.float(), constant, terms)
    assert single.dtype == torch.float32
    for i, index in enumerate(indices):
        number = formula(float(MICROMETRES[i]), constant, terms)
        assert isinstance(number, float)
        assert relative(number, index) < 1e-15
        assert relative(tensor[i], index) < 1e-15
        assert relative(single[i], index) < 1e-6


def test_slope(case):
    formula, constant, terms, _, slopes = case
    wavelength = MICROMETRES.clone().requires_grad_()
    (reverse,) = torch.autograd.grad(formula(wavelength, constant, terms).sum(), wavelength)
    one = torch.ones_like(MICROMETRES)
    _, forward = torch.func.jvp(lambda w: formula(w, constant, terms), (MICROMETRES,), (one,))
    mapped = torch.func.vmap(torch.func.grad(lambda w: formula(w, constant, terms)))(MICROMETRES)
    for i, slope in enumerate(slopes):
        # The cubes of small differences of Sellmeier terms cost a digit or two.
        for value in (reverse[i], forward[i], mapped[i]):
            assert relative(value, slope) < 1e-13
