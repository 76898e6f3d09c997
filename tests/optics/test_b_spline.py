"""The B-spline surface against its definition, SciPy's splines, and polynomials it must equal."""

import math

import mpmath
import numpy as np
import pytest
import torch
from torch.func import grad, jacfwd, jvp, vmap
from torch.utils._python_dispatch import TorchDispatchMode

from dolens import InputError
from dolens.optics.surfaces import BSpline
from dolens.optics.surfaces.b_spline import clamped_knots, cubic_basis, spline_sag
from tests.optics.spline_samples import (
    F64,
    KNOTS,
    parameters,
    places,
    polynomial_spline,
    random,
    scipy_basis,
)


@pytest.mark.parametrize("y_name", ["clamped", "repeated"])
@pytest.mark.parametrize("x_name", KNOTS)
def test_sag_slopes_and_curvature_are_scipys(x_name, y_name):
    """On a grid of points that holds the edges, the corners and all knots."""
    knots_x, knots_y = KNOTS[x_name], KNOTS[y_name]
    p = parameters(knots_x, knots_y)
    x, y = places(knots_x), places(knots_y)
    found = spline_sag(p, x, y[:, None], second=True)
    for value, (i, j) in zip(found, [(0, 0), (1, 0), (0, 1), (2, 0), (1, 1), (0, 2)], strict=True):
        by, bx = scipy_basis(knots_y, y, j), scipy_basis(knots_x, x, i)
        expected = by @ p["coefficients"].numpy() @ bx.T
        # Sums of large terms of both signs: rounding is relative to their magnitudes.
        size = np.abs(by) @ np.abs(p["coefficients"].numpy()) @ np.abs(bx.T)
        assert (np.abs(value.numpy() - expected) <= 1e-13 * np.maximum(size, 1.0)).all(), (i, j)


def definition(knots, i, degree, u):
    """N_i by Cox and de Boor to 50 digits, 0/0 = 0, the branch on the right at a knot."""
    t = [mpmath.mpf(k) for k in knots]
    if degree == 0:
        return mpmath.mpf(int(t[i] <= u < t[i + 1]))
    total = mpmath.mpf(0)
    if t[i + degree] > t[i]:
        total += (u - t[i]) / (t[i + degree] - t[i]) * definition(knots, i, degree - 1, u)
    if t[i + degree + 1] > t[i + 1]:
        rest = (t[i + degree + 1] - u) / (t[i + degree + 1] - t[i + 1])
        total += rest * definition(knots, i + 1, degree - 1, u)
    return total


@pytest.mark.parametrize("name", KNOTS)
def test_the_basis_is_its_definition(name):
    knots = KNOTS[name]
    u = places(knots)[:-1]
    basis = cubic_basis(torch.tensor(knots, dtype=F64), u)
    with mpmath.workdps(50):
        for k, point in enumerate(u.tolist()):
            exact = [definition(knots, i, 3, mpmath.mpf(point)) for i in range(len(knots) - 4)]
            first = int(basis.first[k])
            for i, value in enumerate(exact):
                found = basis.value[i - first, k] if 0 <= i - first < 4 else 0.0
                assert abs(mpmath.mpf(float(found)) - value) < 1e-15


@pytest.mark.parametrize("name", KNOTS)
def test_the_basis_is_a_partition_of_one(name):
    """Inside, at the ends and beyond; so its derivatives sum to zero."""
    knots = torch.tensor(KNOTS[name], dtype=F64)
    u = torch.cat((places(KNOTS[name]), torch.tensor([-40.0, 33.0], dtype=F64)))
    basis = cubic_basis(knots, u, second=True)
    assert (basis.value.sum(0) - 1).abs().max() < 5e-14
    assert (basis.slope.sum(0) / basis.slope.abs().sum(0)).abs().max() < 1e-15
    second = basis.second_derivative
    assert (second.sum(0) / second.abs().sum(0).clamp(min=1e-9)).abs().max() < 1e-15
    inside = (u >= knots[3]) & (u <= knots[-4])
    assert basis.value[:, inside].min() >= 0.0


@pytest.mark.parametrize("y_name", ["uneven", "repeated"])
@pytest.mark.parametrize("x_name", KNOTS)
def test_every_bicubic_polynomial_is_a_spline(x_name, y_name):
    knots_x, knots_y = KNOTS[x_name], KNOTS[y_name]
    monomials = {(i, j): 0.2 ** (i + j) * (1 + i - 2 * j) for i in range(4) for j in range(4)}
    p = parameters(knots_x, knots_y)
    p["coefficients"] = polynomial_spline(knots_x, knots_y, monomials)
    x, y = places(knots_x), places(knots_y)[:, None]

    def derivative(i, j):
        return sum(
            a * math.perm(k, i) * math.perm(m, j) * x ** max(k - i, 0) * y ** max(m - j, 0)
            for (k, m), a in monomials.items()
        )

    found = spline_sag(p, x, y, second=True)
    for value, orders in zip(found, [(0, 0), (1, 0), (0, 1), (2, 0), (1, 1), (0, 2)], strict=True):
        # Uneven knots 0.01 mm apart amplify rounding of the coefficients in second derivatives.
        allowed = (2e-13, 1e-12, 2e-9)[sum(orders)]
        assert (value - derivative(*orders)).abs().max() < allowed, orders


def test_beyond_the_rectangle_the_surface_goes_on_straight():
    knots_x, knots_y = KNOTS["uneven"], KNOTS["repeated"]
    p = parameters(knots_x, knots_y)
    edge_x, edge_y = torch.tensor(5.0, dtype=F64), torch.tensor(-5.0, dtype=F64)
    y = torch.linspace(-5, 5, 23, dtype=F64)
    at = spline_sag(p, edge_x, y, second=True)
    out = spline_sag(p, edge_x + 3.0, y, second=True)
    assert (out.s - (at.s + 3.0 * at.sx)).abs().max() < 1e-12
    assert (out.sx - at.sx).abs().max() < 1e-12
    assert (out.sy - (at.sy + 3.0 * at.sxy)).abs().max() < 1e-11
    assert (out.sxx == 0).all()
    corner = spline_sag(p, edge_x, edge_y, second=True)
    out = spline_sag(p, edge_x + 3.0, edge_y - 2.0, second=True)
    straight = corner.s + 3.0 * corner.sx - 2.0 * corner.sy - 6.0 * corner.sxy
    assert float(out.s) == pytest.approx(float(straight), abs=1e-12)
    assert float(out.sx) == pytest.approx(float(corner.sx - 2.0 * corner.sxy), abs=1e-12)
    assert float(out.sy) == pytest.approx(float(corner.sy + 3.0 * corner.sxy), abs=1e-12)


@pytest.mark.parametrize("offset", [(0.0, 1e-8), (1e-8, 0.0), (1e-8, 1e-8)])
def test_value_and_slopes_are_continuous_across_edges_and_corners(offset):
    p = parameters(KNOTS["clamped"], KNOTS["uneven"])
    for corner in ((5.0, 5.0), (-5.0, 5.0), (5.0, -5.0), (-5.0, -5.0), (5.0, 1.0), (-2.0, -5.0)):
        x, y = torch.tensor(corner, dtype=F64)
        inside = spline_sag(p, x - offset[0] * x.sign(), y - offset[1] * y.sign())
        outside = spline_sag(p, x + offset[0] * x.sign(), y + offset[1] * y.sign())
        for a, b in zip(inside[:3], outside[:3], strict=True):
            assert float((a - b).abs()) < 1e-5


def test_far_away_numbers_and_gradients_are_finite():
    p = parameters(KNOTS["repeated"], KNOTS["repeated"])
    p = {name: value.float() for name, value in p.items()}
    p["coefficients"].requires_grad_()
    x = torch.tensor([8e3, -8e3, 8e3, 0.0], requires_grad=True)
    y = torch.tensor([8e3, 8e3, 0.0, -8e3], requires_grad=True)
    found = spline_sag(p, x, y, second=True)
    gradients = torch.autograd.grad(sum(v.sum() for v in found), (x, y, p["coefficients"]))
    for value in (*found, *gradients):
        assert torch.isfinite(value).all()


def test_the_margin_is_the_distance_to_the_edge():
    p = parameters(KNOTS["clamped"], KNOTS["clamped"])
    x = torch.tensor([0.0, 4.75, -4.75, 1.0, 5.0, -5.0, 5.5, 7.0], dtype=F64)
    y = torch.tensor([0.0, 0.0, 4.0, -4.5, 1.0, -5.0, 0.0, -5.25], dtype=F64)
    margin = BSpline.sag_and_gradient(p, x, y)[3]
    assert margin.tolist() == [5.0, 0.25, 0.25, 0.5, 0.0, 0.0, -0.5, -2.0]


@pytest.mark.parametrize("name", ["clamped", "repeated"])
def test_first_and_second_gradients(name):
    """Against finite differences, on both sides of the edges and in every span."""
    p = parameters(KNOTS[name], KNOTS["uneven"])
    points = torch.tensor([-6.0, -4.2, -2.1, -0.4, 0.7, 1.9, 4.6, 5.7], dtype=F64)
    x, y = points.clone().requires_grad_(), (points.flip(0) + 0.05).requires_grad_()

    def sag(c, x, y):
        return spline_sag({**p, "coefficients": c}, x, y)[:3]

    inputs = (p["coefficients"].requires_grad_(), x, y)
    assert torch.autograd.gradcheck(sag, inputs)
    assert torch.autograd.gradgradcheck(sag, inputs, atol=1e-4)


def test_differentiation_of_the_sag_gives_its_slopes_and_curvature():
    """At the edges too, where the derivatives are those inside."""
    p = parameters(KNOTS["repeated"], KNOTS["uneven"])
    x = torch.linspace(-6, 6, 37, dtype=F64)
    y = 0.9 * x.flip(0) + 0.01
    assert {-5.0, 5.0} <= set(x.tolist())
    sag = spline_sag(p, x, y, second=True)
    one = torch.ones_like(x)
    for along_x, along_y, first, bend in (
        (one, 0 * one, sag.sx, sag.sxx),
        (0 * one, one, sag.sy, sag.syy),
    ):
        _, slopes = jvp(lambda x, y: spline_sag(p, x, y)[:3], (x, y), (along_x, along_y))
        assert (slopes[0] - first).abs().max() < 1e-12
        second = slopes[1] if first is sag.sx else slopes[2]
        assert ((second - bend).abs() <= 1e-12 * (1 + bend.abs())).all()
    diagonal = vmap(jacfwd(lambda x, y: spline_sag(p, x, y).s, argnums=(0, 1)))(x, y)
    assert (diagonal[0] - sag.sx).abs().max() < 1e-12
    twice = vmap(grad(grad(lambda x, y: spline_sag(p, x, y).s), argnums=1))(x, y)
    assert (twice - sag.sxy).abs().max() < 1e-10


def test_a_batch_of_surfaces_is_each_of_them():
    p = parameters(KNOTS["clamped"], KNOTS["uneven"])
    batch = random(3, *p["coefficients"].shape, seed=5)
    x, y = torch.linspace(-5, 6, 11, dtype=F64), torch.linspace(4, -5, 11, dtype=F64)

    def sag(c, x, y):
        return spline_sag({**p, "coefficients": c}, x, y, second=True)

    together = vmap(sag, in_dims=(0, None, None))(batch, x, y)
    each = [sag(c, x, y) for c in batch]
    for k, values in enumerate(together):
        assert (values - torch.stack([row[k] for row in each])).abs().max() < 1e-15
    gradients = vmap(grad(lambda c, x, y: sag(c, x, y).s.sum()), in_dims=(0, None, None))(
        batch, x, y
    )
    assert gradients.shape == batch.shape
    by_ray = vmap(sag, in_dims=(None, 0, 0))(batch[0], x, y)
    assert (by_ray.s - each[0].s).abs().max() < 1e-15


class Recorder(TorchDispatchMode):
    """Every operation that makes numbers (views make none), and how many it makes."""

    def __init__(self):
        super().__init__()
        self.made = []

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        out = func(*args, **(kwargs or {}))
        if isinstance(out, torch.Tensor) and func._schema.returns[0].alias_info is None:
            self.made.append((str(func), out.numel()))
        return out


def test_the_cost_does_not_depend_on_the_number_of_knots():
    made = []
    x = torch.linspace(-4, 4, 50, dtype=F64, requires_grad=True)
    for count in (8, 200):
        knots = clamped_knots(5.0, count)
        p = parameters(knots, knots)
        p["coefficients"].requires_grad_()
        with Recorder() as forward:
            sag = spline_sag(p, x, 0.9 * x, second=True)
        with Recorder() as backward:
            torch.autograd.grad(sag.s.sum(), (x, p["coefficients"]))
        # The gradient itself is as large as the coefficients are many.
        size = p["coefficients"].numel()
        kept = [row for row in backward.made if row[1] != size]
        made.append((forward.made, kept, len(backward.made) - len(kept)))
    assert len(made[0][0]) > 20
    assert max(numbers for _, numbers in made[0][0]) == 16 * 50
    assert made[0] == made[1]
    assert made[0][2] == 2  # zeros, and the sum of the rays' shares


def test_paraxial_curvature_is_the_mean_over_azimuth():
    knots = KNOTS["uneven"]
    c = polynomial_spline(knots, knots, {(2, 0): 0.01, (0, 2): 0.03, (1, 1): 0.02, (3, 0): 1e-3})
    surface = BSpline(4.5, {"coefficients": c, "knots_x": knots, "knots_y": knots})
    p = {**dict(surface.named_parameters()), **dict(surface.named_buffers())}
    # s_xx = 0.02 and s_yy = 0.06.
    assert float(BSpline.paraxial_curvature(p).detach()) == pytest.approx(0.04, rel=1e-10)

    def curvature(c):
        return BSpline.paraxial_curvature({**p, "coefficients": c})

    assert torch.autograd.gradcheck(curvature, c.requires_grad_())


FOUR = [[0.0] * 4 for _ in range(4)]
BAD = {
    "no coefficients": ({"half_width": 5.0}, "'coefficients' are missing"),
    "no knots": ({"coefficients": FOUR}, "give one of 'knots_x', 'half_width_x' and 'half_width'"),
    "knots of one axis": ({"coefficients": FOUR, "knots_x": KNOTS["one span"]},
                          "give one of 'knots_y', 'half_width_y' and 'half_width' .mm., not none"),
    "knots twice": ({"coefficients": FOUR, "half_width": 5.0, "knots_x": KNOTS["one span"]},
                    "not 'knots_x' and 'half_width'"),
    "three rows": ({"coefficients": FOUR[:3], "half_width": 5.0},
                   "at least 4 rows .y. of at least 4 numbers .x., not 3 × 4"),
    "one number": ({"coefficients": 1.0, "half_width": 5.0}, "not one number"),
    "a cube": ({"coefficients": [FOUR], "half_width": 5.0}, "not 1 × 4 × 4"),
    "ragged rows": ({"coefficients": [[0.0] * 4, [0.0] * 5] * 2, "half_width": 5.0},
                    "'coefficients' must be numbers, in rows of equal length"),
    "words": ({"coefficients": "flat", "half_width": 5.0}, "'coefficients' must be numbers"),
    "no width": ({"coefficients": FOUR, "half_width": 0.0}, "half width must be a positive number"),
    "too narrow": ({"coefficients": FOUR, "half_width": 3.9},
                   "the aperture reaches 4 mm and exceeds the surface, whose knots 'knots_x' end"),
    "unknown name": ({"coefficients": FOUR, "half_width": 5.0, "curvature": 0.1},
                     "b_spline: unknown key 'curvature'"),
}  # fmt: skip


@pytest.mark.parametrize("case", BAD)
def test_bad_surfaces(case):
    given, said = BAD[case]
    with pytest.raises(InputError, match=said) as error:
        BSpline(4.0, given)
    assert "\n" not in str(error.value)


BAD_KNOTS = {
    "too few": ([-5.0] * 4 + [5.0] * 3, "'knots_y' must have 8 knots, 4 more than .* not 7"),
    "decreasing": ([-5.0, -5, -5, -5, 5, 4, 5, 5], "must not decrease, as from 5 to 4"),
    "not a number": ([-5.0, -5, -5, math.nan, 5, 5, 5, 5], "'knots_y' must be finite"),
    "infinite": ([-5.0, -5, -5, -5, 5, 5, 5, math.inf], "'knots_y' must be finite"),
    "nearly repeated": ([-5.0, -5, -5, -5, 5, 5, 5, 5.000001],
                        "too close; repeat a knot exactly, or leave 1e-05 mm between"),
    "no width": ([1.0] * 8, "knot 1 is repeated more than 4 times"),
    "ended early": ([-5.0, -5, -5, -4, -4, 5, 5, 5], "-4 ends the spline"),
    "nested": ([[-5.0] * 4, [5.0] * 4], "'knots_y' must be one list of numbers"),
}  # fmt: skip


@pytest.mark.parametrize("case", BAD_KNOTS)
def test_bad_knots(case):
    knots, said = BAD_KNOTS[case]
    with pytest.raises(InputError, match=said) as error:
        BSpline(4.0, {"coefficients": FOUR, "half_width_x": 5.0, "knots_y": knots})
    assert "\n" not in str(error.value)


def test_a_knot_of_multiplicity_five_is_refused():
    knots = [-5.0] * 4 + [0.0] * 5 + [5.0] * 4
    with pytest.raises(InputError, match="knot 0 is repeated more than 4 times"):
        BSpline(4.0, {"coefficients": [[0.0] * 9] * 4, "knots_x": knots, "half_width_y": 5.0})


def test_clamped_knots_are_symmetric():
    for count in (4, 7, 10, 33):
        knots = clamped_knots(0.7, count)
        assert len(knots) == count + 4
        assert knots == [-k for k in reversed(knots)]
        assert knots[:4] == [-0.7] * 4
    with pytest.raises(InputError, match="at least 4 coefficients a side, not 3"):
        clamped_knots(1.0, 3)
