"""What each surface shape must be: its sag, its slopes, where rays meet it, how they bend."""

import math

import mpmath
import pytest
import torch

from dolens import InputError
from dolens.optics.surfaces import (
    SURFACES,
    Biconic,
    Conic,
    EvenAsphere,
    OddAsphere,
    Plane,
    QBfs,
    QCon,
    Sphere,
    Toroid,
    XYPolynomial,
    ZernikeFringe,
    ZernikeStandard,
)
from dolens.optics.surfaces.refraction import PlaneRay
from dolens.optics.surfaces.xy_polynomial import monomial_powers
from tests.optics.exact import sag_of
from tests.optics.exact_sags import mp

SEMI_DIAMETER = 8.0
EPSILON = torch.finfo(torch.float64).eps
SHAPES = {
    "plane": (Plane, {}),
    "sphere": (Sphere, {"curvature": 1 / 21.0}),
    "concave_sphere": (Sphere, {"curvature": -1 / 12.0}),
    "flat_sphere": (Sphere, {"curvature": 0.0}),
    "ellipsoid": (Conic, {"curvature": 1 / 15.0, "conic": -0.6}),
    "paraboloid": (Conic, {"curvature": -1 / 15.0, "conic": -1.0}),
    "hyperboloid": (Conic, {"curvature": 1 / 15.0, "conic": -2.3}),
    "oblate": (Conic, {"curvature": 1 / 20.0, "conic": 0.7}),
    "asphere": (EvenAsphere, {"curvature": 1 / 20.9, "conic": -0.64, "a4": 2e-6, "a8": -1e-9}),
    "xy": (XYPolynomial, {"x2": 0.01, "y2": 0.02, "x3": 1e-4, "x2y": -2e-4, "xy": 3e-3, "y": 0.01}),
    "xy_b": (XYPolynomial, {"x2": 0.01, "y2": 0.015, "xy2": 1e-4, "y3": 2e-4, "b": 0.02}),
    "asphere_with_square": (EvenAsphere, {"curvature": 1 / 30.0, "conic": -2.0, "a2": 5e-3,
                                          "a6": 1e-7}),
    "odd_asphere": (OddAsphere, {"curvature": -1 / 25.0, "conic": 0.3, "a2": 1e-3, "a3": 1e-4,
                                 "a4": -1e-6, "a7": 2e-9}),
    "biconic": (Biconic, {"curvature_x": 1 / 15.0, "curvature_y": -1 / 30.0, "conic_x": -0.4,
                          "conic_y": 2.0}),
    "toroid": (Toroid, {"curvature_x": -1 / 14.0, "curvature_y": 1 / 20.0, "conic_y": -0.8,
                        "a4": 1e-5}),
    "cylinder": (Toroid, {"curvature_x": 0.0, "curvature_y": 1 / 16.0, "conic_y": 0.0}),
    "zernike_standard": (ZernikeStandard, {
        "curvature": 1 / 25.0, "conic": -1.0, "z4": 0.02, "z6": -0.01, "z8": 5e-3, "z15": 1e-3,
        "normalization_radius": 8.0, "decenter_x": 0.5}),
    "zernike_fringe": (ZernikeFringe, {
        "curvature": 0.0, "conic": 0.0, "a4": 1e-6, "z4": 0.05, "z6": 0.01, "z10": -4e-3,
        "z37": 1e-4, "normalization_radius": 7.0}),
    "q_con": (QCon, {"curvature": -1 / 18.0, "conic": -0.3, "q0": 0.1, "q1": 0.02, "q4": -1e-3,
                     "normalization_radius": 8.5}),
    "q_bfs": (QBfs, {"curvature": 1 / 16.0, "conic": -0.4, "q0": 0.03, "q2": -0.01, "q5": 1e-3,
                     "normalization_radius": 8.0}),
}  # fmt: skip


@pytest.fixture(params=SHAPES)
def surface(request):
    shape, values = SHAPES[request.param]
    return shape(SEMI_DIAMETER, values)


def parameters(surface):
    return {name: p.detach() for name, p in (*surface.named_parameters(), *surface.named_buffers())}


def disc(count=200, radius=0.98 * SEMI_DIAMETER):
    generator = torch.Generator().manual_seed(3)
    r = radius * torch.rand(count, generator=generator, dtype=torch.float64).sqrt()
    angle = 2 * math.pi * torch.rand(count, generator=generator, dtype=torch.float64)
    return r * torch.cos(angle), r * torch.sin(angle)


def bundle(sense, count=200):
    """Rays up to 20 degrees off the axis, given where they cross the vertex plane."""
    x, y = disc(count, 0.6 * SEMI_DIAMETER)
    generator = torch.Generator().manual_seed(4)
    slopes = 0.25 * (2 * torch.rand((2, count), generator=generator, dtype=torch.float64) - 1)
    n = sense / torch.sqrt(1 + (slopes**2).sum(0))
    return PlaneRay(x, y, slopes[0] * n, slopes[1] * n, n)


def sag_in_mpmath(surface, x, y):
    """The sag by its definition (S1, S5), to 50 digits."""
    p = {name: mpmath.mpf(float(value)) for name, value in parameters(surface).items()}
    x, y = mpmath.mpf(float(x)), mpmath.mpf(float(y))
    if isinstance(surface, XYPolynomial):
        b = p.pop("b", mpmath.mpf(0))
        total = sum(
            a * x ** monomial_powers(k)[0] * y ** monomial_powers(k)[1] for k, a in p.items()
        )
        if b == 0:
            return total
        # The root of Σ a x^i y^j + b z² - z = 0 that goes through the vertex.
        return mpmath.findroot(lambda z: total + b * z * z - z, total)
    if isinstance(surface, Plane):
        return mpmath.mpf(0)
    return mpmath.mpf(sag_of(surface.kind, {n: mp.mpf(v) for n, v in p.items()}, x, y))


def test_sag_is_its_definition(surface):
    x, y = disc(20)
    sag, _, _, exists = surface.sag_and_gradient(parameters(surface), x, y)
    assert exists is None or (exists > 0).all()
    with mpmath.workdps(50):
        for i in range(len(x)):
            assert abs(sag_in_mpmath(surface, x[i], y[i]) - mpmath.mpf(float(sag[i]))) < 4e-15


def require_refraction(surface, ray, sense, before, after):
    """Rays that meet a surface end on it, the normal is that of differences of the sag, and the
    law of sines holds.

    Returns which rays are refracted.
    """
    p, r = parameters(surface), surface.semi_diameter
    t, met = surface.intersect(p, ray, sense, r)
    x, y, z = ray.x + t * ray.l, ray.y + t * ray.m, t * ray.n
    good = (torch.hypot(x, y) < 0.9 * r) & (t == t if met is None else met > 0.0)
    sag = surface.sag_and_gradient(p, x, y)[0]
    assert ((sag - z).abs()[good] < 64 * EPSILON * (t.abs() + r)[good]).all()
    normal = torch.stack([component.expand_as(x) for component in surface.normal(p, x, y, z)])
    assert ((normal.norm(dim=0) - 1.0).abs()[good] < 16 * EPSILON).all()
    h = 1e-5 * r
    for component, (dx, dy) in zip(normal, ((h, 0.0), (0.0, h)), strict=False):
        ends = [surface.sag_and_gradient(p, x + k * dx, y + k * dy)[0] for k in (-2, -1, 1, 2)]
        slope = (ends[0] - 8 * ends[1] + 8 * ends[2] - ends[3]) / (12 * h)
        error = (slope + component / normal[2]).abs()
        assert (error[good] < 1e-8 * (1.0 + slope.abs())[good]).all()
    bent = surface.refract(p, (x, y, z), (ray.l, ray.m, ray.n), before / after, sense)
    kept, leaving = bent.transmitted > 0.0, torch.stack(bent[:3])
    sine_in = torch.linalg.cross(torch.stack((ray.l, ray.m, ray.n)), normal, dim=0)
    sine_out = torch.linalg.cross(leaving, normal, dim=0)
    # Total reflection is where the sine would exceed one.
    sine = before / after * sine_in.norm(dim=0)
    assert torch.equal(kept[good], (sine < 1.0)[good])
    good = good & kept
    # n i×N = n' r×N: the law of sines and the common plane at once.
    assert (before * sine_in - after * sine_out).abs().amax(0)[good].max() < 32 * EPSILON
    assert ((leaving.square().sum(0) - 1.0).abs()[good] < 32 * EPSILON).all()
    assert (sense * (leaving * normal).sum(0)[good] > 0.0).all()
    return good


@pytest.mark.parametrize("sense", [1.0, -1.0])
def test_rays_meet_the_surface(surface, sense):
    p, ray = parameters(surface), bundle(sense)
    t, met = surface.intersect(p, ray, sense, SEMI_DIAMETER)
    assert met is None or (met > 0).all()
    x, y, z = ray.x + t * ray.l, ray.y + t * ray.m, t * ray.n
    with mpmath.workdps(50):
        for i in range(0, len(x), 10):
            assert abs(sag_in_mpmath(surface, x[i], y[i]) - mpmath.mpf(float(z[i]))) < 1e-14


def test_normals_are_the_gradient_of_the_sag(surface):
    p, (x, y), h = parameters(surface), disc(), 1e-4
    z = surface.sag_and_gradient(p, x, y)[0]

    def slope(dx, dy):
        """Fourth-order central difference."""
        sag = [surface.sag_and_gradient(p, x + k * dx, y + k * dy)[0] for k in (-2, -1, 1, 2)]
        return (sag[0] - 8 * sag[1] + 8 * sag[2] - sag[3]) / (12 * h)

    sx, sy = slope(h, 0.0), slope(0.0, h)
    expected = torch.stack((-sx, -sy, torch.ones_like(sx)))
    expected = expected / expected.norm(dim=0)
    normal = torch.stack([component.expand_as(x) for component in surface.normal(p, x, y, z)])
    assert (normal - expected).abs().max() < 1e-10
    assert (normal.norm(dim=0) - 1).abs().max() < 1e-14


@pytest.mark.parametrize(("before", "after"), [(1.0, 1.5168), (1.6727, 1.0)])
@pytest.mark.parametrize("sense", [1.0, -1.0])
def test_snells_law(surface, sense, before, after):
    assert require_refraction(surface, bundle(sense), sense, before, after).sum() > 100


def test_float32_meets_to_its_own_rounding(surface):
    p = {name: value.float() for name, value in parameters(surface).items()}
    ray = PlaneRay(*(c.float() for c in bundle(1.0)))
    t, met = surface.intersect(p, ray, 1.0, SEMI_DIAMETER)
    assert t.dtype == torch.float32
    assert met is None or (met > 0).all()
    exact, _ = surface.intersect(
        {n: v.double() for n, v in p.items()}, PlaneRay(*(c.double() for c in ray)), 1.0, 8.0
    )
    assert (t.double() - exact).abs().max() < 3e-6


@pytest.mark.parametrize("sense", [1.0, -1.0])
def test_a_sphere_without_curvature_is_a_plane(sense):
    ray = bundle(sense)
    zero = {"curvature": torch.zeros((), dtype=torch.float64)}
    t, met = Sphere.intersect(zero, ray, sense, SEMI_DIAMETER)
    assert (t == 0).all()
    assert (met > 0).all()
    direction = (ray.l, ray.m, ray.n)
    bent = Sphere.refract(zero, (ray.x, ray.y, t), direction, 1 / 1.5, sense)
    flat = Plane.refract({}, (ray.x, ray.y, t), direction, 1 / 1.5, sense)
    for a, b in zip(bent[:3], flat[:3], strict=True):
        assert (a - b).abs().max() < 1e-15


@pytest.mark.parametrize("sense", [1.0, -1.0])
def test_a_flat_sphere_can_start_to_bend(sense):
    """The derivative in c at c = 0 exists: dt/dc = (x² + y²)/(2n), from s = c r²/2 + O(c³)."""
    ray = bundle(sense)
    c = torch.zeros((), dtype=torch.float64, requires_grad=True)
    t, _ = Sphere.intersect({"curvature": c}, ray, sense, SEMI_DIAMETER)
    weight = torch.linspace(1, 2, len(t), dtype=torch.float64)
    (found,) = torch.autograd.grad((weight * t).sum(), c)
    exact = (weight * (ray.x**2 + ray.y**2) / (2 * ray.n)).sum()
    assert float(found) == pytest.approx(float(exact), rel=1e-13)
    h, ends = 1e-6, []
    for value in (-h, h):
        curvature = torch.tensor(value, dtype=torch.float64)
        t, _ = Sphere.intersect({"curvature": curvature}, ray, sense, SEMI_DIAMETER)
        ends.append(float((weight * t).sum()))
    assert float(found) == pytest.approx((ends[1] - ends[0]) / (2 * h), rel=1e-7)


@pytest.mark.parametrize(("theta", "hit"), [(0.3, True), (1.2, True), (1.9, False), (2.6, False)])
def test_only_the_near_half_of_a_sphere_is_a_surface(theta, hit):
    """A ray that enters the ball at an angle theta from the vertex, seen from the centre."""
    radius, tilt = 10.0, 1.4
    entry = torch.tensor([math.sin(theta), 0.0, 1 - math.cos(theta)], dtype=torch.float64) * radius
    direction = torch.tensor([-math.sin(tilt), 0.0, math.cos(tilt)], dtype=torch.float64)
    # Towards the centre's side: the line does enter there.
    assert float(direction @ (torch.tensor([0.0, 0.0, radius]).double() - entry)) > 0
    start = entry - direction * (entry[2] / direction[2])
    ray = PlaneRay(start[None, 0], start[None, 1], *(component[None] for component in direction))
    t, met = Sphere.intersect({"curvature": torch.tensor(0.1, dtype=torch.float64)}, ray, 1.0, 9.0)
    assert bool(met > 0) == hit
    if hit:
        assert float(t * direction[2]) == pytest.approx(float(entry[2]), abs=1e-12)


def test_a_ray_beside_a_sphere_misses_it():
    ones, zeros = torch.ones(1).double(), torch.zeros(1).double()
    curvature = torch.tensor(0.1, dtype=torch.float64)
    for x, hit in ((9.99, True), (10.01, False)):
        ray = PlaneRay(x * ones, zeros, zeros, zeros, ones)
        _, met = Sphere.intersect({"curvature": curvature}, ray, 1.0, 9.0)
        assert bool(met > 0) == hit


@pytest.mark.parametrize(
    ("name", "powers"),
    [
        ("x", (1, 0)), ("y", (0, 1)), ("xy", (1, 1)), ("x2", (2, 0)), ("x2y", (2, 1)),
        ("xy2", (1, 2)), ("y3", (0, 3)), ("x3", (3, 0)), ("x10y12", (10, 12)),
    ],
)  # fmt: skip
def test_monomial_names(name, powers):
    assert monomial_powers(name) == powers


@pytest.mark.parametrize("name", ["", "b", "x1", "x0", "yx", "xx", "a4", "x-2", "x2y1", "x02", "z"])
def test_other_names_are_no_monomials(name):
    assert monomial_powers(name) is None


@pytest.mark.parametrize("key", ["a1", "a5", "a3"])
def test_aspheric_coefficients_are_of_even_powers(key):
    with pytest.raises(InputError, match=f"'{key}': even aspheric coefficients are a2, a4, a6"):
        EvenAsphere.parameter_names({key: 1.0})


def test_coefficients_are_ordered_by_power():
    keys = {"a10": 0, "a4": 0, "a6": 0, "radius": 1}
    assert EvenAsphere.parameter_names(keys) == ["curvature", "conic", "a4", "a6", "a10"]


@pytest.mark.parametrize(
    ("kind", "values"),
    [
        ("sphere", {"curvature": 0.2}),
        ("conic", {"curvature": 0.1, "conic": 1.0}),
        ("even_asphere", {"curvature": 0.2, "conic": 0.0}),
    ],
)
def test_an_aperture_ends_where_the_sphere_does(kind, values):
    edge = 1 / (values["curvature"] * math.sqrt(1 + values.get("conic", 0.0)))
    SURFACES[kind](0.999 * edge, values)
    with pytest.raises(InputError, match=f"exceeds the surface, which ends at {edge:g} mm"):
        SURFACES[kind](1.001 * edge, values)


def test_paraxial_curvature_is_the_mean_second_derivative(surface):
    p, h = parameters(surface), torch.tensor(1e-3, dtype=torch.float64)
    zero = torch.zeros_like(h)

    def second(x, y):
        ends = [surface.sag_and_gradient(p, s * x, s * y)[0] for s in (-1, 0, 1)]
        return float((ends[0] - 2 * ends[1] + ends[2]) / h**2)

    expected = 0.5 * (second(h, zero) + second(zero, h))
    assert float(surface.paraxial_curvature(p)) == pytest.approx(expected, abs=2e-6)
