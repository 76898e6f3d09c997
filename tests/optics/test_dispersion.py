"""Dispersion formulas and their slopes against the same formulas at 50 digits."""

import mpmath
import pytest
import torch

from dolens.optics.dispersion import cauchy, polynomial, sellmeier, sellmeier_squared

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
