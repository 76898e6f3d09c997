"""Model glass by nd, Vd and ΔPgF: what it is given comes back, and real glass is near."""

import mpmath
import pytest
import torch

from dolens import InputError
from dolens.optics.glass_catalog import find_glass
from dolens.optics.materials import abbe_number, index_d, index_model, parse_material

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
