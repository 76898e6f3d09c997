"""Gratings, diffractive phases and ideal lenses do what their laws say."""

import math

import pytest
import torch

from dolens import InputError, Rays, Status
from dolens.prescriptions import lens_from_prescription

pytestmark = pytest.mark.usefixtures("backend")

F64 = torch.float64
WAVE = 587.5618
GLASS = "1.5168/64.17"


def lens_of(*rows, distance=20.0, **more):
    rows = [{"semi_diameter": 30.0, "material": "air", **row} for row in rows]
    surfaces = {str(i): row for i, row in enumerate(rows, 1)}
    return lens_from_prescription({"surfaces": surfaces, "sensor": {"distance": distance}, **more})


def grating(grooves=600.0, order=1, **row):
    return {
        "type": "plane",
        "phase": {"type": "grating", "grooves": grooves, "order": order},
        **row,
    }


def directions(count=40, tilt=0.5, seed=3):
    d = torch.randn(count, 3, dtype=F64, generator=torch.Generator().manual_seed(seed))
    d = d * tilt + torch.tensor([0.0, 0.0, 1.0], dtype=F64)
    d[:, 2] = d[:, 2].abs() + 0.3
    return d / d.norm(dim=-1, keepdim=True)


def starts(count=40, seed=4):
    p = torch.randn(count, 3, dtype=F64, generator=torch.Generator().manual_seed(seed))
    return 2.0 * p - torch.tensor([0.0, 0.0, 8.0], dtype=F64)


@pytest.mark.parametrize("order", [-2, 0, 1])
def test_a_plane_grating_obeys_the_grating_equation(order):
    """n'·sin θ' - n·sin θ = m·λ·G across the grooves, and Snell's law along them."""
    lens = lens_of(grating(300.0, order), object_material=GLASS)
    glass = lens.materials[0].index(WAVE)
    d = directions()
    hit = lens.trace(Rays(starts(), d, WAVE))
    ok = hit.valid
    assert 10 < ok.sum() < 40
    out = hit.direction[ok]
    assert (out[:, 0] - glass * d[ok, 0]).abs().max() < 1e-14
    assert (out[:, 1] - glass * d[ok, 1] - order * WAVE * 300e-6).abs().max() < 1e-14
    assert (out.norm(dim=-1) - 1.0).abs().max() < 1e-14


@pytest.mark.parametrize("material", ["air", GLASS, "mirror"])
def test_a_curved_grating_obeys_the_vector_equation(material):
    """n'·(d' × N) = n·(d × N) + m·λ·(G × N), with the grooves' planes equally spaced."""
    row = {"type": "conic", "radius": -60.0, "conic": -2.0, "material": material}
    phase = {"type": "grating", "grooves": 250.0, "order": 2}
    lens = lens_of({**row, "phase": phase}, distance=-20.0 if material == "mirror" else 20.0)
    d = directions(tilt=0.25)
    hit = lens.trace(Rays(starts(), d, WAVE), record=True)
    ok = hit.valid
    assert ok.sum() > 20
    x, y, z = hit.points[0][ok].unbind(-1)
    c, k = -1.0 / 60.0, -2.0
    normal = torch.stack([-c * x, -c * y, 1.0 - (1.0 + k) * c * z], -1)
    normal = normal / normal.norm(dim=-1, keepdim=True)
    behind = lens.materials[1].index(WAVE) if material == GLASS else 1.0
    vector = torch.tensor([0.0, 250.0, 0.0], dtype=F64).expand_as(normal) * (2 * WAVE * 1e-6)
    left = behind * torch.linalg.cross(hit.direction[ok], normal)
    right = torch.linalg.cross(d[ok], normal) + torch.linalg.cross(vector, normal)
    assert (left - right).abs().max() < 1e-14
    sense = -1.0 if material == "mirror" else 1.0
    assert bool(((hit.direction[ok] * normal).sum(-1) * sense > 0.0).all())


def test_a_grating_on_germanium_lets_light_out():
    """The cosine in front times n/n' is up to 4, beyond any direction's component."""
    lens = lens_of(grating(100.0), object_material="4.0")
    d = directions(tilt=0.03)
    d = d[d[:, :2].norm(dim=-1) < 0.2]
    hit = lens.trace(Rays(starts(len(d)), d, WAVE))
    assert bool(hit.valid.all()) and len(d) > 20
    expected = 4.0 * d[:, :2] + torch.tensor([0.0, WAVE * 100e-6], dtype=F64)
    assert (hit.direction[:, :2] - expected).abs().max() < 1e-14
    assert (hit.direction.norm(dim=-1) - 1.0).abs().max() < 1e-14


def test_grooves_on_a_steep_slope_turn_light_by_what_lies_along_it():
    """Most of m·λ·G = 3.5 is along the normal, and leaves the direction a unit vector whose
    derivatives are those of differences.
    """
    lens = lens_of({"type": "conic", "curvature": 1.0, "conic": -1.0, **{
        "phase": {"type": "grating", "grooves": 3.5e6 / WAVE}}})  # fmt: skip
    d = torch.tensor([[0.0, 0.0, 1.0]], dtype=F64)

    def direction(y):
        place = torch.stack((torch.zeros_like(y), y, torch.full_like(y, -3.0)), -1)
        hit = lens.trace(Rays(place[None], d, WAVE))
        assert bool(hit.valid)
        return hit.direction[0]

    y = torch.tensor(-5.0, dtype=F64, requires_grad=True)
    found = direction(y)
    normal = torch.tensor([0.0, 5.0, 1.0], dtype=F64) / math.sqrt(26.0)
    added = torch.tensor([0.0, 3.5, 0.0], dtype=F64)
    change = torch.linalg.cross(found - d[0] - added, normal)
    assert change.abs().max() < 1e-14 and abs(float(found.detach().norm()) - 1.0) < 1e-14
    [slope] = torch.autograd.grad(found[1], y)
    with torch.no_grad():
        above, below = direction(y + 1e-5), direction(y - 1e-5)
    assert float(slope) == pytest.approx(float(above[1] - below[1]) / 2e-5, rel=1e-7)


def test_an_evanescent_order_ends_like_total_reflection():
    lens = lens_of(grating(1800.0, thickness=5.0), {"type": "sphere", "radius": 50.0})
    d = torch.tensor([[0.0, 0.0, 1.0], [0.0, -0.6, 0.8]], dtype=F64)
    hit = lens.trace(Rays(torch.zeros(2, 3, dtype=F64), d, WAVE))
    assert hit.status.tolist() == [Status.TIR, Status.OK]
    assert hit.surface.tolist() == [1, 0]


def test_a_plane_wave_stays_one_behind_a_grating():
    """Its rays have equal paths to a plane across them: paths and directions belong together."""
    lens = lens_of(grating(700.0, -1), object_material=GLASS)
    d = torch.tensor([0.1, 0.25, 0.0], dtype=F64)
    d[2] = (1.0 - d.square().sum()).sqrt()
    p = starts(20)
    hit = lens.trace(Rays(p, d.expand(20, 3), WAVE))
    assert bool(hit.valid.all())
    glass = lens.materials[0].index(WAVE)
    phase = hit.path_length + glass * (p @ d) - (hit.position * hit.direction).sum(-1)
    assert (phase - phase[0]).abs().max() < 1e-12


def zone_plate(focus, wavelength, order=1, terms=24, radius=5.0):
    """The phase -2π/λ·(√(r² + f²) - f) as a polynomial in r/R."""
    row, binomial = {"type": "radial", "norm_radius": radius, "order": order}, 1.0
    for k in range(1, terms + 1):
        binomial *= (1.5 - k) / k
        path = binomial * radius ** (2 * k) * focus ** (1 - 2 * k)
        row[f"p{2 * k}"] = -2.0 * math.pi / (wavelength * 1e-6) * path / order
    return row


@pytest.mark.parametrize("order", [1, 3])
def test_an_ideal_zone_plate_focuses_its_wavelength_perfectly(order):
    lens = lens_of({"type": "plane", "semi_diameter": 5.01, "phase": zone_plate(20.0, WAVE, order)})
    x = torch.linspace(-5.0, 5.0, 21, dtype=F64)
    p = torch.stack([x, 0.3 * x.flip(0), -1.0 + 0.0 * x], -1)
    p = p[p.norm(dim=-1) < 5.0]
    hit = lens.trace(Rays(p, torch.tensor([0.0, 0.0, 1.0], dtype=F64).expand_as(p), WAVE))
    assert bool(hit.valid.all())
    assert hit.position[:, :2].abs().max() < 1e-12
    assert (hit.path_length - 21.0).abs().max() < 1e-12
    assert abs(lens.first_order(WAVE).efl.item() - 20.0) < 1e-12
    # A diffractive lens of half the wavelength has half the power.
    assert abs(lens.first_order(0.5 * WAVE).efl.item() - 40.0) < 1e-12


def test_path_lengths_are_those_of_the_phase_at_each_rays_own_wavelength():
    phase = {"type": "xy", "norm_radius": 2.0, "x": 3.0, "xy": -2.0, "y3": 5.0}
    lens = lens_of({"type": "plane", "phase": phase}, distance=0.0)
    waves = torch.tensor([450.0, 550.0, 650.0], dtype=F64)
    p = torch.tensor([[1.0, -0.7, 0.0]], dtype=F64).expand(3, 3)
    d = torch.tensor([[0.0, 0.0, 1.0]], dtype=F64).expand(3, 3)
    hit = lens.trace(Rays(p, d, waves))
    u, v = 0.5, -0.35
    radians = 3.0 * u - 2.0 * u * v + 5.0 * v**3
    path = radians * waves * 1e-6 / (2.0 * math.pi)
    assert (hit.path_length - path).abs().max() < 1e-15
    slope = (3.0 - 2.0 * v) / 2.0 * waves * 1e-6 / (2.0 * math.pi)
    assert (hit.direction[:, 0] - slope).abs().max() < 1e-15


@pytest.mark.parametrize("front, behind", [("air", "air"), ("1.33", GLASS)])
@pytest.mark.parametrize("distance", [math.inf, 130.0, 60.0, 30.0])
def test_an_ideal_lens_images_points_with_equal_paths(front, behind, distance):
    """Every ray of an object point of its plane meets the image point, with the path of the rest.

    60 mm is the front focus in air; from 30 mm the image is virtual.
    """
    more = {} if math.isinf(distance) else {"object_distance": distance}
    lens = lens_of({"type": "paraxial_lens", "focal_length": 60.0, "material": behind},
                   distance=1.0, object_material=front, **more)  # fmt: skip
    n, n2 = (float(m.index(WAVE)) for m in lens.materials)
    reduced = 0.0 if math.isinf(distance) else n / distance
    x = torch.linspace(-20.0, 20.0, 9, dtype=F64)
    on_lens = torch.stack([x, 8.0 - 0.3 * x, 0.0 * x], -1)
    if math.isinf(distance):
        d = torch.tensor([0.1, -0.4, 1.0], dtype=F64)
        d = (d / d.norm()).expand(9, 3)
        p, before = on_lens - 5.0 * d, None
        start = n * ((p - 0.0) @ d[0])
    else:
        source = torch.tensor([3.0, -11.0, -distance], dtype=F64)
        d = (on_lens - source) / (on_lens - source).norm(dim=-1, keepdim=True)
        p, start = source.expand(9, 3), torch.zeros(9, dtype=F64)
        before = source
    hit = lens.trace(Rays(p, d, WAVE))
    assert bool(hit.valid.all())
    vergence = 1.0 / 60.0 - reduced
    if abs(vergence) < 1e-9:
        across = hit.direction - hit.direction[0]
        assert across.abs().max() < 1e-14
        path = hit.path_length - n2 * (hit.position @ hit.direction[0])
    else:
        image = n2 / vergence
        slopes = hit.direction[:, :2] / hit.direction[:, 2:]
        there = hit.position[:, :2] + (image - 1.0) * slopes
        assert (there - there[0]).abs().max() < 1e-12 * max(1.0, abs(image))
        if before is not None:
            magnified = -before[:2] * image * n / (distance * n2)
            assert (there[0] - magnified).abs().max() < 1e-11
        path = hit.path_length + n2 * (image - 1.0) * hit.direction[:, 2].reciprocal()
    path = path + start
    assert (path - path[0]).abs().max() < 1e-11


def test_a_pair_of_ideal_lenses_sees_the_object_through_the_first():
    """The vergence at the second lens follows the gap, and its gradient too."""
    rows = ({"type": "paraxial_lens", "focal_length": 100.0, "thickness": 125.0},
            {"type": "paraxial_lens", "focal_length": 25.0})  # fmt: skip
    lens = lens_of(*rows, distance=10.0)
    assert float(lens.first_order(WAVE).power) == pytest.approx(0.0, abs=1e-17)
    p = torch.tensor([[4.0, 3.0, 0.0], [-8.0, 1.0, 0.0]], dtype=F64)
    d = torch.tensor([0.05, 0.02, 1.0], dtype=F64)
    d = d / d.norm()
    hit = lens.trace(Rays(p, d.expand(2, 3), WAVE))
    assert (hit.direction[0] - hit.direction[1]).abs().max() < 1e-15
    assert (hit.direction[0, 0] / hit.direction[0, 2] + 4.0 * 0.05).abs() < 1e-14
    path = hit.path_length + (p @ d) - hit.position @ hit.direction[0]
    assert (path[0] - path[1]).abs() < 1e-12

    def second_path(gap):
        with torch.no_grad():
            lens.thicknesses["1"].copy_(gap)
        return lens.trace(Rays(p, d.expand(2, 3), WAVE)).path_length[1]

    gap = torch.tensor(120.0, dtype=F64)
    second_path(gap).backward()
    ends = [float(second_path(gap + h).detach()) for h in (-1e-4, 1e-4)]
    assert float(lens.thicknesses["1"].grad) == pytest.approx((ends[1] - ends[0]) / 2e-4, rel=1e-7)


def test_seidel_sums_are_those_of_real_rays():
    """A diffractive lens: S_I from the longitudinal aberration of a narrow beam, and petzval."""
    lens = hybrid_rotational()
    sums = lens.seidel(0.0, WAVE).total
    first = lens.first_order(WAVE)
    h = torch.tensor([0.2, 0.4], dtype=F64)
    p = torch.stack([0.0 * h, h, -1.0 + 0.0 * h], -1)
    hit = lens.trace(Rays(p, torch.tensor([0.0, 0.0, 1.0], dtype=F64).expand(2, 3), WAVE))
    slope = hit.direction[:, 1] / hit.direction[:, 2]
    last = float(first.focus) - 20.0 - 4.0
    at_focus = hit.position[:, 1] + slope * last
    # ε_y = ∂W/∂y / (n'u') with W = S_I·r⁴/8 at the edge of 7 mm.
    edge = 7.0
    angle = -edge / float(first.efl)
    expected = float(sums.spherical) * (h / edge) ** 3 / 2.0 / angle
    # The next order goes with h⁵: extrapolate the ratio to h = 0.
    ratio = at_focus / expected
    assert float((4.0 * ratio[0] - ratio[1]) / 3.0) == pytest.approx(1.0, abs=1e-5)


def hybrid_rotational():
    return lens_of(
        {"type": "sphere", "radius": 25.0, "thickness": 4.0, "semi_diameter": 7.0,
         "material": GLASS,
         "phase": {"type": "radial", "norm_radius": 7.0, "p2": -400.0, "p4": 60.0}},
        {"type": "sphere", "radius": -80.0, "semi_diameter": 7.0},
    )  # fmt: skip


def test_seidel_sums_refuse_a_grating_by_name():
    with pytest.raises(InputError, match="surface 1: Seidel sums do not describe a grating"):
        lens_of(grating()).seidel(1.0)


def test_an_ideal_lens_has_no_seidel_sums():
    lens = lens_of({"type": "paraxial_lens", "focal_length": 60.0}, object_distance=200.0)
    assert all(float(s.abs()) == 0.0 for s in lens.seidel(5.0, WAVE, 200.0).total)


def test_an_ideal_lens_cannot_be_a_mirror():
    with pytest.raises(InputError, match="surface 1: a paraxial lens cannot be a mirror"):
        lens_of({"type": "paraxial_lens", "focal_length": 60.0, "material": "mirror"})


def test_behind_an_axicon_an_ideal_lens_focuses_into_a_ring_with_equal_paths():
    """The cone turns light along the axis to a plane wave in each half of the plane y = 0."""
    surfaces = {
        "1": {"type": "plane", "semi_diameter": 5.0, "thickness": 2.0, "material": "1.5"},
        "2": {"type": "odd_asphere", "radius": math.inf, "a1": -0.1, "semi_diameter": 5.0,
              "thickness": 10.0, "material": "air"},
        "3": {"type": "paraxial_lens", "focal_length": 50.0, "semi_diameter": 9.0,
              "material": "air"},
    }  # fmt: skip
    lens = lens_from_prescription({"surfaces": surfaces, "sensor": {"distance": 50.0}})
    position = torch.tensor([[x, 0.0, -1.0] for x in (1.0, 2.0, 4.5)], dtype=F64)
    hit = lens.trace(Rays(position, torch.tensor([0.0, 0.0, 1.0], dtype=F64)))
    assert bool(hit.valid.all())
    base = math.atan(0.1)
    ring = -50.0 * math.tan(math.asin(1.5 * math.sin(base)) - base)
    assert hit.position[:, 0].tolist() == pytest.approx([ring] * 3, rel=1e-13)
    assert (hit.path_length - hit.path_length[0]).abs().max() < 1e-12
    gradients = torch.autograd.grad(
        hit.path_length.sum(), list(lens.parameters()), allow_unused=True
    )
    assert all(g is None or bool(g.isfinite().all()) for g in gradients)
