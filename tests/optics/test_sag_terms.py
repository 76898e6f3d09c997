"""Odd aspheres, biconics, toroids, Zernike and Forbes surfaces: closed forms, published tables."""

import math

import mpmath
import pytest
import torch

from dolens import InputError, Rays, Status
from dolens.optics.surfaces import (
    SURFACES,
    Biconic,
    Conic,
    EvenAsphere,
    OddAsphere,
    QBfs,
    QCon,
    Sphere,
    Toroid,
    ZernikeFringe,
    ZernikeStandard,
)
from dolens.optics.surfaces.forbes import _factors, to_auxiliary
from dolens.optics.surfaces.zernike import fringe, jacobi, noll
from dolens.prescriptions import lens_from_prescription, prescription_of
from tests.optics.exact_sags import mp, q_bfs_polynomial

F64 = torch.float64


def numbers(**values):
    return {name: torch.tensor(value, dtype=F64) for name, value in values.items()}


def points(radius=8.0, count=400):
    generator = torch.Generator().manual_seed(7)
    x, y = radius * (2.0 * torch.rand((2, count), generator=generator, dtype=F64) - 1.0)
    inside = x * x + y * y < radius * radius
    return x[inside], y[inside]


def require_same_surface(one, p, other, q, radius=8.0):
    """Same sag and slopes to rounding."""
    x, y = points(radius)
    for a, b in zip(
        one.sag_and_gradient(p, x, y)[:3], other.sag_and_gradient(q, x, y)[:3], strict=True
    ):
        assert (a - b).abs().max() < 4e-15 * (1.0 + float(b.abs().max()))


def test_an_odd_asphere_of_even_powers_is_an_even_asphere():
    p = numbers(curvature=0.04, conic=-0.7, a2=1e-3, a4=-2e-5, a6=1e-7)
    require_same_surface(OddAsphere, p, EvenAsphere, p)


def test_a_square_term_alone_is_a_paraboloid():
    require_same_surface(
        EvenAsphere,
        numbers(curvature=0.0, conic=0.0, a2=0.025),
        Conic,
        numbers(curvature=0.05, conic=-1.0),
    )


def test_a_biconic_of_equal_sections_is_a_conic_of_revolution():
    p = numbers(curvature_x=-0.06, curvature_y=-0.06, conic_x=0.4, conic_y=0.4)
    require_same_surface(Biconic, p, Conic, numbers(curvature=-0.06, conic=0.4))


@pytest.mark.parametrize("radius", [20.0, -11.0])
def test_a_toroid_of_equal_radii_is_a_sphere(radius):
    p = numbers(curvature_x=1 / radius, curvature_y=1 / radius, conic_y=0.0)
    require_same_surface(Toroid, p, Sphere, numbers(curvature=1 / radius))


def test_a_toroid_about_an_infinite_radius_and_a_flat_biconic_are_cylinders():
    x, y = points()
    sag, sx, sy, _ = Toroid.sag_and_gradient(
        numbers(curvature_x=0.0, curvature_y=0.1, conic_y=0.0), x, y
    )
    assert (sag - (10.0 - (100.0 - y * y).sqrt())).abs().max() < 4e-15
    assert (sx == 0.0).all()
    assert (sy - y / (100.0 - y * y).sqrt()).abs().max() < 4e-15
    crossed = numbers(curvature_x=0.1, curvature_y=0.0, conic_x=0.0, conic_y=0.0)
    across, *_ = Biconic.sag_and_gradient(crossed, y, x)
    assert (across - sag).abs().max() < 4e-15


def axicon(slope, index="1.5/.inf"):
    surfaces = {
        "1": {"type": "plane", "semi_diameter": 5.0, "thickness": 2.0, "material": "1.5"},
        "2": {"type": "odd_asphere", "radius": math.inf, "a1": slope, "semi_diameter": 5.0,
              "material": "air"},
    }  # fmt: skip
    return lens_from_prescription({"surfaces": surfaces, "sensor": {"distance": 30.0}})


def test_an_axicon_turns_all_rays_by_one_angle_towards_its_axis():
    lens = axicon(-0.1)
    x, y = points(4.9)
    start = torch.stack([x, y, torch.full_like(x, -1.0)], -1)
    hit = lens.trace(Rays(start, torch.tensor([0.0, 0.0, 1.0], dtype=F64)))
    assert hit.valid.all()
    base = math.atan(0.1)
    turned = math.asin(1.5 * math.sin(base)) - base
    r = torch.hypot(x, y)
    inwards = -(hit.direction[:, 0] * x + hit.direction[:, 1] * y) / r
    assert (inwards - math.sin(turned)).abs().max() < 1e-14


def test_at_the_vertex_of_an_axicon_the_normal_is_along_the_axis_and_derivatives_are_finite():
    lens = axicon(-0.1)
    hit = lens.trace(Rays(*torch.tensor([[0.0, 0.0, -1.0], [0.0, 0.0, 1.0]], dtype=F64)))
    assert bool(hit.valid) and Status(int(hit.status)) == Status.OK
    assert torch.equal(hit.direction, torch.tensor([0.0, 0.0, 1.0], dtype=F64))
    found = torch.autograd.grad(hit.position.sum(), list(lens.parameters()), allow_unused=True)
    assert all(g is None or bool(torch.isfinite(g).all()) for g in found)


def test_a_cusp_has_no_paraxial_curvature():
    p = numbers(curvature=0.1, conic=0.0, a1=0.0, a2=0.01, a3=0.0)
    assert float(OddAsphere.paraxial_curvature(p)) == pytest.approx(0.12, rel=1e-15)
    assert math.isfinite(float(OddAsphere.fourth_order_departure(p)))
    assert math.isnan(float(OddAsphere.paraxial_curvature(p | numbers(a1=1e-3))))
    assert math.isnan(float(OddAsphere.fourth_order_departure(p | numbers(a3=1e-3))))
    assert math.isfinite(float(OddAsphere.paraxial_curvature(p | numbers(a3=1e-3))))


NOLL_TABLE = {  # number → n, m and sine, as Noll's Table I has them
    1: (0, 0, False), 2: (1, 1, False), 3: (1, 1, True), 4: (2, 0, False), 5: (2, 2, True),
    6: (2, 2, False), 7: (3, 1, True), 8: (3, 1, False), 9: (3, 3, True), 10: (3, 3, False),
    11: (4, 0, False), 12: (4, 2, False), 13: (4, 2, True), 14: (4, 4, False), 15: (4, 4, True),
    22: (6, 0, False),
}  # fmt: skip
FRINGE_TABLE = {  # as Wyant and Creath's table has them
    1: (0, 0, False), 2: (1, 1, False), 3: (1, 1, True), 4: (2, 0, False), 5: (2, 2, False),
    6: (2, 2, True), 7: (3, 1, False), 8: (3, 1, True), 9: (4, 0, False), 10: (3, 3, False),
    11: (3, 3, True), 12: (4, 2, False), 15: (5, 1, True), 16: (6, 0, False), 17: (4, 4, False),
    25: (8, 0, False), 36: (10, 0, False), 37: (12, 0, False),
}  # fmt: skip


@pytest.mark.parametrize(("order", "table"), [(noll, NOLL_TABLE), (fringe, FRINGE_TABLE)])
def test_zernike_terms_are_numbered_as_published(order, table):
    for number, expected in table.items():
        assert tuple(order(number))[:3] == expected


def zernike(shape, number, x, y, radius=1.0):
    p = numbers(curvature=0.0, conic=0.0, normalization_radius=radius, decenter_x=0.0,
                decenter_y=0.0) | numbers(**{f"z{number}": 1.0})  # fmt: skip
    return shape.sag_and_gradient(p, x, y)[0]


def test_standard_zernike_polynomials_are_orthonormal_over_the_disc():
    """By Gauss's rule in ρ² and equal steps in φ, exact for these degrees."""
    import numpy as np

    node, weight = (torch.from_numpy(a) for a in np.polynomial.legendre.leggauss(14))
    rho = (0.5 * (node + 1.0)).sqrt()[:, None]
    phi = torch.arange(40, dtype=F64)[None] * (2.0 * math.pi / 40)
    values = torch.stack(
        [zernike(ZernikeStandard, j, rho * phi.cos(), rho * phi.sin()) for j in range(1, 67)]
    )
    mean = torch.einsum("iab,jab,a->ij", values, values, 0.5 * weight / 40)
    assert (mean - torch.eye(66, dtype=F64)).abs().max() < 1e-13


def test_zernike_terms_in_closed_form():
    x, y = points(2.0)
    r2 = (x * x + y * y) / 4.0
    for found, expected in (
        (zernike(ZernikeStandard, 4, x, y, 2.0), math.sqrt(3.0) * (2.0 * r2 - 1.0)),
        (zernike(ZernikeStandard, 6, x, y, 2.0), math.sqrt(6.0) * (x * x - y * y) / 4.0),
        (zernike(ZernikeStandard, 5, x, y, 2.0), math.sqrt(6.0) * x * y / 2.0),
        (zernike(ZernikeFringe, 4, x, y, 2.0), 2.0 * r2 - 1.0),
        (zernike(ZernikeFringe, 9, x, y, 2.0), 6.0 * r2 * r2 - 6.0 * r2 + 1.0),
        (zernike(ZernikeFringe, 8, x, y, 2.0), (3.0 * r2 - 2.0) * y / 2.0),
    ):
        assert (found - expected).abs().max() < 1e-14


def test_a_zernike_defocus_is_a_paraboloid():
    p = numbers(curvature=0.0, conic=0.0, z1=0.05, z4=0.05, normalization_radius=8.0,
                decenter_x=0.0, decenter_y=0.0)  # fmt: skip
    paraboloid = numbers(curvature=4 * 0.05 / 64.0, conic=-1.0)
    require_same_surface(ZernikeFringe, p, Conic, paraboloid)


def test_a_decentred_zernike_surface_is_the_same_polynomials_elsewhere():
    x, y = points()
    p = numbers(curvature=0.0, conic=0.0, z11=0.01, z8=0.02, normalization_radius=8.0)
    at = numbers(decenter_x=0.0, decenter_y=0.0)
    away = numbers(decenter_x=1.5, decenter_y=-2.0)
    here = ZernikeStandard.sag_and_gradient(p | away, x + 1.5, y - 2.0)
    for a, b in zip(here[:3], ZernikeStandard.sag_and_gradient(p | at, x, y)[:3], strict=True):
        assert (a - b).abs().max() < 1e-15


def q_bfs(q, count):
    """Yield Q_m at q = u² and its derivative in q, for m = 0, 1, ..., count - 1.

    The auxiliary polynomials are P_0 = 2, P_1 = 6 - 8q, P_(m+1) = (2 - 4q)·P_m - P_(m-1).
    """
    f, g, h = _factors(count)
    zero = q * 0.0
    here, slope, after, after_slope = zero + 2.0, zero, 6.0 - 8.0 * q, zero - 8.0
    last = []
    for m in range(count):
        value, d = here, slope
        if m > 0:
            value, d = value - g[m - 1] * last[-1][0], d - g[m - 1] * last[-1][1]
        if m > 1:
            value, d = value - h[m - 2] * last[-2][0], d - h[m - 2] * last[-2][1]
        last = [*last[-1:], (value / f[m], d / f[m])]
        yield last[-1]
        factor = 2.0 - 4.0 * q
        here, slope, after, after_slope = (
            after,
            after_slope,
            factor * after - here,
            factor * after_slope - 4.0 * after - slope,
        )


def test_q_bfs_polynomials_are_those_that_forbes_printed():
    """Forbes (2007): the first six, in x = u²."""
    x = torch.linspace(0.0, 1.2, 61, dtype=F64)
    printed = [
        torch.ones_like(x),
        (13 - 16 * x) / math.sqrt(19),
        math.sqrt(2 / 95) * (29 - 4 * x * (25 - 19 * x)),
        math.sqrt(2 / 2545) * (207 - 4 * x * (315 - x * (577 - 320 * x))),
        (7737 - 16 * x * (4653 - 2 * x * (7381 - 8 * x * (1168 - 509 * x))))
        / (3 * math.sqrt(131831)),
        (66657 - 32 * x * (28338 - x * (135325 - 8 * x * (35884 - x * (34661 - 12432 * x)))))
        / (3 * math.sqrt(6632213)),
    ]
    for (value, _), expected in zip(q_bfs(x, 6), printed, strict=True):
        assert (value - expected).abs().max() < 2e-12 * float(expected.abs().max())


def test_q_con_polynomials_are_those_that_forbes_printed():
    x = torch.linspace(0.0, 1.2, 61, dtype=F64)
    printed = [
        torch.ones_like(x),
        -(5 - 6 * x),
        15 - 14 * x * (3 - 2 * x),
        -(35 - 12 * x * (14 - x * (21 - 10 * x))),
    ]
    for value, expected in zip(jacobi(x, 4, 4), printed, strict=True):
        assert (value - expected).abs().max() < 1e-13 * float(expected.abs().max())


def test_high_orders_keep_their_digits():
    """Q_con to order 200 against the hypergeometric sum in 120 digits, Q_bfs to 30 against Gram and
    Schmidt: rounding grows with the order, and no faster.
    """
    x = torch.tensor([0.0, 0.1, 0.37, 0.8, 0.999, 1.0], dtype=F64)
    for m, value in enumerate(jacobi(x, 4, 201)):
        if m % 50 == 0:
            with mpmath.workdps(120):
                exact = [float(mpmath.jacobi(m, 0, 4, 2 * mpmath.mpf(float(u)) - 1)) for u in x]
            error = (value - torch.tensor(exact, dtype=F64)).abs()
            assert (error / torch.tensor(exact, dtype=F64).abs().max()).max() < 1e-13 * (m + 1)
    for m, (value, _) in enumerate(q_bfs(x, 31)):
        if m % 10 == 0:
            coefficients = q_bfs_polynomial(m)[::-1]
            exact = [float(mp.polyval(coefficients, mp.mpf(float(u)))) for u in x]
            error = (value - torch.tensor(exact, dtype=F64)).abs()
            assert error.max() < 1e-13 * (m + 1) * max(abs(e) for e in exact)


def test_coefficients_of_auxiliary_polynomials_give_the_same_sum():
    generator = torch.Generator().manual_seed(1)
    a = torch.randn(40, generator=generator, dtype=F64)
    x = torch.linspace(0.0, 1.0, 21, dtype=F64)
    b = torch.from_numpy(to_auxiliary(40)) @ a
    here, after = torch.ones_like(x), 3.0 - 4.0 * x
    total = torch.zeros_like(x)
    for weight in b:
        total = total + weight * here
        here, after = after, (2.0 - 4.0 * x) * after - here
    direct = sum(c * value for c, (value, _) in zip(a, q_bfs(x, 40), strict=True))
    assert (total - direct).abs().max() < 1e-12 * float(direct.abs().max())


def test_forbes_surfaces_without_coefficients_are_sphere_and_conic():
    p = numbers(curvature=0.05, q0=0.0, q3=0.0, normalization_radius=8.0)
    conic = numbers(curvature=0.05, conic=-2.0)
    require_same_surface(QBfs, p | conic, Conic, conic)
    require_same_surface(QCon, p | conic, Conic, conic)
    sphere = numbers(conic=0.0)
    require_same_surface(QBfs, p | sphere, Sphere, numbers(curvature=0.05))


def test_q_bfs_departs_neither_at_the_vertex_nor_at_the_normalisation_radius():
    p = numbers(curvature=0.05, conic=0.0, q0=0.1, q1=0.05, q7=-0.02, normalization_radius=8.0)
    ends = torch.tensor([0.0, 8.0], dtype=F64)
    sag = QBfs.sag_and_gradient(p, ends, torch.zeros_like(ends))[0]
    sphere = Sphere.sag_and_gradient(p, ends, torch.zeros_like(ends))[0]
    assert (sag - sphere).abs().max() < 1e-15


def test_anamorphic_surfaces_have_the_mean_curvature_over_azimuth():
    """And the mean fourth-order departure: of the biconic in closed form.

    The quartic part of N/(1 + W) is N·(e_x·x² + e_y·y²)/8; its mean over azimuth has ⟨cos⁴⟩ = 3/8
    and ⟨cos²·sin²⟩ = 1/8.
    """
    cx, cy, kx, ky = 0.05, -0.02, 0.7, -1.4
    p = numbers(curvature_x=cx, curvature_y=cy, conic_x=kx, conic_y=ky)
    assert float(Biconic.paraxial_curvature(p)) == pytest.approx((cx + cy) / 2, rel=1e-14)
    ex, ey = (1 + kx) * cx**2, (1 + ky) * cy**2
    quartic = (3 * (cx * ex + cy * ey) + cx * ey + cy * ex) / 8 / 8
    expected = quartic - ((cx + cy) / 2) ** 3 / 8
    assert float(Biconic.fourth_order_departure(p)) == pytest.approx(expected, rel=1e-12)
    toroid = numbers(curvature_x=cx, curvature_y=cy, conic_y=ky, a2=1e-3)
    assert float(Toroid.paraxial_curvature(toroid)) == pytest.approx(
        (cx + cy) / 2 + 1e-3, rel=1e-14
    )


ROW = {"semi_diameter": 5.0, "material": "1.5", "radius": 30.0}
ANAMORPHIC = {"radius": None, "radius_x": 20.0, "radius_y": 40.0}


@pytest.mark.parametrize(
    ("row", "message"),
    [
        ({"type": "q_con", "q0": 1e-3}, "'normalization_radius' must be given and positive"),
        ({"type": "q_bfs", "q01": 1e-3, "normalization_radius": 5.0}, "q01"),
        ({"type": "zernike_fringe", "z38": 0.1, "normalization_radius": 5.0}, "z1 to z37"),
        ({"type": "zernike_standard", "z232": 0.1, "normalization_radius": 5.0}, "z1 to z231"),
        ({"type": "zernike_standard", "normalization_radius": -5.0}, "positive"),
        ({"type": "zernike_fringe", "normalization_radius": math.inf}, "must be a finite number"),
        ({"phase": {"type": "radial", "p2": 1.0, "norm_radius": math.inf}}, "a finite number"),
        ({"type": "odd_asphere", "b1": 0.1}, "b1"),
        ({"type": "toroid", **ANAMORPHIC, "a3": 0.1}, "even aspheric coefficients"),
        ({"type": "toroid", "radius": None, "radius_y": 40.0}, "'radius_x' is missing"),
        ({"type": "biconic", **ANAMORPHIC, "curvature_x": 0.1}, "'radius_x' or 'curvature_x'"),
        ({"type": "biconic", **ANAMORPHIC, "radius_x": 4.0}, "exceeds the surface"),
        ({"type": "toroid", **ANAMORPHIC, "radius_x": 4.0}, "exceeds the surface"),
        ({"type": "q_con", "radius": 4.0, "normalization_radius": 5.0}, "exceeds the surface"),
        ({"type": "biconic"}, "radius"),
    ],
)
def test_a_wrong_prescription_is_one_line_about_its_key(row, message):
    row = {key: value for key, value in (ROW | row).items() if value is not None}
    with pytest.raises(InputError, match=message) as error:
        lens_from_prescription({"surfaces": {"1": row}, "sensor": {"distance": 10.0}})
    assert "surface 1" in str(error.value) and "\n" not in str(error.value)


NEW = ("odd_asphere", "biconic", "toroid", "zernike_standard", "zernike_fringe", "q_con", "q_bfs")


@pytest.mark.parametrize("kind", NEW)
def test_prescriptions_come_back_to_the_last_bit(kind):
    rows = {
        "odd_asphere": {"conic": -0.3, "a1": 0.01, "a3": 1e-5},
        "biconic": {**ANAMORPHIC, "conic_x": 0.1, "conic_y": -1.0},
        "toroid": {**ANAMORPHIC, "radius_x": math.inf, "conic_y": -1.0, "a2": 1e-4, "a4": 1e-6},
        "zernike_standard": {"conic": 0.0, "z4": 1e-3, "normalization_radius": 5.0,
                             "decenter_x": 0.5, "decenter_y": 0.0},
        "zernike_fringe": {"conic": 0.0, "z4": 1e-3, "normalization_radius": 5.0,
                           "decenter_x": 0.0, "decenter_y": 0.0},
        "q_con": {"conic": 1.0, "q0": 0.01, "q4": 1e-4, "normalization_radius": 5.1},
        "q_bfs": {"conic": -0.2, "q0": 0.01, "q4": 1e-4, "normalization_radius": 5.1},
    }  # fmt: skip
    row = {"type": kind} | {k: v for k, v in (ROW | rows[kind]).items() if v is not None}
    lens = lens_from_prescription({"surfaces": {"1": row}, "sensor": {"distance": 10.0}})
    assert prescription_of(lens)["surfaces"]["1"] == row


@pytest.mark.parametrize("kind", NEW)
def test_only_what_looks_the_same_from_every_azimuth_is_called_rotational(kind):
    assert SURFACES[kind].rotational == (kind in ("odd_asphere", "q_con", "q_bfs"))
