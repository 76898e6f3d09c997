"""Polarisation ray tracing beside closed forms, 50 digits, prisms of known Jones matrices and
differences."""

import math

import mpmath
import pytest
import torch

import dolens
from dolens import InputError, Rays
from dolens.optics.elements import rotation_matrix
from dolens.optics.polarisation import double_pole_axes, turned
from dolens.optics.thin_films import Layer, amplitudes, shares, transparent
from dolens.prescriptions.build import lens_from_prescription
from dolens.prescriptions.coatings import coated
from tests.lenses import prescription_of_rows

SILVER = [0.055, 3.32]
AXIS = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)


def rays_at(*positions, direction=AXIS, wavelength=550.0):
    return Rays(torch.tensor(positions, dtype=torch.float64), direction, wavelength)


def skew_rays(lens, field=(6.0, 20.0)):
    pupil = [(0.0, 0.0), (0.0, 0.6), (0.5, -0.3), (-0.4, 0.5), (-0.7, -0.2)]
    return lens.aim(field, pupil, 550.0)


@pytest.mark.parametrize("coating", ["none", "quarter_wave"])
def test_of_meridional_rays_s_and_p_pass_the_lens_each_on_its_own(coating):
    lens = coated(dolens.load_lens("cooke_triplet"), coating).requires_grad_(False)
    rays = lens.aim((0.0, 20.0), [(0.0, y) for y in (-0.5, 0.0, 0.4)], 550.0)
    hit = lens.trace(rays, record=True)
    points = torch.cat([rays.position[None], hit.points, hit.position[None]])
    ways = torch.nn.functional.normalize(points.diff(dim=0), dim=-1)
    ways[0] = rays.direction
    system = lens.system()
    n = system.indices(550.0)
    s = p = torch.ones(3, dtype=torch.float64)
    for k, surface in enumerate(system.surfaces):
        if surface.coating is None:
            continue
        cosine = surface.cosine_of_incidence(
            (*hit.points[k, :, :2].unbind(-1), hit.points[k, :, 2] - system.vertices[k]),
            ways[k].unbind(-1),
        )
        found = surface.coating.shares(n[k], n[k + 1], cosine, 550.0)
        s, p = s * found.t_s, p * found.t_p
    assert hit.valid.all()
    found = lens.trace_polarised(rays)
    assert found.transmission.tolist() == pytest.approx((0.5 * (s + p)).tolist(), rel=1e-12)
    # x is s of rays in the y-z plane.
    assert found.jones[:, 0, 0].abs().square().tolist() == pytest.approx(s.tolist(), rel=1e-12)
    assert float(found.jones[:, 0, 1].abs().max()) < 1e-15


def test_a_skew_ray_through_two_surfaces_has_the_matrix_of_50_digits():
    given = prescription_of_rows((20.0, 6.0, "1.6"), (-15.0, 0.0, "air"), semi_diameter=9.0)
    lens = lens_from_prescription({**given, "coating": "none"})
    start, way = (3.0, -2.0, -5.0), (0.15, 0.31, math.sqrt(1.0 - 0.15**2 - 0.31**2))
    rays = rays_at(start, direction=torch.tensor(way, dtype=torch.float64))
    found = lens.trace_polarised(rays)
    with mpmath.workdps(50):
        matrix = exact_matrix(start, way, [(20, 0, 1, mpmath.mpf("1.6")), (-15, 6, "1.6", 1)])
        known = [[float(matrix[i, j]) for j in range(3)] for i in range(3)]
        power = float((sum(v**2 for v in matrix) - 1) / 2)
    error = found.matrix[0].detach() - torch.tensor(known, dtype=torch.complex128)
    assert float(error.abs().max()) < 2e-15
    assert float(found.transmission.detach()) == pytest.approx(power, rel=2e-15)


def exact_matrix(start, way, surfaces):
    """P of a ray through bare spheres (radius, z of the vertex, indices), by its definition."""
    at, k = mpmath.matrix([mpmath.mpf(v) for v in start]), mpmath.matrix([*map(mpmath.mpf, way)])
    k = k / mpmath.norm(k)
    matrix = mpmath.eye(3)
    for radius, z, before, behind in surfaces:
        n, m, radius = mpmath.mpf(before), mpmath.mpf(behind), mpmath.mpf(radius)
        away = at - mpmath.matrix([0, 0, z + radius])
        b, c = mpmath.fdot(away, k), mpmath.fdot(away, away) - radius**2
        t = -b - mpmath.sign(radius) * mpmath.sqrt(b * b - c)
        at = at + t * k
        normal = -(at - mpmath.matrix([0, 0, z + radius])) / radius
        cosine = mpmath.fdot(k, normal)
        inside = mpmath.sqrt(1 - (n / m) ** 2 * (1 - cosine**2))
        onward = (n / m) * k + (inside - n / m * cosine) * normal
        s = cross(k, normal)
        s = s / mpmath.norm(s)
        root = mpmath.sqrt(m * inside / (n * cosine))
        t_s = 2 * n * cosine / (n * cosine + m * inside) * root
        t_p = 2 * n * cosine / (m * cosine + n * inside) * root
        front, back = columns(s, cross(k, s), k), columns(s, cross(onward, s), onward)
        matrix = back * mpmath.diag([t_s, t_p, 1]) * front.T * matrix
        k = onward
    return matrix


def cross(a, b):
    return mpmath.matrix(
        [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
    )


def columns(*vectors):
    return mpmath.matrix([[v[i] for v in vectors] for i in range(3)])


def test_an_ideal_lens_turns_the_field_and_no_more():
    lens = dolens.load_lens("double_gauss").requires_grad_(False)
    found = lens.trace_polarised(skew_rays(lens, (5.0, 12.0)))
    assert torch.equal(found.transmission, torch.ones(5, dtype=torch.float64))
    unit = found.matrix.mH @ found.matrix
    assert float((unit - torch.eye(3, dtype=unit.dtype)).abs().max()) < 1e-14
    onward = (found.matrix @ found.front[..., 2:].to(unit.dtype))[..., 0].real
    assert float((onward - found.rays.direction).abs().max()) < 1e-15


def mirrors(normals, vertices, coating=None, **keys):
    """Plane mirrors whose local z are unit vectors, at vertices (mm)."""
    rows, elements = {}, {}
    for number, (normal, vertex) in enumerate(zip(normals, vertices, strict=True), 1):
        rows[str(number)] = {"type": "plane", "semi_diameter": 50, "material": "mirror"}
        rows[str(number)] |= {} if number == len(normals) else {"thickness": 0.0}
        rows[str(number)] |= {} if coating is None else {"coating": coating}
        tilt_y = math.degrees(math.asin(normal[0]))
        tilt_x = math.degrees(math.atan2(-normal[1], normal[2]))
        place = {"decenter_x": vertex[0], "decenter_y": vertex[1], "shift_z": vertex[2]}
        pose = {"surfaces": [number, number], "tilt_x": tilt_x, "tilt_y": tilt_y} | place
        elements[str(number)] = pose
    return {"surfaces": rows, "elements": elements, "sensor": {"distance": 90.0}} | keys


def test_a_corner_cube_of_ideal_mirrors_gives_the_field_back():
    third, half, sixth = (1.0 / math.sqrt(n) for n in (3, 2, 6))
    walls = [(half, sixth, third), (-half, sixth, third), (0.0, -2.0 * sixth, third)]
    # Light comes to the second from the other side of its own axis.
    walls[1] = tuple(-v for v in walls[1])
    given = mirrors(walls, 3 * [(0.0, 0.0, 0.0)])
    given["sensor"] = {"distance": -90.0}
    lens = lens_from_prescription(given)
    rays = rays_at((-3.0, -1.0, -40.0))
    found = lens.trace_polarised(rays)
    assert bool(found.rays.valid.all())
    back = torch.diag(torch.tensor([1.0, 1.0, -1.0])).to(torch.complex128)
    assert float((found.matrix[0] - back).abs().max().detach()) < 1e-14


def test_a_fresnel_rhomb_is_a_quarter_wave_plate():
    theta, n = math.radians(54.6), 1.51
    side = (0.0, -math.sin(theta), math.cos(theta))
    there = (0.0, 20.0 * math.sin(2 * theta), -20.0 * math.cos(2 * theta))
    glass = {"layers": [], "substrate": "air"}
    given = mirrors([side, side], [(0.0, 0.0, 5.0), (0.0, there[1], 5.0 + there[2])], glass)
    front = {"type": "plane", "semi_diameter": 50, "material": str(n), "thickness": 0.0}
    rows = given["surfaces"]
    given["surfaces"] = {"1": front, "2": rows["1"], "3": rows["2"]}
    for name, element in given["elements"].items():
        element["surfaces"] = [int(name) + 1, int(name) + 1]
    found = lens_from_prescription(given).trace_polarised(rays_at((0.1, 0.2, -1.0)))
    assert bool(found.rays.valid.all())
    sine2 = math.sin(theta) ** 2
    half = math.atan(math.cos(theta) * math.sqrt(sine2 - 1.0 / n**2) / sine2)
    jones = found.jones[0].detach()
    assert float(found.transmission.detach()) == pytest.approx(1.0, abs=1e-14)
    turn = complex(jones[1, 1] / jones[0, 0])
    assert abs(math.atan2(turn.imag, turn.real)) == pytest.approx(4.0 * half, abs=1e-13)
    assert math.degrees(4.0 * half) == pytest.approx(90.0, abs=0.6)


def test_a_metal_mirror_at_45_degrees_has_its_two_amplitudes():
    given = mirrors([(0.0, -math.sqrt(0.5), math.sqrt(0.5))], [(0.0, 0.0, 0.0)])
    given["surfaces"]["1"]["coating"] = {"layers": [], "substrate": SILVER}
    given["surfaces"]["1"]["semi_diameter"] = 20
    found = lens_from_prescription(given).trace_polarised(rays_at((1.0, 0.5, -9.0)))
    cosine = torch.tensor(math.sqrt(0.5), dtype=torch.float64)
    known = amplitudes(1.0, [], complex(*SILVER), cosine, 550.0)
    p = found.matrix[0].detach()
    assert complex(p[0, 0]) == pytest.approx(complex(known.r_s), rel=1e-13)
    # From y it goes to z, and p of both is along them: k × s is -y for light along z, and z for y.
    assert complex(p[2, 1]) == pytest.approx(-complex(known.r_p), rel=1e-13)


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_derivatives_are_those_of_differences(dtype):
    lens = coated(dolens.load_lens("cooke_triplet", dtype=dtype), "quarter_wave")
    names = ["surfaces.1.coating.thickness_1", "surfaces.4.curvature", "thicknesses.2"]
    fine = coated(dolens.load_lens("cooke_triplet"), "quarter_wave")
    rays = skew_rays(fine, (3.0, 14.0))
    weight = torch.randn(5, 3, 3, generator=torch.Generator().manual_seed(1)).double()

    def number(of, name, value):
        matrix = of.with_values({name: value}).trace_polarised(rays).matrix
        return (weight * torch.view_as_real(matrix).sum(-1)).sum()

    for name in names:
        value = dict(lens.named_parameters())[name].detach().clone().requires_grad_()
        slope = float(torch.autograd.grad(number(lens, name, value), value)[0])
        at = dict(fine.named_parameters())[name].detach()
        step = 1e-3 if "coating" in name else 1e-6 if "curv" in name else 1e-5
        low, high = (float(number(fine, name, at + sign * step).detach()) for sign in (-1.0, 1.0))
        known = (high - low) / (2.0 * step)
        assert slope == pytest.approx(known, rel=1e-6 if dtype is torch.float64 else 5e-3)


@pytest.mark.parametrize("coating", ["none", "quarter_wave"])
def test_at_normal_incidence_the_field_and_its_derivative_are_finite(coating):
    lens = coated(dolens.load_lens("cooke_triplet"), coating)
    # On the axis, and closer and closer to it.
    near = [(0.0, y, -1.0) for y in (0.0, 1e-12, 1e-8, 1e-5)]
    found = lens.trace_polarised(rays_at(*near))
    jones = found.jones.detach()
    assert float((jones - jones[0]).abs().max()) < 1e-11
    assert abs(complex(jones[0, 0, 0] - jones[0, 1, 1])) < 1e-15
    curvature = lens.surfaces["1"].curvature
    for row in found.transmission:
        slope = torch.autograd.grad(row, curvature, retain_graph=True)[0]
        assert abs(float(slope)) < 1e-7
    away = torch.zeros(4, dtype=torch.float64, requires_grad=True)
    start = torch.stack([away, away.detach() + 1e-4 * torch.arange(4), away.detach() - 1.0], -1)
    matrix = lens.trace_polarised(Rays(start, AXIS, 550.0)).matrix
    assert bool(torch.autograd.grad(matrix.real.sum(), away)[0].isfinite().all())


def test_invalid_rays_are_finite_and_have_no_gradient():
    lens = coated(dolens.load_lens("cooke_triplet"), "quarter_wave")
    rays = rays_at((0.0, 0.0, -1.0), (0.0, 400.0, -1.0), (0.0, 6.0, -1.0))
    found = lens.trace_polarised(rays)
    assert found.rays.valid.tolist()[:2] == [True, False]
    assert bool(torch.view_as_real(found.matrix).isfinite().all())
    names = [p for p in lens.parameters() if p.requires_grad]
    slopes = torch.autograd.grad(found.matrix.real.sum(), names, allow_unused=True)
    assert all(bool(s.isfinite().all()) for s in slopes if s is not None)
    dark = torch.autograd.grad(lens.trace_polarised(rays).transmission[1], names, allow_unused=True)
    assert all(s is None or float(s.abs().max()) == 0.0 for s in dark)


def test_no_ray_gains_power_and_single_precision_is_close():
    for name, coating in (("nikon", "none"), ("double_gauss", "quarter_wave")):
        lens = coated(dolens.load_lens(name), coating).requires_grad_(False)
        rays = skew_rays(lens, (3.0, 10.0))
        found = lens.trace_polarised(rays)
        largest = torch.linalg.svdvals(found.jones)[..., 0]
        assert bool((largest[found.rays.valid] < 1.0).all())
        single = lens.to(torch.float32).trace_polarised(rays)
        error = (single.matrix - found.matrix)[found.rays.valid].abs().max()
        assert 0.0 < float(error) < 1e-5


def test_the_product_of_means_is_not_the_transmission():
    lens = coated(dolens.load_lens("cooke_triplet"), "none").requires_grad_(False)
    rays = skew_rays(lens, (0.0, 20.0))
    scalar = lens.trace(rays, transmission=True).transmission
    exact = lens.trace_polarised(rays).transmission
    assert bool((exact > scalar).all()) and float((exact - scalar).max()) < 0.01


def test_a_table_of_shares_has_no_phases():
    lens = coated(dolens.load_lens("cooke_triplet"), {1: {"table": [[550, 0, 0, 0, 0.9, 0.9]]}})
    with pytest.raises(InputError, match="no phases"):
        lens.trace_polarised(skew_rays(lens))


@pytest.mark.parametrize("layers", [[], [(1.38, 99.6)], [(1.38, 90.0), (2.1, 60.0), (1.7, 80.0)]])
@pytest.mark.parametrize(("front", "behind"), [(1.0, 1.52), (1.52, 1.0), (1.6, 1.7)])
def test_real_arithmetic_gives_the_amplitudes_of_a_transparent_stack(layers, front, behind):
    films = [Layer(n, d) for n, d in layers]
    cosine = torch.linspace(0.8, 1.0, 9, dtype=torch.float64)
    known = amplitudes(front, films, behind, cosine, 550.0)
    t_s, t_p = transparent(front, films, behind, cosine, 550.0)
    for found, expected in ((t_s, known.t_s), (t_p, known.t_p)):
        part = 0.0 if found.imaginary is None else found.imaginary
        error = torch.complex(found.real, part + 0.0 * found.real) - expected
        assert float(error.abs().max()) < 1e-15
    assert transparent(1.52, films, 1.0, cosine - 0.3, 550.0) is None
    assert transparent(1.0, [Layer(1.5 + 0.1j, 9.0)], 1.52, cosine, 550.0) is None
    assert float(shares(front, films, behind, cosine, 550.0).t_s.min()) < 1.0


def test_double_pole_axes_lie_across_rays_and_are_even_about_the_pole():
    pole = torch.nn.functional.normalize(torch.tensor([0.1, 0.3, 1.0]).double(), dim=0)
    way = torch.randn(20, 3, generator=torch.Generator().manual_seed(0)).double()
    way = torch.nn.functional.normalize(way, dim=-1)
    axes = double_pole_axes(way, pole)
    frame = torch.cat([axes, way[..., None]], -1)
    assert float((frame.mT @ frame - torch.eye(3)).abs().max()) < 1e-12
    assert bool((torch.linalg.det(frame) > 0.0).all())
    at = double_pole_axes(pole, pole)
    assert float((turned(at[:, 0], pole, way) - axes[..., 0]).abs().max()) < 1e-12


def test_a_tilted_element_has_the_matrix_of_tilted_rays():
    rows = [(20.0, 6.0, "1.6"), (-15.0, 5.0, "air")]
    given = {**prescription_of_rows(*rows, semi_diameter=9.0, sensor=90.0), "coating": "none"}
    tilts = {"tilt_x": 12.0, "tilt_y": -7.0, "tilt_z": 30.0}
    straight = lens_from_prescription(given).requires_grad_(False)
    given["elements"] = {"1": {"surfaces": [1, 2], **tilts}}
    tilted = lens_from_prescription(given).requires_grad_(False)
    angles = torch.deg2rad(torch.tensor([*tilts.values()], dtype=torch.float64))
    turn = rotation_matrix(*angles)
    position = torch.tensor([[3.0, -2.0, -5.0], [0.5, 1.0, -9.0]], dtype=torch.float64)
    way = torch.nn.functional.normalize(torch.tensor([0.2, -0.1, 1.0]).double(), dim=0)
    there = tilted.trace_polarised(Rays(position @ turn.mT, turn @ way, 550.0))
    here = straight.trace_polarised(Rays(position, way, 550.0))
    turn = turn.to(torch.complex128)
    assert bool(there.rays.valid.all())
    assert float((there.matrix - turn @ here.matrix @ turn.mT).abs().max()) < 1e-14


def test_glass_takes_its_share_of_the_power(tmp_path):
    (tmp_path / "own.agf").write_text(
        "NM CLOUDY 2 0 1.5 60 0\nCD 1.25 0 0 0 0 0\nLD 0.3 2.0\nIT 0.4 0.5 10\nIT 0.6 0.9 10\n"
    )
    with dolens.optics.glass_catalog.glass_folders(tmp_path):
        rows = prescription_of_rows((math.inf, 4.0, "OWN:CLOUDY"), (math.inf, 0.0, "air"))
        rays = rays_at((0.0, 0.0, -1.0), wavelength=600.0)
        found = lens_from_prescription(rows).trace_polarised(rays)
    assert float(found.transmission.detach()) == pytest.approx(0.9**0.4, rel=1e-13)
