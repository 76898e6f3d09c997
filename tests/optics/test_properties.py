"""Properties of light that hold for every lens and every ray (hypothesis)."""

import math

import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from dolens import Rays, Status
from dolens.optics.rays import Components
from dolens.optics.surfaces.refraction import PlaneRay
from dolens.optics.trace import trace_surfaces
from dolens.prescriptions import lens_from_prescription

pytestmark = pytest.mark.usefixtures("backend")

LENSES, RAYS = 75, 64
EPSILON = torch.finfo(torch.float64).eps
CHECKED = settings(
    max_examples=LENSES, deadline=None, suppress_health_check=list(HealthCheck), derandomize=True
)


def reals(low, high):
    return st.floats(low, high, allow_nan=False, allow_infinity=False)


@st.composite
def surfaces(draw):
    """A row of a prescription of any kind, of 1 to 20 mm semi-diameter."""
    kind = draw(
        st.sampled_from(
            ["plane", "aperture", "sphere", "conic", "even_asphere", "xy_polynomial", "b_spline"]
        )
    )
    r = draw(reals(1.0, 20.0))
    row = {"type": kind, "semi_diameter": r}
    # In units of the aperture: up to a hemisphere, and sags up to its size.
    if kind in ("sphere", "conic", "even_asphere"):
        conic = 0.0 if kind == "sphere" else draw(reals(-6.0, 2.0))
        steepest = 0.999 / math.sqrt(max(1.0 + conic, 1.0))
        row["curvature"] = draw(reals(-steepest, steepest)) / r
        if kind != "sphere":
            row["conic"] = conic
    if kind == "even_asphere":
        for power in (4, 6, 8):
            row[f"a{power}"] = draw(reals(-0.1, 0.1)) / r ** (power - 1)
    if kind == "xy_polynomial":
        for name, power in (("x2", 2), ("xy", 2), ("y2", 2), ("x3", 3), ("x2y", 3), ("y4", 4)):
            row[name] = draw(reals(-0.1, 0.1)) / r ** (power - 1)
        row["b"] = draw(reals(-0.3, 0.3)) / r
    if kind == "b_spline":
        seed = draw(st.integers(0, 2**31))
        heights = torch.rand((6, 6), generator=torch.Generator().manual_seed(seed)) - 0.5
        row["coefficients"] = (heights * 0.2 * r).tolist()
        row["half_width"] = 1.01 * r
    return row


@st.composite
def lenses(draw):
    """A lens of one to four surfaces, with glass at random and perhaps a tilted element."""
    rows = draw(st.lists(surfaces(), min_size=1, max_size=4))
    materials = ["air", "1.5168/64.17", "1.85/25"]
    for row in rows:
        row["material"] = draw(st.sampled_from(materials))
        if row is not rows[-1]:
            row["thickness"] = draw(reals(0.0, 30.0))
    prescription = {
        "object_material": draw(st.sampled_from(materials)),
        "surfaces": {str(i): row for i, row in enumerate(rows, 1)},
        "sensor": {"distance": draw(reals(1.0, 100.0))},
    }
    if draw(st.booleans()):
        last = draw(st.integers(1, len(rows)))
        pose = {name: draw(reals(-20.0, 20.0)) for name in ("tilt_x", "tilt_y")}
        pose |= {name: draw(reals(-1.0, 1.0)) for name in ("decenter_x", "shift_z")}
        prescription["elements"] = {"1": {"surfaces": [1, last], **pose}}
    return lens_from_prescription(prescription)


@st.composite
def bundles(draw):
    """Rays from anywhere near or far, in any direction, backwards and sideways included."""
    seed, distance = draw(st.integers(0, 2**31)), draw(st.sampled_from([0.0, 1.0, 50.0, 1e4, 1e7]))
    spread = draw(st.sampled_from([0.01, 0.3, 1.0, 3.0]))
    generator = torch.Generator().manual_seed(seed)
    target = (torch.rand((RAYS, 3), generator=generator, dtype=torch.float64) - 0.5) * 20.0 * spread
    direction = torch.randn((RAYS, 3), generator=generator, dtype=torch.float64)
    direction[: RAYS // 2, 2] = 1.0 / spread
    direction = direction / direction.norm(dim=-1, keepdim=True)
    # A few exactly along the axes, where a component of the direction vanishes.
    direction[-3:] = torch.eye(3, dtype=torch.float64)
    return Rays(target - distance * direction, direction, draw(reals(400.0, 800.0)))


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32], ids=["f64", "f32"])
@CHECKED
@given(lenses(), bundles())
def test_nothing_is_nan_whatever_the_lens_and_the_rays(dtype, lens, rays):
    lens = lens.to(dtype)
    position = rays.position.to(dtype).requires_grad_()
    direction = rays.direction.to(dtype).requires_grad_()
    for trace in (lens.trace, lens.sensor_to_scene):
        hit = trace(Rays(position, direction, rays.wavelength), record=True)
        outputs = [hit.position, hit.direction, hit.path_length, hit.points]
        for output in outputs:
            assert output.isfinite().all()
        total = sum(output.square().sum() for output in outputs)
        inputs = [*lens.parameters(), position, direction]
        for gradient in torch.autograd.grad(total, inputs, allow_unused=True):
            assert gradient is None or gradient.isfinite().all()
        assert torch.equal(hit.valid, hit.status == Status.OK)
        assert torch.equal(hit.valid, hit.surface == 0)


@CHECKED
@given(lenses(), bundles())
def test_an_invalid_ray_passes_no_gradient(lens, rays):
    position = rays.position.clone().requires_grad_()
    hit = lens.trace(Rays(position, rays.direction, rays.wavelength))
    total = hit.position.sum() + hit.direction.sum() + hit.path_length.sum()
    (gradient,) = torch.autograd.grad(total, [position])
    assert (gradient[~hit.valid] == 0.0).all()


@CHECKED
@given(lenses(), bundles())
def test_directions_stay_unit_vectors(lens, rays):
    hit = lens.trace(rays)
    length = hit.direction[hit.valid].norm(dim=-1)
    assert ((length - 1.0).abs() < 64 * EPSILON).all()


@CHECKED
@given(lenses(), bundles())
def test_light_returns_the_way_it_came(lens, rays):
    """From the sensor back to the first surface, where rays are not near an aperture's rim."""
    hit = lens.trace(rays, record=True)
    back = lens.sensor_to_scene(Rays(hit.position, -hit.direction, rays.wavelength), record=True)
    # Total reflection and rims can fall either way within rounding; all else must return.
    returned = hit.valid & back.valid
    assert int((hit.valid & ~back.valid).sum()) <= 1
    scale = hit.points.abs().amax(dim=(0, 2)) + hit.position.abs().amax(-1) + 1.0
    # Near-tangent rays amplify rounding without bound: hold those that do not.
    steep = _smallest_cosine(lens, rays)
    held = returned & (steep > 0.05)
    error = (back.points.flip(0) - hit.points).abs().amax(dim=(0, 2))
    assert (error[held] < 1e-9 * scale[held]).all()


@CHECKED
@given(surfaces(), bundles(), st.sampled_from([1.0, -1.0]))
def test_intersections_lie_on_the_surface_and_normals_are_its_own(row, rays, sense):
    """sag(x, y) = z; the normal is that of finite differences of the sag; Snell's law holds."""
    surface = next(
        iter(
            lens_from_prescription(
                {"surfaces": {"1": row | {"material": "1.5168/64.17"}}, "sensor": {"distance": 1.0}}
            ).surfaces.values()
        )
    )
    p = {n: v.detach() for n, v in (*surface.named_parameters(), *surface.named_buffers())}
    r = surface.semi_diameter
    direction = rays.direction * torch.where(rays.direction[:, 2:] < 0.0, -sense, sense)
    l, m, n = direction.unbind(-1)  # noqa: E741
    u, v = (rays.position[:, 0] % 1.0) * 2 - 1, (rays.position[:, 1] % 1.0) * 2 - 1
    ray = PlaneRay(u * r, v * r, l, m, n)
    t, met = surface.intersect(p, ray, sense, r)
    x, y, z = ray.x + t * l, ray.y + t * m, t * n
    good = (x * x + y * y < 0.9 * r * r) & (n.abs() > 0.05)
    if met is not None:
        good = good & (met > 0.0)
    sag = surface.sag_and_gradient(p, x, y)[0]
    assert ((sag - z).abs()[good] < 64 * EPSILON * (t.abs() + r)[good]).all()
    nx, ny, nz = surface.normal(p, x, y, z)
    assert ((nx * nx + ny * ny + nz * nz - 1.0).abs()[good] < 16 * EPSILON).all()
    h = 1e-5 * r
    for component, (dx, dy) in ((nx, (h, 0.0)), (ny, (0.0, h))):
        ends = [surface.sag_and_gradient(p, x + k * dx, y + k * dy)[0] for k in (-2, -1, 1, 2)]
        slope = (ends[0] - 8 * ends[1] + 8 * ends[2] - ends[3]) / (12 * h)
        assert ((slope + component / nz).abs()[good] < 1e-8 * (1.0 + slope.abs())[good]).all()
    ratio = 1.0 / 1.5168
    bent = surface.refract(p, (x, y, z), (l, m, n), ratio, sense)
    good = good & (bent.transmitted > 0.0)
    normal, before = torch.stack((nx, ny, nz), -1), torch.stack((l, m, n), -1)
    after = torch.stack(bent[:3], -1)
    # n sin i = n' sin i', in one plane: the tangential parts are parallel.
    left, right = ratio * torch.linalg.cross(before, normal), torch.linalg.cross(after, normal)
    assert ((left - right).abs().amax(-1)[good] < 32 * EPSILON).all()
    assert ((after * normal).sum(-1)[good] * sense > 0.0).all()


def _smallest_cosine(lens, rays):
    """|cos i| at the most grazing refraction of every ray, from recorded points."""
    smallest = torch.ones(rays.position.shape[0], dtype=torch.float64)
    ray = Components(*rays.position.unbind(-1), *rays.direction.unbind(-1))
    system = lens.system()
    for number in range(1, len(lens.surfaces) + 1):
        before = ray
        ray = trace_surfaces(system, ray, rays.wavelength, first=number, last=number).ray
        step = torch.stack(ray[3:], -1) - torch.stack(before[3:], -1)
        smallest = torch.minimum(smallest, _cosine_to_surface(system, number, before, ray))
        assert step.isfinite().all()
    return smallest.detach()


def _cosine_to_surface(system, number, before, after):
    axes = system.axes[number - 1]
    position = torch.stack(after[:3], -1)
    direction = torch.stack(before[3:], -1)
    bent = torch.stack(after[3:], -1)
    if axes.rotation is not None:
        position = (position - axes.origin) @ axes.rotation
        direction, bent = direction @ axes.rotation, bent @ axes.rotation
    else:
        position = position - torch.tensor([0.0, 0.0, 1.0]).to(position) * axes.z
    surface = system.surfaces[number - 1]
    normal = torch.stack(surface.shape.normal(surface.parameters, *position.unbind(-1)), -1)
    return torch.minimum((direction * normal).sum(-1).abs(), (bent * normal).sum(-1).abs())
