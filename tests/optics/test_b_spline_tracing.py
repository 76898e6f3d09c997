"""Rays through B-spline surfaces: as through the polynomials they equal, and at edges and knots."""

import math
from itertools import pairwise

import numpy as np
import pytest
import torch

from dolens import Rays, Status
from dolens.optics.surfaces import BSpline, Conic, XYPolynomial
from dolens.optics.surfaces.b_spline import clamped_knots, spline_sag
from dolens.optics.surfaces.refraction import PlaneRay
from dolens.prescriptions import lens_from_prescription
from tests.optics.spline_samples import F64, KNOTS, marsden, polynomial_spline, random

pytestmark = pytest.mark.usefixtures("backend")

# A plano-convex singlet whose front is a polynomial, of powers that a bicubic spline holds.
POWERS = {"x2": (2, 0), "y2": (0, 2), "xy": (1, 1), "x3": (3, 0), "x2y": (2, 1), "y3": (0, 3),
          "x2y2": (2, 2), "y": (0, 1)}  # fmt: skip
VALUES = {"x2": 0.012, "y2": 0.015, "xy": 2e-3, "x3": 1e-4, "x2y": -2e-4, "y3": 5e-5,
          "x2y2": 1e-5, "y": 0.01}  # fmt: skip


def singlet(front, semi_diameter=4.0, dtype=F64):
    front = {"semi_diameter": semi_diameter, "thickness": 3.0, "material": "1.5168/64.17", **front}
    back = {"type": "plane", "semi_diameter": 6.0, "material": "air"}
    surfaces = {"1": front, "2": back}
    return lens_from_prescription({"surfaces": surfaces, "sensor": {"distance": 30.0}}, dtype)


def spline_singlet(knots_x, knots_y, **options):
    c = polynomial_spline(knots_x, knots_y, {POWERS[k]: a for k, a in VALUES.items()})
    front = {"type": "b_spline", "coefficients": c.tolist(), "knots_x": knots_x, "knots_y": knots_y}
    return singlet(front, **options)


def pencil(count=60, dtype=F64):
    generator = torch.Generator().manual_seed(2)
    xy, slopes = torch.rand((2, count, 2), generator=generator, dtype=F64) * 2 - 1
    start = torch.cat((2.6 * xy, torch.zeros(count, 1, dtype=F64)), -1)
    direction = torch.cat((0.15 * slopes, torch.ones(count, 1, dtype=F64)), -1)
    direction = direction / direction.norm(dim=-1, keepdim=True)
    return Rays((start - 20 * direction).to(dtype), direction.to(dtype))


@pytest.mark.parametrize("name", KNOTS)
def test_a_spline_that_is_a_polynomial_traces_like_it(name):
    """Same sensor points, paths and gradients; the coefficients are linear in the polynomial's."""
    knots_x, knots_y = KNOTS[name], KNOTS["uneven"]
    spline, polynomial = (
        spline_singlet(knots_x, knots_y), singlet({"type": "xy_polynomial", **VALUES})
    )  # fmt: skip
    found, hits = {}, {}
    for lens in (spline, polynomial):
        rays = pencil()
        rays.position.requires_grad_()
        hit = hits[lens] = lens.trace(rays)
        assert hit.valid.all()
        weight = random(60, 2, seed=9)
        loss = (weight * hit.position[:, :2]).sum() + 0.1 * hit.path_length.sum()
        front = dict(lens.surfaces["1"].named_parameters())
        gradients = torch.autograd.grad(loss, (rays.position, *front.values()))
        found[lens] = gradients[0], dict(zip(front, gradients[1:], strict=True))
    a, b = hits[spline], hits[polynomial]
    assert (a.position - b.position).abs().max() < 1e-11
    assert (a.path_length - b.path_length).abs().max() < 1e-11
    assert (found[spline][0] - found[polynomial][0]).abs().max() < 1e-10
    for key, powers in POWERS.items():
        chain = polynomial_spline(knots_x, knots_y, {powers: 1.0})
        through = float((chain * found[spline][1]["coefficients"]).sum())
        assert through == pytest.approx(float(found[polynomial][1][key]), rel=1e-9), key
    for quantity in ("efl", "bfd"):
        first = [float(getattr(lens.first_order(), quantity).detach()) for lens in found]
        assert first[0] == pytest.approx(first[1], rel=1e-9)


def test_float32_is_off_by_its_own_rounding():
    """Sensor points within 10 nm, and slopes within 2e-7 though the knots are 0.06 mm apart."""
    knots = clamped_knots(5.0, 160)
    exact, rounded = (spline_singlet(knots, knots, dtype=dtype) for dtype in (F64, torch.float32))
    hit = rounded.trace(pencil(dtype=torch.float32))
    assert hit.position.dtype == torch.float32
    assert hit.valid.all()
    error = (hit.position.double() - exact.trace(pencil()).position)[:, :2].abs().max()
    assert error < 1e-5
    front = rounded.surfaces["1"]
    p = {**dict(front.named_parameters()), **dict(front.named_buffers())}
    x, y = pencil(2000).position[:, :2].float().unbind(-1)
    single = spline_sag(p, x, y)
    double = spline_sag({k: v.double() for k, v in p.items()}, x.double(), y.double())
    assert (single.s.double() - double.s).abs().max() < 1e-7
    for a, b in ((single.sx, double.sx), (single.sy, double.sy)):
        assert (a.double() - b).abs().max() < 2e-7


def on_axis_rays(*points):
    xy = torch.tensor(points, dtype=F64)
    position = torch.cat((xy, torch.full((len(xy), 1), -10.0, dtype=F64)), -1)
    return Rays(position.requires_grad_(), torch.tensor([[0.0, 0.0, 1.0]], dtype=F64))


def test_rays_on_and_beyond_the_edge_miss():
    knots = KNOTS["clamped"]
    lens = spline_singlet(knots, knots, semi_diameter=5.0)
    step = 1e-12
    rays = on_axis_rays((5 - step, 0), (0, step - 5), (5, 0), (0, -5), (5 + step, 0),
                        (4.9, 4.9), (5.1, 4.9), (9.0, -7.0), (0.0, 400.0), (1e5, 1e5))  # fmt: skip
    hit = lens.trace(rays)
    ok, cut, missed = Status.OK, Status.VIGNETTED, Status.MISSED
    assert hit.status.tolist() == [ok] * 2 + [missed] * 3 + [cut] + [missed] * 4
    assert hit.surface.tolist() == [0, 0] + [1] * 8
    parameters = list(lens.surfaces["1"].parameters())

    def gradients(hit):
        loss = (hit.position**2).sum() + hit.path_length.sum() + hit.direction.sum()
        return torch.autograd.grad(loss, (rays.position, *parameters))

    of_all = gradients(hit)
    assert all(torch.isfinite(v).all() for v in (hit.position, hit.path_length, *of_all))
    assert (of_all[0][2:] == 0).all()
    assert (of_all[0][:2] != 0).any(-1).all()
    only = lens.trace(Rays(rays.position[:2], rays.direction))
    assert torch.equal(of_all[1], gradients(only)[1])


def test_a_step_at_a_quadruple_knot_is_met_on_either_side():
    """Two flat terraces, 0.2 mm apart in height, with the knot on the upper one."""
    knots_x = [-5.0] * 4 + [0.0] * 4 + [5.0] * 4
    c = torch.zeros(4, 8, dtype=F64)
    c[:, 4:] = 0.2
    front = {"type": "b_spline", "coefficients": c.tolist(), "knots_x": knots_x, "half_width_y": 5}
    hit = singlet(front).trace(on_axis_rays((-1.0, 0), (-1e-9, 0), (0.0, 0), (2.0, 1)), record=True)
    assert hit.valid.all()
    assert hit.points[0, :, 2].tolist() == pytest.approx([0.0, 0.0, 0.2, 0.2], abs=1e-15)


@pytest.mark.parametrize("sense", [1.0, -1.0])
def test_a_roof_at_a_triple_knot_is_met_like_its_two_planes(sense):
    """s = 0.2·|x|; a ray meets x > 0 at t = 0.2·x0/(n - 0.2·l), x < 0 with the other sign."""
    knots = [-5.0] * 4 + [0.0] * 3 + [5.0] * 4
    c = 0.2 * np.abs(np.broadcast_to(marsden(knots, 1), (5, 7)))
    surface = BSpline(4.0, {"coefficients": c, "knots_x": knots, "half_width_y": 6.0})
    p = {**dict(surface.named_parameters()), **dict(surface.named_buffers())}
    x = torch.linspace(-3, 3, 100, dtype=F64)
    x0 = torch.cat((x, x))
    l = torch.cat((torch.full_like(x, 0.3), torch.full_like(x, -0.1)))  # noqa: E741
    n = sense * torch.sqrt(1 - l * l)
    t, met = surface.intersect(p, PlaneRay(x0, 0 * x0, l, 0 * l, n), sense, 4.0)
    side = x0.sign()  # the planes meet at the height of the vertex plane, so no ray changes sides
    assert (t - side * 0.2 * x0 / (n - side * 0.2 * l)).abs().max() < 1e-13
    assert (met > 0).all()


def test_a_spline_close_to_a_conic_bends_rays_like_it():
    """Not a polynomial: the spline's error falls as h⁴, and so does the ray's (slopes as h³)."""
    from dolens.optics.surfaces.spline_fit import fit_b_spline

    conic, grid = Conic(4.0, {"curvature": 0.05, "conic": -0.6}), np.linspace(-5, 5, 201)
    x = torch.tensor(grid)
    stored = {name: value.detach() for name, value in conic.named_parameters()}
    sag = Conic.sag_and_gradient(stored, x, x[:, None])[0].numpy()
    lens = singlet({"type": "conic", "radius": 20.0, "conic": -0.6})
    exact, errors = lens.trace(pencil()).position, []
    for count in (11, 19, 35):
        knots = clamped_knots(5.0, count)
        row = fit_b_spline(grid, grid, sag, knots, knots)
        errors.append(float((singlet(row).trace(pencil()).position - exact).detach().abs().max()))
    assert errors[2] < 2e-6
    for coarse, fine in pairwise(errors):
        assert 2.5 < math.log2(coarse / fine) < 5.0


def test_xy_polynomials_have_the_monomials_of_this_file():
    assert set(XYPolynomial.parameter_names(VALUES)) == set(POWERS)
