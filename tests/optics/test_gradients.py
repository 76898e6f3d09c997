"""Media whose index changes: closed forms, and an integrator of another kind."""

import math

import numpy as np
import pytest
import torch
from scipy.integrate import quad, solve_ivp
from torch.func import jacfwd

import dolens
from dolens import InputError, Rays
from dolens.analysis.ray_path import ray_path
from dolens.optics import bent_rays
from dolens.optics.bent_motion import Motion, carry
from dolens.optics.gradients import KERNEL_TERMS, Bend, Gradient
from dolens.optics.jacobian import ray_jacobian
from dolens.optics.lens_family import trace_lenses
from dolens.optics.materials import index_model, parse_material
from dolens.optics.paraxial import first_order
from dolens.optics.paraxial_rays import ParaxialNumbers
from dolens.optics.ray_tracing import choose_backend, trace_rays
from dolens.prescriptions.build import lens_from_prescription, prescription_of

N0, A = 1.6, 0.09  # of a rod with n² = n0²(1 - A·r²)
ROD = f"gradient_squared {N0} r2={-N0 * N0 * A!r}"
PITCH = 2.0 * math.pi / math.sqrt(A)


def lens_of(material, thickness, first=None, second=None, dtype=torch.float64, **more):
    """One element in air, of planes unless something else is said, and the sensor behind it."""
    plane = {"type": "plane", "semi_diameter": 3.0}
    rows = {
        "1": {**plane, "thickness": thickness, "material": material, **(first or {})},
        "2": {**plane, "material": "air", **(second or {})},
    }
    sensor = {"distance": more.pop("distance", 0.0)}
    return lens_from_prescription({"surfaces": rows, "sensor": sensor, **more}, dtype)


def beam(*points, slopes=None, z=-1.0, dtype=torch.float64):
    """Rays through points (x, y) in front of the lens, along the axis or with slopes."""
    xy = torch.tensor(points, dtype=dtype)
    position = torch.cat([xy, torch.full_like(xy[:, :1], z)], 1)
    slopes = torch.zeros_like(xy) if slopes is None else torch.tensor(slopes, dtype=dtype)
    direction = torch.cat([slopes, torch.ones_like(xy[:, :1])], 1)
    return Rays(position, direction / direction.norm(dim=-1, keepdim=True), 550.0)


def close(found, known, tolerance):
    found = found.detach() if isinstance(found, torch.Tensor) else found
    np.testing.assert_allclose(found, known, rtol=0.0, atol=tolerance)


def test_rays_in_a_parabolic_rod_are_sinusoids_of_their_own_period():
    # r'' = -ω²r along t, with dz/dt = T_z constant: exact for n² parabolic, skew rays too.
    length = 0.8 * PITCH
    lens = lens_of(ROD, length)
    rays = beam((0.0, 1.5), (0.7, -0.9), (1.2, 0.4), slopes=[(0.0, 0.0), (0.2, 0.1), (-0.1, 0.3)])
    hit = lens.trace(rays)
    start = rays.position + rays.direction * (1.0 / rays.direction[:, 2:])
    n = (N0**2 * (1.0 - A * (start[:, :2] ** 2).sum(-1))).sqrt()
    across = rays.direction[:, :2]  # n·sin is the same in air and behind the face
    along = (n**2 - (across**2).sum(-1)).sqrt()
    omega, t = N0 * math.sqrt(A), length / along
    swing = omega * t[:, None]
    known = start[:, :2] * torch.cos(swing) + across * torch.sin(swing) / omega
    assert bool(hit.valid.all())
    close(hit.position[:, :2], known, 2e-12)
    # ∫n²dt = T_z²·t + ∫(dr/dt)²dt.
    a, b = start[:, :2], across / omega
    wave, half = torch.sin(2.0 * swing) / (4.0 * omega), 0.5 * t[:, None]
    moved = omega**2 * (
        a * a * (half - wave) + b * b * (half + wave) - a * b * torch.sin(swing) ** 2 / omega
    )
    air = 1.0 / rays.direction[:, 2]
    close(hit.path_length, air + along**2 * t + moved.sum(-1), 5e-12)


def test_all_rays_through_a_luneburg_lens_meet_on_its_back_after_equal_paths():
    radius = 5.0
    medium = f"gradient_squared 1 r2={-1 / radius**2!r} z={2 / radius!r} z2={-1 / radius**2!r}"
    ball = {"type": "sphere", "semi_diameter": 4.95}
    lens = lens_of(medium, 2 * radius, {**ball, "radius": radius}, {**ball, "radius": -radius})
    hit = lens.trace(beam((0.0, 0.0), (0.0, 4.6), (3.1, -2.2), (-1.0, 2.0)))
    assert bool(hit.valid.all())
    close(hit.position, [[0.0, 0.0, 10.0]] * 4, 2e-12)
    close(hit.path_length, [1.0 + radius * (1.0 + math.pi / 2.0)] * 4, 5e-12)


def test_rays_in_maxwells_fish_eye_are_circles_that_close():
    # n = 2/(1 + r²), a stereographic sphere: all rays from r1 meet in -r1/|r1|², half a great
    # circle of path π away.

    def bend(x, y, z):
        r2 = x * x + y * y + z * z
        n = 2.0 / (1.0 + r2)
        slope = -(n**3)  # ½∇n² = n·∇n = -n·4r/(1 + r²)² = -n³·r
        return Bend(n * n, slope * x, slope * y, slope * z)

    angles = torch.linspace(-1.2, -0.3, 6, dtype=torch.float64)
    x0 = 0.5
    n0 = 2.0 / (1.0 + x0 * x0)
    one = torch.ones_like(angles)
    start = Motion(
        x0 * one, 0 * one, 0 * one, n0 * angles.sin(), 0.6 * n0 * angles.cos(),
        0.8 * n0 * angles.cos(), 0 * one,
    )  # fmt: skip
    t, motion = torch.zeros_like(one), start
    for _ in range(14):  # Newton, in bounded steps: dP/dt = n²
        left = (math.pi - motion.path) / bend(*motion[:3]).squared
        t = t + left.clamp(-0.4, 0.4)
        motion = carry(bend, start, t, 150)
    image = torch.tensor([-1.0 / x0, 0.0, 0.0], dtype=torch.float64).expand(6, 3)
    close(torch.stack(motion[:3], -1), image, 1e-10)
    close(motion.path, [math.pi] * 6, 1e-12)
    # On the way the ray is on a circle through both points: its centre is as far from all of them.
    points = [torch.stack(carry(bend, start, share * t, 150)[:3], -1) for share in (0.2, 0.5, 0.8)]
    for ray in range(6):
        p, q, r, s = (v[ray] for v in (torch.tensor([[x0, 0.0, 0.0]] * 6), *points))
        along, across = q - p, r - p
        normal = torch.linalg.cross(along, across)
        centre = p + (
            torch.linalg.cross(normal, along) * across.dot(across)
            + torch.linalg.cross(across, normal) * along.dot(along)
        ) / (2.0 * normal.dot(normal))
        close((s - centre).norm(), (p - centre).norm(), 1e-9)
        close((image[ray] - centre).norm(), (p - centre).norm(), 1e-9)


def test_an_axial_gradient_keeps_n_sine_and_displaces_as_its_integral_says():
    terms = {"z": 0.03, "z2": -0.004, "z3": 5e-4, "z4": -2e-5}
    medium = "gradient 1.5 " + " ".join(f"{k}={v!r}" for k, v in terms.items())
    slope = 0.5
    rays = beam((0.0, -1.0), slopes=[(0.0, slope)])
    hit = lens_of(medium, 4.0).trace(rays)
    sine = slope / math.hypot(1.0, slope)

    def n(z):
        return 1.5 + 0.03 * z - 0.004 * z * z + 5e-4 * z**3 - 2e-5 * z**4

    across, _ = quad(
        lambda z: sine / math.sqrt(n(z) ** 2 - sine**2), 0.0, 4.0, epsabs=1e-14, epsrel=1e-13
    )
    path, _ = quad(
        lambda z: n(z) ** 2 / math.sqrt(n(z) ** 2 - sine**2), 0.0, 4.0, epsabs=1e-14, epsrel=1e-13
    )
    close(hit.position[0, 1], -1.0 + slope + across, 1e-12)
    close(hit.direction[0], rays.direction[0], 1e-13)
    close(hit.path_length[0], math.hypot(1.0, slope) + path, 1e-11)


MEDIUM = "gradient 1.7 r2=-0.012 r4=3e-4 r6=-2e-5 z=0.02 z2=-0.003 x=0.01 y2=-0.004"
FRONT = {"type": "conic", "radius": 12.0, "conic": -0.4, "semi_diameter": 3.0}
BACK = {"type": "sphere", "radius": -9.0, "semi_diameter": 3.2}


def n_of(p):
    x, y, z = p
    r2 = x * x + y * y
    value = 1.7 - 0.012 * r2 + 3e-4 * r2**2 - 2e-5 * r2**3 + 0.02 * z - 0.003 * z * z
    radial = -0.024 + 12e-4 * r2 - 12e-5 * r2**2
    slope = [x * radial + 0.01, y * radial - 0.008 * y, 0.02 - 0.006 * z]
    return value + 0.01 * x - 0.004 * y * y, np.array(slope)


def by_arc_length(position, direction):
    """A ray through FRONT, MEDIUM and BACK by an integrator of order eight, along its length."""

    def sag(x, y, c, k):
        r2 = x * x + y * y
        return c * r2 / (1.0 + math.sqrt(1.0 - (1.0 + k) * c * c * r2))

    def normal(p, c, k):
        x, y, _ = p
        e = math.sqrt(1.0 - (1.0 + k) * c * c * (x * x + y * y))
        v = np.array([-c * x / e, -c * y / e, 1.0])
        return v / np.linalg.norm(v)

    def snell(d, v, before, after):
        cosine = d @ v
        mu = before / after
        return mu * d + (math.sqrt(1.0 - mu * mu * (1.0 - cosine**2)) - mu * cosine) * v

    c, k = 1.0 / 12.0, -0.4
    t = -position[2] / direction[2]
    for _ in range(60):
        p = position + t * direction
        t = t - (p[2] - sag(p[0], p[1], c, k)) / (direction @ normal(p, c, k)) * normal(p, c, k)[2]
    p = position + t * direction
    d = snell(direction, normal(p, c, k), 1.0, n_of(p)[0])

    def slopes(_, y):
        n, g = n_of(y[:3])
        return np.concatenate([y[3:6] / n, g, [n]])

    def back(_, y):
        return y[2] - 4.0 - sag(y[0], y[1], -1.0 / 9.0, 0.0)

    back.terminal, back.direction = True, 1.0
    begin = np.concatenate([p, n_of(p)[0] * d, [t]])
    run = solve_ivp(slopes, (0.0, 20.0), begin, "DOP853", rtol=3e-14, atol=1e-14, events=back)
    y = run.y_events[0][0]
    n, _ = n_of(y[:3])
    return y[:3], snell(y[3:6] / n, normal(y[:3], -1.0 / 9.0, 0.0), n, 1.0), y[6]


RAYS = {
    "points": ((0.5, 1.0), (-1.8, 0.6), (0.2, -2.2)),
    "slopes": [(0.05, -0.1), (0.15, 0.02), (-0.02, 0.2)],
}


def thick_lens(dtype=torch.float64, **more):
    return lens_of(MEDIUM, 4.0, FRONT, BACK, dtype, **more)


def test_a_thick_lens_of_every_kind_of_term_agrees_with_an_integrator_of_order_eight():
    rays = beam(*RAYS["points"], slopes=RAYS["slopes"])
    hit = thick_lens().trace(rays, record=True)
    assert bool(hit.valid.all())
    for i in range(3):
        point, direction, path = by_arc_length(rays.position[i].numpy(), rays.direction[i].numpy())
        close(hit.points[1, i], point, 3e-12)
        close(hit.direction[i], direction, 3e-12)
        tail = (4.0 - point[2]) / direction[2]
        close(hit.path_length[i], path + tail, 1e-11)


def test_single_precision_is_near_to_double():
    rays = beam(*RAYS["points"], slopes=RAYS["slopes"])
    hit, single = thick_lens().trace(rays), thick_lens(torch.float32).trace(rays)
    assert bool(single.valid.all())
    close(single.position.double(), hit.position.detach(), 3e-6)


def test_the_path_of_one_ray_lists_where_it_bends_to():
    # Meridional and parallel in a rod: y = y0·cos ωt, and n·sin θ = dy/dt at its end face.
    y0, length = 0.8, 0.15 * PITCH
    lens = lens_of(ROD, length)
    path = ray_path(lens, beam((0.0, y0)))
    first, second, sensor = path.crossings
    along = N0 * math.sqrt(1.0 - A * y0**2)
    phase = N0 * math.sqrt(A) * length / along
    assert first.point == pytest.approx((0.0, y0, 0.0), abs=1e-12) and first.incidence == 0.0
    assert second.point == pytest.approx((0.0, y0 * math.cos(phase), length), abs=1e-12)
    slope = y0 * N0 * math.sqrt(A) * math.sin(phase)
    n = math.hypot(slope, along)
    assert second.incidence == pytest.approx(math.degrees(math.asin(slope / n)), abs=1e-9)
    assert second.direction[1] == pytest.approx(-slope, abs=1e-12)
    assert sensor.surface == "sensor" and path.ending == "the ray reaches the sensor"
    # Steep rays go back into the rod.
    steep = ray_path(lens_of(f"gradient_squared {N0} r2=-0.6", 1.6), beam((0.0, 1.8)))
    assert "surface 2: total internal reflection" in steep.ending


def test_light_that_goes_back_takes_the_same_way():
    lens, rays = thick_lens(), beam(*RAYS["points"], slopes=RAYS["slopes"])
    hit = lens.trace(rays)
    back = lens.sensor_to_scene(Rays(hit.position, -hit.direction, 550.0))
    close(back.direction, -rays.direction, 2e-12)
    at = back.position + back.direction * ((-1.0 - back.position[:, 2:]) / back.direction[:, 2:])
    close(at, rays.position, 1e-11)


def test_a_mirror_behind_a_gradient_sends_light_back_through_the_same_profile():
    # Unfolded, a rod of half the pitch: an inverted image of the ray, and the same direction.
    medium = f"{ROD} z=0.0"
    rows = {
        "1": {"type": "plane", "semi_diameter": 3.0, "thickness": PITCH / 4, "material": medium},
        "2": {"type": "plane", "semi_diameter": 3.0, "thickness": -PITCH / 4, "material": "mirror"},
        "3": {"type": "plane", "semi_diameter": 3.0, "material": "air"},
    }
    lens = lens_from_prescription({"surfaces": rows, "sensor": {"distance": 0.0}})
    hit = lens.trace(beam((0.0, 0.02), (0.01, -0.01)))
    close(hit.position[:, :2], [[0.0, -0.02], [-0.01, 0.01]], 1e-9)
    assert float(lens.first_order(550.0).power) == pytest.approx(0.0, abs=1e-12)


def test_an_element_that_is_tilted_carries_its_profile_with_it():
    # Rays that are turned and moved with the element see what they saw before.
    pose = {"tilt_x": 5.0, "decenter_y": 0.3}
    elements = {"one": {"surfaces": [1, 2], **pose}}
    plain, tilted = thick_lens(distance=10.0), thick_lens(distance=10.0, elements=elements)
    rays = beam(*RAYS["points"], slopes=RAYS["slopes"])
    rotation, origin = tilted.system().place(1)
    turned = Rays(origin + rays.position @ rotation.T, rays.direction @ rotation.T, rays.wavelength)
    hit, other = plain.trace(rays), tilted.trace(turned)
    close(other.direction, (hit.direction.detach() @ rotation.T), 1e-12)


@pytest.mark.parametrize(
    "name",
    [
        *("surfaces.1.curvature", "surfaces.2.curvature", "thicknesses.1", "elements.one.tilt_x"),
        "surfaces.1.gradient.r2",
    ],
)
def test_derivatives_are_those_of_differences(name):
    elements = {"one": {"surfaces": [1, 2], "tilt_x": 2.0, "decenter_y": 0.1}}
    lens = thick_lens(distance=6.0, elements=elements)
    rays = beam(*RAYS["points"], slopes=RAYS["slopes"])
    weights = torch.linspace(-1.0, 1.0, 9, dtype=torch.float64)

    def output(value):
        hit = lens.with_values({name: value}).trace(rays)
        return torch.cat([hit.position[:, :2].reshape(-1), hit.path_length]) @ weights

    value = dict(lens.named_parameters())[name].detach().clone().requires_grad_()
    (found,) = torch.autograd.grad(output(value), value)
    step = 1e-6 if ".gradient." in name else 1e-5
    with torch.no_grad():
        known = (output(value + step) - output(value - step)) / (2.0 * step)
    close(found, known, 1e-8 * float(known.abs().clamp(min=1.0)))
    if name not in ("thicknesses.1", "surfaces.1.gradient.r2"):
        return
    forward = ray_jacobian(lens, rays, [name], ("x", "y", "path_length")).derivatives
    mixed = torch.cat([forward[:, :2, 0].reshape(-1), forward[:, 2, 0]]) @ weights
    close(mixed, found, 1e-11 * float(known.abs().clamp(min=1.0)))


def test_derivatives_with_respect_to_rays_and_wavelengths():
    lens = lens_of(MEDIUM.replace("1.7", "N-SF6"), 4.0, FRONT, BACK)
    start = beam((0.5, 1.0), slopes=[(0.05, -0.1)])

    def place(numbers):
        y, wavelength = numbers.unbind()
        position = start.position + torch.stack([0 * y, y, 0 * y])
        hit = trace_rays(lens.system(), Rays(position, start.direction, wavelength))
        return torch.cat([hit.position[0, :2], hit.path_length])

    at = torch.tensor([0.1, 600.0], dtype=torch.float64)
    found = torch.autograd.functional.jacobian(place, at)
    steps = torch.diag(torch.tensor([1e-5, 1e-2], dtype=torch.float64))
    known = [(place(at + s) - place(at - s)) / (2.0 * s.sum()) for s in steps]
    close(found, torch.stack(known, -1).detach(), 1e-8)
    close(jacfwd(place)(at), found, 1e-11)


def test_rays_that_are_lost_are_finite_and_spoil_no_gradient():
    # At a height of 2.9 mm the index would be negative.
    lens = lens_of("gradient 1.6 r2=-0.05 r4=-0.02", 6.0, FRONT, BACK)
    hit = lens.trace(beam((0.0, 0.1), (0.0, 2.9), (500.0, 0.0), (0.0, 1e9)))
    assert hit.valid.tolist() == [True, False, False, False]
    assert bool(hit.position.isfinite().all() and hit.path_length.isfinite().all())
    hit.position.sum().backward()
    for name, parameter in lens.named_parameters():
        assert parameter.grad is None or bool(parameter.grad.isfinite().all()), name


@pytest.mark.parametrize("term", KERNEL_TERMS)
@pytest.mark.parametrize("kind", ["gradient", "gradient_squared"])
def test_the_kernel_differentiates_every_term(monkeypatch, kind, term):
    monkeypatch.setattr(bent_rays, "_FEW", 1)
    words = " ".join(f"{name}={1e-3 * 0.1**i!r}" for i, name in enumerate(KERNEL_TERMS[:6]))
    medium = f"{kind} 1.6 {words} " + " ".join(f"{name}=2e-3" for name in KERNEL_TERMS[6:])
    lens, name = lens_of(medium, 2.0, FRONT, BACK), f"surfaces.1.gradient.{term}"
    rays = beam(*RAYS["points"], slopes=RAYS["slopes"])

    def outputs(value):
        hit = trace_rays(lens.system({name: value}), rays)
        weights = torch.tensor([1.0, -0.7, 0.4], dtype=torch.float64)
        return (hit.position[:, 0] - 2.0 * hit.position[:, 1] + 3.0 * hit.path_length) @ weights

    value = dict(lens.named_parameters())[name].detach().clone().requires_grad_()
    (found,) = torch.autograd.grad(outputs(value), value)
    step = 0.02 * abs(value.item())
    known = (outputs(value + step) - outputs(value - step)) / (2.0 * step)
    assert float(found) == pytest.approx(float(known.detach()), rel=2e-6)
    _, forward = torch.func.jvp(outputs, (value.detach(),), (torch.ones_like(value),))
    assert float(forward.detach()) == pytest.approx(float(found), rel=1e-10)


def test_lenses_of_several_profiles_are_traced_as_each_alone():
    lens, rays = thick_lens(distance=6.0), beam(*RAYS["points"], slopes=RAYS["slopes"])
    names = ["surfaces.1.gradient.r2", "thicknesses.1"]
    values = torch.tensor([[-0.012, 4.0], [0.008, 4.2]], dtype=torch.float64)
    found, _ = trace_lenses(lens, names, values, rays)
    for row, y in zip(values, found.y, strict=True):
        alone = lens.with_values(dict(zip(names, row, strict=True))).trace(rays)
        close(y, alone.position[:, 1].detach(), 1e-13)


def test_a_rod_is_made_a_quarter_of_its_pitch_long_by_its_profile():
    # Parallel light from a height r meets the axis where √A·L·(1 + A·r²/2) = π/2; the least Σ y² of
    # a disc of radius R weighs r² by itself, ∫r⁵dr/∫r³dr = 2R²/3.
    radius, length = 0.02, 5.0
    lens = lens_of(
        f"gradient_squared {N0} r2=-0.15",
        length,
        {"semi_diameter": radius},
        fields={"angles": [[0.0, 0.0]]},
        wavelengths=[550.0],
        stop=1,
    )
    better = lens.optimize(["surfaces.1.gradient.r2"], iterations=10)
    a = -dict(better.materials[1].terms)["r2"] / N0**2
    assert math.sqrt(a) * length * (1.0 + a * radius**2 / 3.0) == pytest.approx(
        math.pi / 2, rel=1e-7
    )
    # A file gets what was found.
    again = lens_from_prescription(prescription_of(better))
    assert again.materials == better.materials


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
@pytest.mark.parametrize("colours", [False, True])
@pytest.mark.parametrize("medium", [MEDIUM.replace("1.7", "N-SF6"), ROD])
def test_the_kernel_takes_the_same_steps_and_their_adjoint(monkeypatch, medium, colours, dtype):
    generator = torch.Generator().manual_seed(1)
    place, slope = torch.rand(2, 150, 2, generator=generator, dtype=dtype) * 2.0 - 1.0
    rays = beam(*place.tolist(), slopes=(0.1 * slope).tolist(), dtype=dtype)
    waves = torch.linspace(500.0, 650.0, 150, dtype=dtype) if colours else torch.tensor(550.0)
    lens = lens_of(medium, 4.0, FRONT, BACK, dtype)
    found = []
    for few in (1000, 100):
        monkeypatch.setattr(bent_rays, "_FEW", few)
        wavelength, position = (v.clone().requires_grad_() for v in (waves, rays.position))
        hit = trace_rays(lens.system(), Rays(position, rays.direction, wavelength))
        assert bool(hit.valid.all())
        outputs = torch.cat([hit.position[:, :2], hit.direction, hit.path_length[:, None]], 1)
        weights = torch.linspace(-1.0, 1.0, outputs.numel(), dtype=dtype).reshape(outputs.shape)
        leaves = [position, wavelength, *lens.parameters()]
        slopes = torch.autograd.grad((outputs * weights).sum(), leaves, allow_unused=True)
        found.append([outputs.detach(), *(g for g in slopes if g is not None)])
    for eager, kernel in zip(*found, strict=True):
        scale = eager.abs().max()
        close((kernel - eager) / scale, 0.0 * eager, 2e-13 if dtype is torch.float64 else 3e-5)


def test_a_batch_of_gradients_passes_the_kernel(monkeypatch):
    monkeypatch.setattr(bent_rays, "_FEW", 1)
    rays = beam(*RAYS["points"], slopes=RAYS["slopes"])
    lens = thick_lens()
    value = lens.thicknesses["1"]
    heights = trace_rays(lens.system(), rays).position[:, 1]
    batch = torch.eye(3, dtype=torch.float64)
    (found,) = torch.autograd.grad(heights, value, batch, is_grads_batched=True, retain_graph=True)
    known = [torch.autograd.grad(height, value, retain_graph=True)[0] for height in heights]
    close(found, torch.stack(known), 1e-13)


def test_a_second_derivative_says_that_the_kernel_has_none(monkeypatch):
    monkeypatch.setattr(bent_rays, "_FEW", 1)
    position = beam((0.0, 0.3)).position.requires_grad_()
    rays = Rays(position, beam((0.0, 0.3)).direction, 550.0)
    hit = trace_rays(lens_of(ROD, 4.0).system(), rays)
    (slope,) = torch.autograd.grad(hit.position[:, 1].sum(), position, create_graph=True)
    with pytest.raises(RuntimeError, match="once_differentiable"):
        slope.sum().backward()


def test_first_order_optics_of_a_parabolic_rod():
    length = 0.15 * PITCH
    lens = lens_of(ROD, length)
    first, g = lens.first_order(550.0), math.sqrt(A)
    assert float(first.efl) == pytest.approx(1.0 / (N0 * g * math.sin(g * length)), rel=1e-13)
    assert float(first.bfd) == pytest.approx(1.0 / (N0 * g * math.tan(g * length)), rel=1e-13)
    diverging = lens_of(ROD.replace("r2=-", "r2="), length).first_order(550.0)
    assert float(diverging.efl) == pytest.approx(-1.0 / (N0 * g * math.sinh(g * length)), rel=1e-13)
    numbers = ParaxialNumbers.of(lens.system())
    assert numbers.exit_pupil(550.0)[0] == pytest.approx(float(first.exit_pupil.z), rel=1e-13)


def test_paraxial_rays_bend_between_the_faces_of_a_rod():
    length, g = 0.15 * PITCH, math.sqrt(A)
    lens = lens_of(ROD, length, {"semi_diameter": 1.0}, stop=1)
    marginal = lens.paraxial_rays(0.0, 550.0).marginal
    assert marginal.height.tolist() == pytest.approx([1.0, math.cos(g * length)], rel=1e-13)
    arriving = -g * math.sin(g * length)
    assert marginal.slope_before.tolist() == pytest.approx([0.0, arriving], rel=1e-13)
    assert marginal.slope_after.tolist() == pytest.approx([0.0, N0 * arriving], rel=1e-13)


def test_automatic_apertures_take_the_light_that_a_rod_spreads():
    # Light of 5° fills the rod's end: |y| + |ȳ| of the marginal and the chief ray, nearly.
    length, g = 0.2 * PITCH, math.sqrt(A)
    fields = {"angles": [[0.0, 0.0], [0.0, 5.0]]}
    lens = lens_of(
        ROD, length, {"semi_diameter": 0.3}, {"semi_diameter": "auto"}, stop=1, fields=fields
    )
    known = 0.3 * math.cos(g * length) + math.tan(math.radians(5.0)) * math.sin(g * length) / (
        g * N0
    )
    assert lens.surfaces["2"].semi_diameter == pytest.approx(known, rel=0.02)


def test_the_eye_of_liou_and_brennan_has_its_published_power_and_length():
    # J. Opt. Soc. Am. A 14, 1684 (1997): 60.35 D, and in focus at 23.95 mm, at 555 nm.
    rows = {
        "1": {"radius": 7.77, "conic": -0.18, "thickness": 0.5, "material": "1.376"},
        "2": {"radius": 6.40, "conic": -0.60, "thickness": 3.16, "material": "1.336"},
        "3": {
            **{"radius": 12.40, "conic": -0.94, "thickness": 1.59},
            "material": "gradient 1.368 r2=-0.001978 z=0.049057 z2=-0.015427",
        },
        "4": {
            "radius": math.inf,
            "thickness": 2.43,
            "material": "gradient 1.407 r2=-0.001978 z2=-0.006605",
        },
        "5": {"radius": -8.10, "conic": 0.96, "material": "1.336"},
    }
    rows = {n: {"type": "conic", "semi_diameter": 4.0, **row} for n, row in rows.items()}
    eye = lens_from_prescription({"stop": 3, "surfaces": rows, "sensor": {"distance": 16.27}})
    first = eye.first_order(555.0)
    assert 1e3 * float(first.power) == pytest.approx(60.35, abs=0.01)
    assert float(first.image) == pytest.approx(23.95, abs=2e-5)


@pytest.mark.parametrize("kind", ["gradient", "gradient_squared"])
def test_first_order_optics_is_the_limit_of_real_rays(kind):
    medium = f"{kind} 1.7 r2=-0.012 r4=3e-4 z=0.02 z2=-0.003 x2=0.004 y2=-0.004"
    lens = lens_of(medium, 4.0, FRONT, BACK)
    height = 1e-4
    hit = lens.trace(beam((0.0, height), (height, 0.0)))
    for axis, meridian in ((1, "y"), (0, "x")):
        ray = hit.direction[1 - axis].detach()
        power = -float(ray[axis] / ray[2]) / height
        section = first_order(lens.system().section(meridian), 550.0)
        assert float(section.power) == pytest.approx(power, rel=1e-8)


@pytest.mark.parametrize("name", ["thicknesses.1", "surfaces.1.gradient.r2"])
@pytest.mark.parametrize(
    "medium", ["gradient 1.7 r2=-0.012 z=0.02", "gradient 1.7 r2=0 z=0.02", "gradient 1.7 r2=0"]
)
def test_first_order_optics_has_the_derivative_of_its_number(medium, name):
    lens = lens_of(medium, 4.0, FRONT, BACK)
    value = dict(lens.named_parameters())[name].detach().clone()

    def power(value):
        return lens.with_values({name: value}).first_order(550.0).power

    found = torch.autograd.functional.jacobian(power, value)
    known = (power(value + 1e-4) - power(value - 1e-4)) / 2e-4
    assert float(found) == pytest.approx(float(known.detach()), rel=1e-7)


def test_a_medium_is_written_and_read_again():
    lens = lens_of("gradient SCHOTT:N-BK7 r2=-1e-3 z=.5e-2", 4.0)
    row = prescription_of(lens)["surfaces"]["1"]
    assert row["material"] == "gradient SCHOTT:N-BK7 r2=-0.001 z=0.005"
    medium = parse_material(row["material"], index_model("dfc"))
    assert medium == lens.materials[1] and isinstance(medium, Gradient)
    assert medium.index(550.0) == parse_material("N-BK7", index_model("dfc")).index(550.0)
    assert bool(lens.first_order(400.0).efl != lens.first_order(700.0).efl)
    coloured = lens_of(selfoc_medium(), 4.0).materials[1]
    assert parse_material(coloured.name, index_model("dfc")) == coloured


@pytest.mark.parametrize(
    ("material", "message"),
    [
        ("gradient 1.6", "write a medium and terms"),
        ("gradient r2=1", "write a medium and terms"),
        ("gradient 1.6 r3=1", "there is no term 'r3'.*allowed: r2, r4"),
        ("gradient 1.6 r2=1 r2=2", "'r2' is there twice"),
        ("gradient 1.6 r2=inf", "r2 must be a number, not 'inf'"),
        ("gradient 1.6 r2=1e-3/w13", "r2 must be a number, not '1e-3/w13', or a series such as"),
        ("gradient 1.6 z21=1", "there is no term 'z21'.*x, x2 to x20, and of y and z"),
        ("gradient mirror r2=1", "'mirror' is no medium with one index"),
        ("gradient N-BK8 r2=1", "unknown material 'N-BK8'"),
    ],
)
def test_a_medium_that_cannot_be_meant_is_refused(material, message):
    with pytest.raises(InputError, match=message) as caught:
        lens_of(material, 4.0)
    assert "surface 1" in str(caught.value) and "\n" not in str(caught.value)


# SLW-1.8 of NSG, λ in µm: n0 = B + C/λ² and √A = K0 + K1/λ² + K2/λ⁴ of n = n0·(1 - A·r²/2).
SELFOC = (1.5868, 8.14e-3), (0.3238, 5.364e-3, 2.626e-4)


def selfoc(wavelength):
    """n0 and √A (1/mm) of SLW-1.8 at a wavelength in nm."""
    (b, c), (k0, k1, k2) = SELFOC
    u = (1e-3 * wavelength) ** -2
    return b + c * u, k0 + k1 * u + k2 * u * u


def selfoc_medium():
    """The same as a prescription writes it: r2 is a polynomial of degree five in 1/λ²."""
    (b, c), k = SELFOC
    u = np.polynomial.Polynomial([0.0, 1.0])
    root = k[0] + k[1] * u + k[2] * u * u
    constant, *others = (-0.5 * (b + c * u) * root * root).coef.tolist()
    r2 = f"{constant!r}" + "".join(f"{a:+.17g}/w{2 * n}" for n, a in enumerate(others, 1))
    return f"gradient {b}+{c}/w2 r2={r2}"


def test_a_rod_of_selfoc_has_its_focal_length_at_every_wavelength():
    lens = lens_of(selfoc_medium(), 4.0)
    for wavelength in (480.0, 632.8, 1300.0):
        n0, g = selfoc(wavelength)
        first = lens.first_order(wavelength)
        assert float(first.efl) == pytest.approx(1.0 / (n0 * g * math.sin(4.0 * g)), rel=1e-12)
        numbers = ParaxialNumbers.of(lens.system())
        assert numbers.exit_pupil(wavelength)[0] == pytest.approx(float(first.exit_pupil.z))
    # Zemax's prescription data of a file with GRINSUR9 and SLW-1.8 print these indices.
    for wavelength, printed in ((1455.0, 1.59064502), (1420.0, 1.59083690), (1495.0, 1.59044202)):
        assert float(lens.materials[1].index(wavelength)) == pytest.approx(printed, abs=1e-8)


def test_rays_of_several_colours_take_the_kernel_and_what_each_alone_takes(monkeypatch):
    lens = lens_of(selfoc_medium(), 4.0, FRONT, BACK)
    points, slopes = RAYS["points"] * 4, RAYS["slopes"] * 4
    waves = torch.tensor([480.0, 632.8, 1300.0, 632.8], dtype=torch.float64).repeat_interleave(3)
    rays = beam(*(tuple(0.3 * p for p in point) for point in points), slopes=slopes)
    rays = Rays(rays.position, rays.direction, waves)
    found = []
    for few in (1, 1000):
        monkeypatch.setattr(bent_rays, "_FEW", few)
        hit = trace_rays(lens.system(), rays)
        outputs = torch.cat([hit.position, hit.direction, hit.path_length[:, None]], 1)
        weights = torch.linspace(-1.0, 1.0, outputs.numel(), dtype=torch.float64)
        grads = torch.autograd.grad(
            outputs.reshape(-1) @ weights, list(lens.parameters()), allow_unused=True
        )
        found.append([outputs.detach(), *(g for g in grads if g is not None)])
    for kernel, eager in zip(*found, strict=True):
        close(kernel, eager, 3e-12 * max(1.0, float(eager.abs().max())))
    for k in (0, 3, 6, 9):
        alone = Rays(rays.position[k : k + 3], rays.direction[k : k + 3], float(waves[k]))
        close(found[0][0][k : k + 3, :3], lens.trace(alone).position.detach(), 3e-13)
    monkeypatch.setattr(bent_rays, "_FEW", 1)
    name = "surfaces.1.gradient.r2"
    forward = ray_jacobian(lens, rays, [name], ("x",)).derivatives[:, 0, 0]
    value, step = lens.surfaces["1"].gradient.r2.detach(), 1e-6
    high, low = (lens.with_values({name: value + s}).trace(rays) for s in (step, -step))
    close(forward, ((high.position - low.position)[:, 0] / (2.0 * step)).detach(), 2e-8)


def test_derivatives_with_respect_to_wavelengths_hold_where_a_profile_changes_with_them():
    lens = lens_of(selfoc_medium(), 4.0, FRONT, BACK)
    start = beam((0.1, 0.3))

    def height(wavelength):
        rays = Rays(start.position, start.direction, wavelength)
        return trace_rays(lens.system(), rays).position[0, 1]

    at = torch.tensor([600.0], dtype=torch.float64, requires_grad=True)
    (found,) = torch.autograd.grad(height(at), at)
    known = (height(at.detach() + 0.1) - height(at.detach() - 0.1)) / 0.2
    close(found[0], known.detach(), 1e-10)


@pytest.mark.parametrize("axis", ["x", "y", "z"])
def test_terms_of_high_power_bend_rays_as_their_derivatives_say(axis):
    # ½∇n² of n = 1.6 + Σ c_k·u^k, by differences.
    values = {f"{axis}{k}": 1e-3 * (-0.7) ** k for k in (3, 5, 20)}
    words = " ".join(f"{term}={value!r}" for term, value in values.items())
    profile = parse_material(f"gradient 1.6 {words}", index_model("dfc")).profile()
    assert not profile.has_kernel
    point, step = {"x": 0.9, "y": -0.8, "z": 1.1}, 1e-6

    def square(**moved):
        u = {**point, **moved}[axis]
        return (1.6 + sum(c * u ** int(term[1:]) for term, c in values.items())) ** 2

    bend = profile.bend(1.6, **point)
    assert bend.squared == pytest.approx(square(), rel=1e-14)
    for name in "xyz":
        ends = (square(**{name: point[name] + s}) for s in (step, -step))
        known = 0.5 * (next(ends) - next(ends)) / (2.0 * step)
        assert getattr(bend, name) == pytest.approx(known, abs=1e-9)


def test_a_profile_beyond_all_numbers_loses_rays_and_an_index_below_zero_is_refused(monkeypatch):
    monkeypatch.setattr("dolens.optics.bent_motion._MOST_STEPS", 64)
    lens = lens_of("gradient 1.5 r12=1e300", 0.01)
    hit = lens.trace(beam((0.0, 1.0), (0.0, 0.0)))
    assert hit.valid.tolist() == [False, True] and bool(hit.position.isfinite().all())
    with pytest.raises(InputError, match="its index is not positive on the axis at"):
        lens_of("gradient 1.5 z=-1", 4.0).first_order(550.0)


def test_what_does_not_hold_in_a_gradient_is_refused_by_name(tmp_path):
    lens = thick_lens(distance=10.0)
    views = {
        "Seidel sums": lambda: lens.seidel(5.0),
        "ghosts": lambda: lens.ghosts(),
        "polarised rays": lambda: lens.trace_polarised(beam((0.0, 0.1))),
        "another temperature": lambda: lens.at(40.0),
    }
    for what, view in views.items():
        with pytest.raises(InputError, match=f"{what}.*behind surface 1 has a gradient"):
            view()
    with pytest.raises(InputError, match="backend 'cpu': the medium behind surface 1"):
        choose_backend(lens.system().traced_by("cpu"))
    with pytest.raises(InputError, match="behind the last surface cannot be a gradient"):
        lens_of("1.5", 4.0, second={"material": MEDIUM})
    for suffix in (".zmx", ".seq", ".txt"):
        with pytest.raises(InputError, match="gradient"):
            dolens.save_lens(lens, tmp_path / f"lens{suffix}")


def test_many_lenses_are_traced_as_each_alone():
    lens, rays = thick_lens(distance=6.0), beam(*RAYS["points"], slopes=RAYS["slopes"])
    names = ["surfaces.1.curvature", "thicknesses.1"]
    values = torch.tensor([[1.0 / 12.0, 4.0], [1.0 / 13.0, 4.2]], dtype=torch.float64)
    found, _ = trace_lenses(lens, names, values, rays)
    for row, y in zip(values, found.y, strict=True):
        alone = lens.with_values(dict(zip(names, row, strict=True))).trace(rays)
        close(y, alone.position[:, 1].detach(), 1e-13)
