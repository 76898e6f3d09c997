"""Thin films against closed forms, 50 digits of a transfer matrix, and energy."""

import math

import mpmath
import pytest
import torch

from dolens.optics.thin_films import Layer, absorbed, amplitudes, shares

COSINES = torch.cos(torch.linspace(0.0, math.pi / 2.0, 31, dtype=torch.float64)).clamp(min=0.0)
SILVER = 0.055 + 3.32j
STACKS = {
    "bare glass": (1.0, [], 1.5),
    "out of glass, beyond the critical angle": (1.7, [], 1.0),
    "equal indices": (1.5, [], 1.5),
    "a layer of zero thickness": (1.0, [Layer(2.3, 0.0)], 1.5),
    "a layer of the glass itself": (1.0, [Layer(1.5, 217.0)], 1.5),
    "four layers": (
        1.0,
        [Layer(1.38, 92.0), Layer(2.1, 118.0), Layer(1.46, 33.0), Layer(2.3, 14.0)],
        1.52,
    ),
    "frustrated total reflection": (1.7, [Layer(1.0, 90.0)], 1.7),
    "silver": (1.0, [Layer(1.46, 60.0), Layer(SILVER, 35.0)], 1.5),
    "on an absorbing substrate": (1.0, [Layer(1.46, 250.0), Layer(2.0 + 0.3j, 80.0)], 3.9 + 0.03j),
    "an absorbing layer that is metres thick": (1.3, [Layer(2.0 + 0.1j, 3e9)], 1.5),
    "a clear layer that is metres thick": (1.3, [Layer(2.0, 3e9)], 1.5),
}


@pytest.mark.parametrize("name", STACKS)
@pytest.mark.parametrize(
    ("dtype", "bound"), [(torch.float64, 1e-12), (torch.float32, 2e-5)], ids=["double", "single"]
)
def test_what_is_reflected_passed_and_absorbed_is_all_the_light(name, dtype, bound):
    front, layers, behind = STACKS[name]
    cosines = COSINES.to(dtype)
    found = shares(front, layers, behind, cosines, 550.0)
    heat_s, heat_p = absorbed(front, layers, behind, cosines, 550.0)
    assert all(part.dtype is dtype and bool((part >= -bound).all()) for part in found)
    assert float((found.r_s + found.t_s + heat_s.sum(0) - 1.0).abs().max()) < bound
    assert float((found.r_p + found.t_p + heat_p.sum(0) - 1.0).abs().max()) < bound


def by_matrices(front, layers, behind, cosine, wavelength):
    """r_s, r_p, t_s, t_p by products of characteristic matrices (Born and Wolf 1.6), 50 digits."""
    with mpmath.workdps(50):
        n0, m = mpmath.mpf(front), mpmath.mpmathify(behind)
        beta2 = n0**2 * (1 - mpmath.mpf(cosine) ** 2)

        def normal(n):
            q = mpmath.sqrt(n**2 - beta2)
            return -q if mpmath.im(q) < 0 or (mpmath.im(q) == 0 and mpmath.re(q) < 0) else q

        found = {}
        for name, admittance in (("s", normal), ("p", lambda n: n**2 / normal(n))):
            matrix = mpmath.eye(2)
            for layer in layers:
                n = mpmath.mpmathify(layer.index)
                phase = 2 * mpmath.pi * normal(n) * mpmath.mpf(layer.thickness) / wavelength
                y, c, s = admittance(n), mpmath.cos(phase), mpmath.sin(phase)
                matrix = matrix * mpmath.matrix([[c, -1j * s / y], [-1j * y * s, c]])
            b, h = (
                matrix[0, 0] + matrix[0, 1] * admittance(m),
                (matrix[1, 0] + matrix[1, 1] * admittance(m)),
            )
            y0 = admittance(n0)
            # Tangential fields: along the films p is E·cos θ, and reflected p has the other sign.
            sign = 1 if name == "s" else -1
            found["r_" + name] = sign * (y0 * b - h) / (y0 * b + h)
            turn = 1 if name == "s" else (normal(n0) / n0) / (normal(m) / m)
            found["t_" + name] = 2 * y0 / (y0 * b + h) * turn
        return [complex(found[key]) for key in ("r_s", "r_p", "t_s", "t_p")]


@pytest.mark.parametrize("name", [n for n in STACKS if "metres" not in n])
@pytest.mark.parametrize("cosine", [1.0, 0.83, 0.4, 0.05])
def test_amplitudes_are_those_of_matrices_in_50_digits(name, cosine):
    front, layers, behind = STACKS[name]
    given = torch.tensor(cosine, dtype=torch.float64)
    found = amplitudes(front, layers, behind, given, 550.0)
    known = by_matrices(front, layers, behind, cosine, 550.0)
    assert max(abs(complex(a) - b) for a, b in zip(found, known, strict=True)) < 1e-13


def test_metres_of_an_absorbing_film_reflect_as_its_front_does():
    front, layers, _ = STACKS["an absorbing layer that is metres thick"]
    thick = amplitudes(front, layers, 1.5, COSINES, 550.0)
    half_space = amplitudes(front, [], layers[0].index, COSINES, 550.0)
    assert torch.equal(thick.r_s, half_space.r_s) and torch.equal(thick.r_p, half_space.r_p)
    assert not bool(thick.t_s.abs().any()) and not bool(thick.t_p.abs().any())


def test_equal_indices_reflect_exactly_nothing():
    found = shares(1.5168, [Layer(1.5168, 200.0)], 1.5168, COSINES, 550.0)
    assert not bool(found.r_s.any()) and not bool(found.r_p.any())


def test_brewster_s_angle():
    angle = math.atan(1.5)
    cosine = torch.tensor(math.cos(angle), dtype=torch.float64)
    found = amplitudes(1.0, [], 1.5, cosine, 550.0)
    assert abs(complex(found.r_p)) < 1e-16
    # r_s = -cos 2θ_B there.
    assert complex(found.r_s) == pytest.approx(math.cos(2 * angle), rel=1e-14)


def test_the_phase_of_total_reflection():
    """tan(δ_s/2) = -√(sin²θ - n²)/cos θ, and p's likewise (Born and Wolf 1.5.4)."""
    n, angle = 1.0 / 1.51, math.radians(54.6)
    cosine = torch.tensor(math.cos(angle), dtype=torch.float64)
    found = amplitudes(1.51, [], 1.0, cosine, 550.0)
    root = math.sqrt(math.sin(angle) ** 2 - n * n)
    s, p = (2.0 * math.atan(root / (a * math.cos(angle))) for a in (1.0, n * n))
    delta = [math.atan2(complex(r).imag, complex(r).real) for r in (found.r_s, found.r_p)]
    # exp(-iωt) turns Born and Wolf's phases round; a rhomb of two such reflections is λ/4.
    assert delta[0] == pytest.approx(-s, rel=1e-13)
    assert abs(complex(found.r_p)) == pytest.approx(1.0, rel=1e-14)
    assert (delta[1] - delta[0]) % math.pi == pytest.approx((s - p) % math.pi, rel=1e-12)
    assert math.degrees(p - s) == pytest.approx(45.0, abs=0.1)


@pytest.mark.parametrize("pairs", [0, 1, 3, 8])
def test_a_quarter_wave_stack_has_its_closed_form(pairs):
    """R = ((1 - Y)/(1 + Y))² with Y = n_s·(n_H/n_L)^(2N) (Macleod, Thin-Film Optical Filters)."""
    layers = pairs * [Layer(2.3, 550.0 / 4 / 2.3), Layer(1.38, 550.0 / 4 / 1.38)]
    found = shares(1.0, layers, 1.52, torch.ones((), dtype=torch.float64), 550.0)
    y = 1.52 * (2.3 / 1.38) ** (2 * pairs)
    assert float(found.r_s) == pytest.approx(((1 - y) / (1 + y)) ** 2, rel=1e-12)
    assert float(found.r_p) == pytest.approx(float(found.r_s), rel=1e-12)


def test_a_quarter_wave_of_the_geometric_mean_reflects_nothing():
    n = math.sqrt(1.52)
    one = torch.ones((), dtype=torch.float64)
    assert float(shares(1.0, [Layer(n, 550.0 / 4 / n)], 1.52, one, 550.0).r_s) < 1e-30


def test_a_half_wave_layer_is_not_there():
    one = torch.ones((), dtype=torch.float64)
    with_layer = shares(1.0, [Layer(2.0, 137.5)], 1.52, one, 550.0)
    assert float(with_layer.r_s) == pytest.approx((0.52 / 2.52) ** 2, rel=1e-12)


def test_light_passes_alike_both_ways():
    front, layers, behind = STACKS["four layers"]
    cosines = COSINES[:-1]
    there = shares(front, layers, behind, cosines, 550.0)
    inside = (1.0 - (front / behind) ** 2 * (1.0 - cosines.square())).sqrt()
    back = shares(behind, layers[::-1], front, inside, 550.0)
    assert float((there.t_s - back.t_s).abs().max()) < 1e-13
    assert float((there.t_p - back.t_p).abs().max()) < 1e-13


def test_derivatives_are_those_of_differences():
    real = {"dtype": torch.float64, "requires_grad": True}
    cosine = torch.tensor([0.3, 0.7, 1.0 - 1e-5], **real)
    thickness = torch.tensor([100.0, 30.0], **real)
    n = torch.tensor([1.0, 2.1, 1.4, 1.6], **real)
    k, wavelength = torch.tensor(0.3, **real), torch.tensor(550.0, **real)

    def everything(cosine, thickness, n, k, wavelength):
        layers = [Layer(n[1], thickness[0]), Layer(torch.complex(n[2], k), thickness[1])]
        found = shares(n[0], layers, n[3], cosine, wavelength)
        heat = absorbed(n[0], layers, n[3], cosine, wavelength)
        return torch.stack([*found, *heat[0], *heat[1]])

    inputs = (cosine, thickness, n, k, wavelength)
    assert torch.autograd.gradcheck(everything, inputs)
    assert torch.autograd.gradgradcheck(everything, inputs)


def test_the_derivative_at_normal_incidence_is_the_one_beside_it():
    def slope(value):
        cosine = torch.tensor(value, dtype=torch.float64, requires_grad=True)
        found = shares(1.0, [Layer(1.38, 99.6)], 1.52, cosine, 700.0)
        return float(torch.autograd.grad(found.t_s + found.t_p, cosine)[0])

    assert slope(1.0) == pytest.approx(slope(1.0 - 1e-9), rel=1e-6)
