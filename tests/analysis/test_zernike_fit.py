"""Zernike polynomials and their fit over discs, rings and slivers."""

import math

import pytest
import torch

from dolens.analysis.zernike_fit import (
    zernike_fit,
    zernike_name,
    zernike_polynomials,
    zernike_terms,
)
from dolens.errors import InputError


def polar_grid(rings=20, azimuths=40, inner=0.0):
    """x, y and weights of Gauss's quadrature over a ring from `inner` to 1, of sum one."""
    from numpy.polynomial.legendre import leggauss

    nodes, shares = (torch.from_numpy(part) for part in leggauss(rings))
    square = 0.5 * (1.0 - inner**2) * (nodes + 1.0) + inner**2
    angle = torch.arange(azimuths).double() * (2.0 * math.pi / azimuths)
    radius = square.sqrt()[:, None]
    weight = (0.5 * shares)[:, None].expand(-1, azimuths) / azimuths
    return (radius * angle.cos()).flatten(), (radius * angle.sin()).flatten(), weight.flatten()


def test_standard_terms_are_orthonormal_over_the_disc():
    """Noll's have unit variance; fringe terms (2(n + 1)/(1 + δ_m0))^-½ of that."""
    x, y, weight = polar_grid()
    standard = zernike_polynomials(x, y, zernike_terms("standard", 37))
    gram = (standard * weight) @ standard.mT
    assert torch.allclose(gram, torch.eye(37).double(), atol=1e-12)
    terms = zernike_terms("fringe", 37)
    fringe = zernike_polynomials(x, y, terms)
    variance = torch.tensor([1.0 / ((t.n + 1.0) * (2.0 if t.m else 1.0)) for t in terms])
    assert torch.allclose((fringe * weight) @ fringe.mT, torch.diag(variance.double()), atol=1e-12)


def test_polynomials_are_those_of_textbooks():
    """Wyant and Creath, Applied Optics and Optical Engineering XI, table III."""
    x, y = torch.tensor([0.3, -0.5]).double(), torch.tensor([-0.6, 0.2]).double()
    rho2, angle = x * x + y * y, torch.atan2(y, x)
    rho = rho2.sqrt()
    found = zernike_polynomials(x, y, zernike_terms("fringe", 16))
    expected = {
        4: 2 * rho2 - 1,
        5: rho2 * torch.cos(2 * angle),
        6: rho2 * torch.sin(2 * angle),
        7: (3 * rho2 - 2) * rho * torch.cos(angle),
        8: (3 * rho2 - 2) * rho * torch.sin(angle),
        9: 6 * rho2**2 - 6 * rho2 + 1,
        11: rho**3 * torch.sin(3 * angle),
        12: (4 * rho2 - 3) * rho2 * torch.cos(2 * angle),
        15: (10 * rho2**2 - 12 * rho2 + 3) * rho * torch.sin(angle),
        16: 20 * rho2**3 - 30 * rho2**2 + 12 * rho2 - 1,
    }
    for number, values in expected.items():
        assert torch.allclose(found[number - 1], values, atol=1e-14), number


def test_terms_have_their_textbook_names():
    fringe = [zernike_name(term) for term in zernike_terms("fringe", 11)]
    assert fringe[:5] == ["piston", "tilt x", "tilt y", "defocus", "astigmatism 0°"]
    assert fringe[5:] == [
        *("astigmatism 45°", "coma x", "coma y", "spherical", "trefoil x", "trefoil y")
    ]
    standard = [zernike_name(term) for term in zernike_terms("standard", 22)]
    assert standard[4:8] == ["astigmatism 45°", "astigmatism 0°", "coma y", "coma x"]
    assert (standard[10], standard[21]) == ("spherical", "secondary spherical")
    assert len(set(map(zernike_name, zernike_terms("standard", 231)))) == 231


@pytest.mark.parametrize("order", ["fringe", "standard"])
@pytest.mark.parametrize("inner", [0.0, 0.4])
def test_a_combination_of_terms_is_found_again_over_disc_and_ring(order, inner):
    x, y, weight = polar_grid(inner=inner)
    known = torch.randn(3, 20).double()
    values = known @ zernike_polynomials(x, y, zernike_terms(order, 20))
    found = zernike_fit(values, x, y, weight, order, 20)
    assert torch.allclose(found.coefficients, known, atol=1e-11)
    assert float(found.residual_rms.max()) < 1e-13
    assert int(found.rank) == 20
    assert torch.allclose(found.values(x, y), values, atol=1e-12)


def test_over_a_ring_a_coefficient_depends_on_the_terms_beside_it():
    """ρ⁴ over a ring of inner radius ε: piston and defocus alone fit a line in t = ρ², whose slope
    is 1 + ε² (the chord's); over the disc that is 1, and no further term changes it.
    """
    for inner in (0.0, 0.5):
        x, y, weight = polar_grid(inner=inner)
        values = (x * x + y * y).square()
        alone = zernike_fit(values, x, y, weight, "fringe", 4).coefficients
        more = zernike_fit(values, x, y, weight, "fringe", 9).coefficients
        # ρ² = (Z4 + 1)/2, and ρ⁴ = (Z9 + 3·Z4 + 2)/6.
        assert float(alone[3]) == pytest.approx(0.5 * (1.0 + inner**2), abs=1e-12)
        assert float(more[3]) == pytest.approx(0.5, abs=1e-12)
        assert float(more[8]) == pytest.approx(1.0 / 6.0, abs=1e-12)


def test_the_residual_is_what_is_left():
    """Z9, fitted by eight terms, has RMS 1/√5."""
    x, y, weight = polar_grid()
    values = zernike_polynomials(x, y, zernike_terms("fringe", 9))[8]
    found = zernike_fit(values, x, y, weight, "fringe", 8)
    assert float(found.residual_rms) == pytest.approx(math.sqrt(0.2), rel=1e-12)
    assert float(found.coefficients.abs().max()) < 1e-12


def test_a_few_points_do_not_tell_many_terms_and_darkness_none():
    x, y = torch.tensor([0.1, 0.2, 0.5]).double(), torch.tensor([0.0, 0.3, 0.1]).double()
    found = zernike_fit(torch.ones(3).double(), x, y, torch.ones(3).double(), "fringe", 9)
    assert int(found.rank) == 3
    assert bool(found.coefficients.isfinite().all())
    dark = zernike_fit(torch.full((3,), math.nan).double(), x, y, torch.zeros(3).double())
    assert bool(dark.coefficients.isnan().all()) and math.isnan(float(dark.residual_rms))


def test_coefficients_are_linear_in_the_wavefront():
    """A coefficient's gradient, summed over a term, is one for its own and zero for others."""
    x, y, weight = polar_grid(8, 16)
    values = torch.zeros_like(x).requires_grad_()
    found = zernike_fit(values, x, y, weight, "standard", 11).coefficients
    (slope,) = torch.autograd.grad(found[10], values)
    terms = zernike_polynomials(x, y, zernike_terms("standard", 11))
    assert torch.allclose(terms @ slope, torch.eye(11).double()[10], atol=1e-12)


@pytest.mark.parametrize(
    ("order", "count", "said"),
    [("wyant", 9, "allowed: fringe"), ("fringe", 38, "1 to 37"), ("standard", 0, "1 to 231")],
)
def test_orders_and_numbers_of_terms_that_do_not_exist(order, count, said):
    with pytest.raises(InputError, match=said):
        zernike_terms(order, count)
