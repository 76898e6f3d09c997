"""Seidel sums against closed forms, theorems, and the small-aperture limit of real rays."""

import itertools
import math

import pytest
import torch

from dolens import load_lens
from dolens.optics.surfaces import SURFACES, Conic, EvenAsphere, Plane, Sphere, XYPolynomial
from dolens.optics.surfaces.base import Surface
from dolens.optics.trace import distance_to_plane, trace_surfaces, transfer
from dolens.prescriptions import lens_from_prescription

N = 1.5168
V = 64.17
GLASS = f"{N}/{V}"
D_LINE = 587.5618


def lens_of(rows, stop=1, sensor=50.0, object_material="air"):
    """A lens from (surface, thickness, material behind) rows; semi-diameters default to 5 mm."""
    surfaces = {}
    for number, (surface, thickness, material) in enumerate(rows, 1):
        row = {"type": "sphere", "semi_diameter": 5.0, **surface, "material": material}
        if number < len(rows):
            row["thickness"] = thickness
        surfaces[str(number)] = row
    return lens_from_prescription(
        {
            "stop": stop,
            "object_material": object_material,
            "surfaces": surfaces,
            "sensor": {"distance": sensor},
        }
    )


def totals(lens, *arguments, **options):
    return [float(value.detach()) for value in lens.seidel(*arguments, **options).total]


def thin_lens(power, shape):
    """c₁ - c₂ = K/(n - 1) and (c₁ + c₂)/(c₁ - c₂) = B, without thickness, the stop at the lens."""
    difference = power / (N - 1)
    c1, c2 = 0.5 * difference * (shape + 1), 0.5 * difference * (shape - 1)
    return lens_of([({"curvature": c1, "radius": None}, 0.0, GLASS),
                    ({"curvature": c2, "radius": None}, 0.0, "air")])  # fmt: skip


# --- closed forms --------------------------------------------------------------------------------


@pytest.mark.parametrize("shape", [-2.0, 0.0, 0.6, 1.0, 3.0])
@pytest.mark.parametrize("distance", [None, 300.0, 120.0])
def test_thin_lens_at_the_stop(shape, distance):
    """Welford (1986), section 12.2, for B the shape and C = (u + u')/(u - u') the conjugates."""
    power, h, field = 1 / 100.0, 5.0, (4.0 if distance is None else 20.0)
    lens = thin_lens(power, shape)
    tangent = math.tan(math.radians(field)) if distance is None else -field / distance
    u = 0.0 if distance is None else h / distance
    after = u - h * power
    conjugate = (u + after) / (u - after)
    invariant = -h * tangent
    spherical = (h**4 * power**3 / 4) * (
        (N / (N - 1)) ** 2
        + (N + 2) / (N * (N - 1) ** 2)
        * (shape + 2 * (N**2 - 1) / (N + 2) * conjugate) ** 2
        - N / (N + 2) * conjugate**2
    )  # fmt: skip
    coma = (-(h**2) * power**2 * invariant / 2) * (
        (N + 1) / (N * (N - 1)) * shape + (2 * N + 1) / N * conjugate
    )
    expected = [
        spherical, coma, invariant**2 * power, invariant**2 * power / N, 0.0, h**2 * power / V, 0.0,
    ]  # fmt: skip
    assert totals(lens, field, D_LINE, distance) == pytest.approx(expected, rel=1e-11, abs=1e-15)


def test_a_plate_in_a_diverging_beam():
    """S_I = -t·u⁴(n² - 1)/n³, each next sum ū/u times as large, C_L = -t·u²·δn/n²."""
    distance, thickness, height = 80.0, 12.0, 10.0
    stop = ({"type": "aperture", "semi_diameter": 4.0}, 6.0, "air")
    plane = {"type": "plane"}
    lens = lens_of([stop, (plane, thickness, GLASS), (plane, 0.0, "air")])
    u, chief = 4.0 / distance, -height / distance
    q = chief / u
    spherical = -thickness * u**4 * (N**2 - 1) / N**3
    axial = -thickness * u**2 * ((N - 1) / V) / N**2
    expected = [
        spherical, spherical * q, spherical * q**2, 0.0, spherical * q**3, axial, axial * q,
    ]  # fmt: skip
    assert totals(lens, height, D_LINE, distance) == pytest.approx(expected, rel=1e-11, abs=1e-18)


def test_surfaces_that_image_an_axial_point_perfectly():
    """Cartesian ovals: an ellipsoid into glass (k = -1/n²), a hyperboloid out of it (k = -n²)."""
    into = lens_of([({"type": "conic", "radius": 20.0, "conic": -1 / N**2}, 0.0, GLASS)])
    hyperboloid = {"type": "conic", "radius": -20.0, "conic": -(N**2)}
    out_of = lens_of([({"type": "plane"}, 3.0, GLASS), (hyperboloid, 0.0, "air")])
    for lens in (into, out_of):
        sums = lens.seidel(2.0)
        assert abs(float(sums.total.spherical.detach())) < 1e-16
        assert abs(float(sums.total.coma.detach())) > 1e-6
        # A sphere of that radius is far from perfect.
        sphere = lens.surfaces[str(len(lens.surfaces))]
        with torch.no_grad():
            sphere.conic.zero_()
        assert float(lens.seidel(2.0).total.spherical.detach()) > 1e-3


def test_an_aplanatic_sphere_has_neither_spherical_aberration_nor_coma():
    """u/n = u'/n' at the object distance R(n + n')/n: the virtual image is at R(n + n')/n'."""
    radius = -20.0
    lens = lens_of([({"radius": radius}, 0.0, GLASS)])
    sums = totals(lens, 1.0, D_LINE, -radius * (1 + N))
    assert sums[0] == pytest.approx(0.0, abs=1e-16)
    assert sums[1] == pytest.approx(0.0, abs=1e-16)
    assert sums[2] == pytest.approx(0.0, abs=1e-16)
    assert abs(sums[3]) > 1e-6


def test_a_schmidt_plate_adds_8_a4_step_h4():
    a4 = 3e-6

    def plate(a4):
        figured = {"type": "even_asphere", "curvature": 0.0, "radius": None, "a4": a4}
        return lens_of([({"type": "plane"}, 4.0, GLASS), (figured, 0.0, "air")])

    figured, flat = plate(a4).seidel(3.0), plate(0.0).seidel(3.0)
    h, chief = 5.0, 4.0 * math.tan(math.radians(3.0)) / N
    for with_a4, without, powers in zip(
        figured[:5], flat[:5], ((4, 0), (3, 1), (2, 2), None, (1, 3)), strict=True
    ):
        added = 8 * a4 * (1 - N) * h ** powers[0] * chief ** powers[1] if powers else 0.0
        found = float((with_a4 - without)[-1].detach())
        assert found == pytest.approx(added, rel=1e-9, abs=1e-18)
    assert float(flat.spherical.abs().max().detach()) == 0.0


# --- theorems ------------------------------------------------------------------------------------


def test_moving_the_stop(root):
    """Welford (1986), section 8.6: with Q = δh̄/h, each sum takes up those before it."""
    first = [({"radius": 30.0}, 4.0, GLASS), ({"radius": -80.0}, 6.0, "air"),
             ({"type": "even_asphere", "radius": -40.0, "conic": 0.7, "a4": 1e-6}, 2.0, "1.62/36"),
             ({"radius": 90.0}, 7.0, "air")]  # fmt: skip
    plain = lens_of(first, stop=1)
    h = 5.0
    # The same aperture, cut elsewhere: at surface 3 its image has the marginal ray's height.
    marginal = plain.paraxial_rays(6.0).marginal
    height = float(marginal.height[2].detach())
    moved = [row if i != 2 else ({**row[0], "semi_diameter": height}, *row[1:])
             for i, row in enumerate(first)]  # fmt: skip
    other = lens_of(moved, stop=3)
    q = float((other.paraxial_rays(6.0).chief.height[0] / h).detach())
    assert abs(q) > 0.1
    s1, s2, s3, s4, s5, axial, lateral = totals(plain, 6.0)
    expected = [
        s1,
        s2 + q * s1,
        s3 + 2 * q * s2 + q**2 * s1,
        s4,
        s5 + q * (3 * s3 + s4) + 3 * q**2 * s2 + q**3 * s1,
        axial,
        lateral + q * axial,
    ]
    assert totals(other, 6.0) == pytest.approx(expected, rel=1e-10)


@pytest.mark.parametrize("name", ["cooke_triplet", "nikon"])
def test_petzval_sum_and_axial_color(root, name):
    """S_IV = -H²ΣcΔ(1/n); the focus moves by -C_L/(n'u'²) between two near wavelengths."""
    lens = load_lens(root / "conf" / "lens" / f"{name}.yaml")
    rays = lens.paraxial_rays(10.0)
    curved = 0.0
    indices = lens.system().indices(D_LINE)
    for number, surface in enumerate(lens.surfaces.values(), 1):
        c = surface.paraxial_curvature(dict(surface.named_parameters()))
        curved = curved + c * (1 / indices[number] - 1 / indices[number - 1])
    sums = lens.seidel(10.0, color=(D_LINE - 0.01, D_LINE + 0.01)).total
    expected = float((-(rays.lagrange_invariant**2) * curved).detach())
    assert float(sums.petzval.detach()) == pytest.approx(expected, rel=1e-11)
    moved = lens.first_order(D_LINE - 0.01).focus - lens.first_order(D_LINE + 0.01).focus
    u = rays.marginal.slope_after[-1]
    assert float((-sums.axial_color / u**2).detach()) == pytest.approx(
        float(moved.detach()), rel=1e-6
    )
    # The chief ray's height at one plane moves by C_T/(n'u').
    z = lens.first_order(D_LINE).focus - lens.system().vertices[len(lens.surfaces) - 1]
    ends = []
    for nm in (D_LINE - 0.01, D_LINE + 0.01):
        # Fixed in the entrance pupil's plane, as C_T has it: the stop moves no index there.
        chief = lens.paraxial_rays(10.0, nm).chief
        ends.append(chief.height[-1] + z * chief.slope_after[-1])
    assert float((sums.lateral_color / u).detach()) == pytest.approx(
        float((ends[0] - ends[1]).detach()), rel=1e-5
    )


# --- the limit of real rays ----------------------------------------------------------------------

POINTS = torch.tensor(
    [[0.0, 0.0], [0.0, 1.0], [0.0, -1.0], [1.0, 0.0], [0.6, 0.3], [-0.4, -0.8]],
    dtype=torch.float64,
)


def predicted(lens, field, distance):
    """Transverse aberration (∂W/∂x, ∂W/∂y)/(n'u') at POINTS of the pupil, mm."""
    s1, s2, s3, s4, s5, _, _ = (value.detach() for value in lens.seidel(
        field, D_LINE, distance).total)  # fmt: skip
    x, y = POINTS.unbind(-1)
    r2 = x**2 + y**2
    dx = s1 * r2 * x / 2 + s2 * x * y + (s3 + s4) * x / 2
    dy = s1 * r2 * y / 2 + s2 * (r2 + 2 * y**2) / 2 + (3 * s3 + s4) * y / 2 + s5 / 2
    leaving = lens.paraxial_rays(field, D_LINE, distance).marginal.slope_after[-1].detach()
    return torch.stack((dx, dy), -1) / (lens.first_order().image_index * leaving)


def real(lens, field, distance, scale):
    """The same from rays at `scale` times the field and aperture, over scale³."""
    if distance is None:
        angle = math.degrees(math.atan(scale * math.tan(math.radians(field))))
        height = scale * math.tan(math.radians(field)) * lens.first_order().efl.detach()
    else:
        angle = scale * field
        height = angle * lens.first_order(D_LINE, distance).magnification.detach()
    system = lens.system()
    rays = lens.aim((0.0, angle), scale * POINTS, D_LINE, distance)
    assert rays.converged.all()
    ray = trace_surfaces(system, rays.components(), D_LINE).ray
    image = lens.first_order(D_LINE, distance).image
    ray = transfer(ray, distance_to_plane(ray, image, 1.0)[0])
    return (torch.stack((ray.x, ray.y - height), -1) / scale**3).detach()


CASES = {
    "cooke_triplet": (15.0, None),
    "cooke_triplet_near": (60.0, 300.0),
    "nikon": (20.0, None),
    "asphere": (10.0, None),
    "large_fov_doublet": (15.0, None),
    "retrofocus": (25.0, None),
}


def case_lens(name, root):
    if name == "retrofocus":
        return lens_of(
            [
                ({"type": "conic", "radius": 60.0, "conic": 1.5, "semi_diameter": 15.0}, 2.0,
                 GLASS),
                ({"radius": 15.0, "semi_diameter": 12.0}, 15.0, "air"),
                ({"type": "xy_polynomial", "x2": 0.02, "y2": 0.02, "x4": 2e-5, "x2y2": 4e-5,
                  "y4": 2e-5, "b": 0.03}, 4.0, "1.62/60"),
                ({"radius": -40.0}, 2.0, "air"),
                ({"type": "aperture", "semi_diameter": 3.0}, 1.0, "air"),
                ({"type": "even_asphere", "radius": 50.0, "conic": -2.0, "a4": -2e-5}, 3.0, GLASS),
                ({"radius": -25.0}, 0.0, "air"),
            ],
            stop=5,
        )  # fmt: skip
    return load_lens(root / "conf" / "lens" / f"{name.removesuffix('_near')}.yaml")


@pytest.mark.parametrize("name", CASES)
def test_third_order_is_the_limit_of_real_rays(root, name):
    """The difference falls as the square of aperture and field, and vanishes with them."""
    field, distance = CASES[name]
    lens = case_lens(name, root)
    expected = predicted(lens, field, distance)
    size = expected.abs().max()
    coarse, middle, fine = (real(lens, field, distance, 0.1 / 2**k) for k in range(3))
    errors = [float((found - expected).abs().max() / size) for found in (coarse, middle, fine)]
    for larger, smaller in itertools.pairwise(errors):
        assert 3.5 < larger / smaller < 4.5
    # Without the term in scale²: what is left falls as its fourth power.
    limit = (4.0 * fine - middle) / 3.0
    assert (limit - expected).abs().max() < 2e-3 * errors[0] * size
    assert (limit - expected).abs().max() < 1e-4 * size


def test_longitudinal_and_chief_ray_alone(root):
    """S_I from the axial beam, S_V from chief rays: nothing else contributes."""
    lens = load_lens(root / "conf" / "lens" / "cooke_triplet.yaml")
    sums = lens.seidel(15.0).total
    u = lens.paraxial_rays(15.0).marginal.slope_after[-1]
    on_axis = real(lens, 0.0, None, 0.02)[1, 1]
    assert float(on_axis) == pytest.approx(float((sums.spherical / (2 * u)).detach()), rel=1e-3)
    chief = real(lens, 15.0, None, 0.02)[0, 1]
    assert float(chief) == pytest.approx(float((sums.distortion / (2 * u)).detach()), rel=1e-3)


# --- the fourth order of a surface ---------------------------------------------------------------

SHAPES = {
    "sphere": (Sphere, {"curvature": 1 / 21.0}),
    "conic": (Conic, {"curvature": -1 / 15.0, "conic": -2.3}),
    "asphere": (EvenAsphere, {"curvature": 1 / 20.9, "conic": -0.64, "a4": 2e-6, "a8": -1e-9}),
    "plain_asphere": (EvenAsphere, {"curvature": 1 / 20.9, "conic": -0.64}),
}


@pytest.mark.parametrize("name", SHAPES)
def test_closed_forms_agree_with_derivatives_of_the_sag(name):
    shape, values = SHAPES[name]
    p = {key: torch.tensor(v, dtype=torch.float64, requires_grad=True) for key, v in values.items()}
    closed = shape.fourth_order_departure(p)
    derived = Surface.fourth_order_departure.__func__(shape, p)
    assert float(derived.detach()) == pytest.approx(float(closed.detach()), rel=1e-11, abs=1e-19)
    keys = [key for key in p if key != "a8"]
    found = torch.autograd.grad(derived, [p[key] for key in keys], allow_unused=True)
    if name == "sphere":
        assert float(found[0]) == pytest.approx(0.0, abs=1e-16)
        return
    exact = torch.autograd.grad(closed, [p[key] for key in keys], allow_unused=True)
    for a, b in zip(found, exact, strict=True):
        assert float(a) == pytest.approx(float(b), rel=1e-9)


def test_fourth_order_of_a_polynomial_averages_over_azimuth():
    """<x⁴> = <y⁴> = 3/8, <x²y²> = 1/8, odd powers 0; b·z² adds b(x2·x² + xy·xy + y2·y²)²."""
    a = {"x2": 0.01, "y2": 0.02, "xy": 0.004, "x3": 1e-4, "x2y": -2e-4, "x4": 3e-5, "x3y": 7e-5,
         "x2y2": -4e-5, "y4": 5e-5, "x4y": 1e-6, "b": 0.03}  # fmt: skip
    p = {key: torch.tensor(v, dtype=torch.float64, requires_grad=True) for key, v in a.items()}
    squared = 3 / 8 * (a["x2"] ** 2 + a["y2"] ** 2) + (a["xy"] ** 2 + 2 * a["x2"] * a["y2"]) / 8
    quartic = 3 / 8 * (a["x4"] + a["y4"]) + a["x2y2"] / 8 + a["b"] * squared
    expected = quartic - (a["x2"] + a["y2"]) ** 3 / 8
    found = XYPolynomial.fourth_order_departure(p)
    assert float(found.detach()) == pytest.approx(expected, rel=1e-12)
    by_b, by_x4, by_x3 = torch.autograd.grad(found, (p["b"], p["x4"], p["x3"]))
    assert float(by_b) == pytest.approx(squared, rel=1e-12)
    assert float(by_x4) == pytest.approx(3 / 8, rel=1e-12)
    assert float(by_x3) == pytest.approx(0.0, abs=1e-15)


def test_planes_have_no_fourth_order():
    assert Plane.fourth_order_departure({}) == 0.0
    assert SURFACES["aperture"].fourth_order_departure({}) == 0.0


# --- gradients -----------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["retrofocus", "asphere"])
def test_gradient_of_the_sums(root, name):
    lens = case_lens(name, root)
    parameters = {n: p for n, p in lens.named_parameters() if n != "sensor_distance"}

    def weighted():
        sums = lens.seidel(5.0).total
        return sum(weight * value for weight, value in enumerate(sums, 1))

    exact = torch.autograd.grad(weighted(), parameters.values(), allow_unused=True)
    checked = 0
    for (key, parameter), gradient in zip(parameters.items(), exact, strict=True):
        step = 1e-4 * max(abs(float(parameter.detach())), 1e-7 if ".a" in key else 1e-3)
        ends = []
        with torch.no_grad():
            kept = parameter.clone()
            for k in (-2, -1, 1, 2):
                parameter.copy_(kept + k * step)
                ends.append(float(weighted()))
            parameter.copy_(kept)
        slope = (ends[0] - 8 * ends[1] + 8 * ends[2] - ends[3]) / (12 * step)
        found = 0.0 if gradient is None else float(gradient)
        rounding = 1e-14 * max(abs(ends[0]), 1.0) / step
        assert found == pytest.approx(slope, rel=1e-6, abs=rounding), key
        checked += found != 0.0
    assert checked >= 4


def test_transforms_and_single_precision(root):
    lens = case_lens("retrofocus", root)
    name = "surfaces.2.curvature"
    value = lens.surfaces["2"].curvature.detach()

    from dolens.optics.seidel import seidel

    def spherical(c):
        return seidel(lens.system({name: c}), D_LINE, 0.1).total.spherical

    (exact,) = torch.autograd.grad(spherical(lens.surfaces["2"].curvature),
                                   lens.surfaces["2"].curvature)  # fmt: skip
    assert float(torch.func.jacfwd(spherical)(value).detach()) == pytest.approx(float(exact))
    several = value * torch.tensor([0.9, 1.0, 1.1], dtype=torch.float64)
    batched = torch.func.vmap(spherical)(several)
    assert torch.allclose(batched, torch.stack([spherical(c) for c in several]), rtol=1e-12)
    single = lens.to(torch.float32).seidel(5.0)
    assert all(v.dtype == torch.float32 and torch.isfinite(v).all() for v in single)
