"""Gradients against central differences in float64 and against the reference's exact ones."""

import math

import pytest
import torch

from dolens import Rays, Status, load_lens

pytestmark = pytest.mark.usefixtures("backend")


def weighted(hit, valid=None):
    """One number that every output of a trace goes into."""
    count = hit.path_length.shape[-1]
    weights = torch.linspace(0.7, 1.9, 7 * count, dtype=hit.position.dtype).reshape(count, 7)
    values = torch.cat(
        (hit.position[..., :2], hit.direction, hit.path_length[..., None] * 0.01), dim=-1
    )
    total = values * weights[:, :6]
    return (total if valid is None else total[valid]).sum()


def finite_difference(function, parameter, step):
    """Fourth-order central difference in one element."""
    with torch.no_grad():
        kept = parameter.clone()
        ends = []
        for k in (-2, -1, 1, 2):
            parameter.copy_(kept + k * step)
            ends.append(float(function()))
        parameter.copy_(kept)
    return (ends[0] - 8 * ends[1] + 8 * ends[2] - ends[3]) / (12 * step)


def step_for(name, lens):
    """A step that moves the surface's edge by about a micrometre."""
    if name.startswith("thicknesses") or name == "sensor_distance":
        return 1e-3
    _, number, key = name.split(".")
    r = lens.surfaces[number].semi_diameter
    if key == "curvature":
        return 1e-3 / r**2
    if key == "conic":
        c = abs(float(lens.surfaces[number].curvature.detach()))
        return 1e-2 / (c**3 * r**4)
    if key == "b":
        return 1e-3
    power = int(key[1:]) if key[0] == "a" else sum(_powers(key))
    return 1e-3 / r**power


def _powers(name):
    from dolens.optics.surfaces.xy_polynomial import monomial_powers

    return monomial_powers(name)


def has_flat_back(lens):
    last = list(lens.surfaces.values())[-1]
    return all(float(p.detach()) == 0.0 for p in last.parameters())


QUANTITIES = {
    "sensor_x": lambda hit: hit.position[..., 0],
    "sensor_y": lambda hit: hit.position[..., 1],
    "path_length": lambda hit: hit.path_length,
    "direction_x": lambda hit: hit.direction[..., 0],
}


@pytest.mark.parametrize("quantity", QUANTITIES)
def test_gradient_of_every_parameter(bent_lens, bundle, quantity):
    rays = bundle(bent_lens)
    assert bent_lens.trace(rays).valid.all()
    weights = torch.linspace(0.7, 1.9, rays.direction.shape[0], dtype=torch.float64)

    def function():
        return (weights * QUANTITIES[quantity](bent_lens.trace(rays))).sum()

    parameters = dict(bent_lens.named_parameters())
    gradients = torch.autograd.grad(function(), parameters.values(), allow_unused=True)
    value = abs(float(function().detach()))
    for (name, parameter), gradient in zip(parameters.items(), gradients, strict=True):
        step = step_for(name, bent_lens)
        expected = finite_difference(function, parameter, step)
        found = 0.0 if gradient is None else float(gradient)
        # What rounding of the function leaves in the difference quotient.
        rounding = 50 * 2.2e-16 * max(value, 1.0) / step
        assert found == pytest.approx(expected, rel=1e-6, abs=rounding), name
        # Gaps before nothing but planes move light and do not turn it.
        gaps = {"sensor_distance"}
        if has_flat_back(bent_lens):
            gaps.add(f"thicknesses.{len(bent_lens.surfaces) - 1}")
        must_vanish = quantity == "direction_x" and name in gaps
        assert (found == 0.0) == must_vanish, name


@pytest.mark.parametrize("quantity", QUANTITIES)
def test_gradient_of_ray_origins_and_directions(bent_lens, bundle, quantity):
    rays = bundle(bent_lens)
    position = rays.position.clone().requires_grad_()
    direction = rays.direction.clone().requires_grad_()
    weights = torch.linspace(0.7, 1.9, len(position), dtype=torch.float64)

    def function(position=position, direction=direction):
        hit = bent_lens.trace(Rays(position, direction, rays.wavelength))
        return (weights * QUANTITIES[quantity](hit)).sum()

    found = torch.autograd.grad(function(), (position, direction))
    generator = torch.Generator().manual_seed(1)
    # A direction is a unit vector, so only tangent motions have a meaning.
    tangent = torch.randn(direction.shape, generator=generator, dtype=torch.float64)
    d = direction.detach()
    tangent = tangent - (tangent * d).sum(-1, keepdim=True) * d
    shift = torch.randn(position.shape, generator=generator, dtype=torch.float64)
    with torch.no_grad():

        def turned(h):
            along = d + h * tangent
            return function(position, along / along.norm(dim=-1, keepdim=True))

        for gradient, motion, moved, h in (
            (found[0], shift, lambda h: function(position + h * shift, direction), 1e-2),
            (found[1], tangent, turned, 1e-4),
        ):
            ends = [float(moved(k * h)) for k in (-2, -1, 1, 2)]
            expected = (ends[0] - 8 * ends[1] + 8 * ends[2] - ends[3]) / (12 * h)
            exact = float((gradient * motion).sum())
            assert exact == pytest.approx(expected, rel=1e-6)


def test_backward_traces_have_gradients_too(bent_lens, bundle):
    with torch.no_grad():
        forward = bent_lens.trace(bundle(bent_lens))
        rays = Rays(forward.position, -forward.direction, 550.0)

    def function():
        hit = bent_lens.sensor_to_scene(rays)
        assert hit.valid.all()
        return weighted(hit)

    parameters = {n: p for n, p in bent_lens.named_parameters() if n != "sensor_distance"}
    gradients = torch.autograd.grad(function(), parameters.values())
    for (name, parameter), gradient in zip(parameters.items(), gradients, strict=True):
        step = step_for(name, bent_lens)
        expected = finite_difference(function, parameter, step)
        assert float(gradient) == pytest.approx(expected, rel=1e-6, abs=1e-13 / step), name


# --- the reference's RMS spot radii and exact derivatives ---------------------------------------


def grid_spot(lens, entry, count=31):
    """RMS radius (mm) on the grid of tests/reference/README.md, and which rays are valid."""
    axis = torch.arange(count, dtype=torch.float64)
    half = float(entry["R"])
    axis = -half + 2 * half * axis / (count - 1)
    x, y = torch.meshgrid(axis, axis, indexing="ij")
    view = math.radians(float(entry["view_deg"]))
    position = torch.stack((x, y, torch.zeros_like(x)), -1).reshape(-1, 3)
    direction = torch.tensor([math.sin(view), 0.0, math.cos(view)], dtype=torch.float64)
    hit = lens.trace(Rays(position, direction.expand_as(position), float(entry["wavelength"])))
    points = hit.position[hit.valid][:, :2]
    centroid = points.mean(dim=0)
    return ((points - centroid) ** 2).sum(-1).mean().sqrt(), hit.valid, centroid


def test_rms_spot_radii_and_their_derivatives(reference, root):
    data = reference("rms_triplet__dfc__deriv.json")
    lens = load_lens(root / "conf" / "lens" / "cooke_triplet.yaml", torch.float64, "dfc")
    curvatures = lens.variables(["surfaces.*.curvature"])
    radii, total = [], 0.0
    assert len(data["entries"]) == 9
    for entry in data["entries"]:
        rms, valid, centroid = grid_spot(lens, entry)
        assert "".join("01"[int(v)] for v in valid) == entry["mask"]
        assert int(valid.sum()) == entry["n_valid"]
        assert float(rms.detach()) == pytest.approx(float(entry["rms"]), rel=1e-11)
        for found, expected in zip(centroid.detach(), entry["centroid"], strict=True):
            assert float(found) == pytest.approx(float(expected), abs=1e-12)
        gradients = torch.autograd.grad(rms, curvatures.values())
        for name, gradient in zip(curvatures, gradients, strict=True):
            exact = float(entry["d_rms_d"][f"s{name.split('.')[1]}.c"])
            assert float(gradient) == pytest.approx(exact, rel=1e-10), name
        radii.append(float(rms.detach()))
        total += radii[-1] ** 2
    assert sum(radii) / len(radii) == pytest.approx(float(data["mean_rms"]), rel=1e-11)
    assert total == pytest.approx(float(data["sum_rms2"]), rel=1e-11)
    # The file without derivatives states the same spots.
    plain = reference("rms_triplet__dfc.json")
    for entry, rms in zip(plain["entries"], radii, strict=True):
        assert rms == pytest.approx(float(entry["rms"]), rel=1e-11)


def test_the_half_width_of_the_grid(reference, root):
    """R = tan(field)·sag(r₁) + r₁: the grid's half-width follows from the lens itself."""
    lens = load_lens(root / "conf" / "lens" / "cooke_triplet.yaml")
    first = lens.surfaces["1"]
    edge = torch.tensor(first.semi_diameter, dtype=torch.float64)
    sag = first.sag_and_gradient(dict(first.named_parameters()), edge, torch.zeros_like(edge))[0]
    for entry in reference("rms_triplet__dfc.json")["entries"]:
        half = math.tan(math.radians(float(entry["view_deg"]))) * float(sag.detach()) + 9.5
        assert half == pytest.approx(float(entry["R"]), rel=1e-14)


# --- lost rays, no rays, far rays ----------------------------------------------------------------


def reference_rays(reference, statuses):
    data = reference("rays/rays_triplet__dfc.json")["rays"]
    kept = [r for r in data if r["status"] in statuses]
    return kept, Rays(
        torch.tensor([[float(v) for v in r["o"]] for r in kept], dtype=torch.float64),
        torch.tensor([[float(v) for v in r["d"]] for r in kept], dtype=torch.float64),
        torch.tensor([float(r["wavelength"]) for r in kept], dtype=torch.float64),
    )


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32], ids=["f64", "f32"])
@pytest.mark.parametrize("record", [False, True])
def test_lost_rays_leave_no_trace_in_gradients(reference, root, dtype, record):
    lens = load_lens(root / "conf" / "lens" / "cooke_triplet.yaml", dtype)
    kept, everything = reference_rays(reference, {"ok", "vignetted", "tir", "miss"})
    ok = torch.tensor([r["status"] == "ok" for r in kept])

    def gradients(rays):
        position = rays.position.to(dtype).requires_grad_()
        hit = lens.trace(Rays(position, rays.direction.to(dtype), rays.wavelength), record)
        for values in (hit.position, hit.direction, hit.path_length):
            assert torch.isfinite(values).all()
        points = hit.points.sum() if record else 0.0
        total = hit.position.sum() + 3 * hit.direction.sum() + 0.1 * hit.path_length.sum() + points
        found = torch.autograd.grad(total, [*lens.parameters(), position])
        return hit, found[:-1], found[-1]

    hit, whole, origins = gradients(everything)
    assert {int(s) for s in hit.status} == {int(s) for s in Status}
    _, alone, origins_alone = gradients(
        Rays(everything.position[ok], everything.direction[ok], everything.wavelength[ok])
    )
    epsilon = torch.finfo(dtype).eps
    for a, b in zip(whole, alone, strict=True):
        assert torch.isfinite(a)
        # The sums have other lengths: they agree to the rounding of their order.
        assert abs(float(a - b)) <= 1e3 * epsilon * max(abs(float(b)), 1.0)
    assert torch.equal(origins[ok], origins_alone)
    assert (origins[~ok] == 0).all()


@pytest.mark.parametrize("kind", ["grazing", "backwards", "sideways", "huge", "nan_free_centre"])
def test_absurd_rays_stay_finite(root, bent_lens, kind):
    position, direction = {
        "grazing": ((0.0, 0.0, -1.0), (1.0, 0.0, 0.0)),
        "backwards": ((0.0, 0.0, -5.0), (0.0, 0.0, -1.0)),
        "sideways": ((0.0, 1e3, -1.0), (0.0, -1.0, 0.0)),
        "huge": ((1e9, -1e9, -1e9), (0.0, 0.0, 1.0)),
        "nan_free_centre": ((0.0, 0.0, 0.0), (0.0, 0.0, 1.0)),
    }[kind]
    position = torch.tensor([position], dtype=torch.float64, requires_grad=True)
    direction = torch.tensor([direction], dtype=torch.float64)
    hit = bent_lens.trace(Rays(position, direction), record=True)
    assert bool(hit.valid) == (kind == "nan_free_centre")
    outputs = (hit.position, hit.direction, hit.path_length, hit.points)
    assert all(torch.isfinite(values).all() for values in outputs)
    total = sum(values.sum() for values in outputs)
    for gradient in torch.autograd.grad(total, [position, *bent_lens.parameters()]):
        assert torch.isfinite(gradient).all()


def test_no_rays_at_all(bent_lens):
    position = torch.zeros((0, 3), dtype=torch.float64)
    direction = torch.zeros((0, 3), dtype=torch.float64)
    for trace in (bent_lens.trace, bent_lens.sensor_to_scene):
        hit = trace(Rays(position, direction), record=True)
        assert hit.position.shape == (0, 3)
        assert hit.valid.shape == hit.status.shape == hit.path_length.shape == (0,)
        assert hit.points.shape == (len(bent_lens.surfaces), 0, 3)
        hit.position.sum().backward()
        assert all((p.grad is None or torch.isfinite(p.grad)) for p in bent_lens.parameters())


def test_a_source_at_a_hundred_kilometres_is_at_infinity(bent_lens):
    """A parallel beam, launched at the lens or 1e8 mm before it, lands at the same point."""
    height = torch.tensor([0.5, 1.0, 1.5], dtype=torch.float64)
    near = torch.stack((height, 0.5 * height, torch.zeros_like(height)), -1)
    field = math.radians(1.0)
    axis = torch.tensor([math.sin(field), 0.0, math.cos(field)], dtype=torch.float64)
    direction = axis.expand_as(near)
    results = []
    for distance in (10.0, 1e8):
        hit = bent_lens.trace(Rays(near - distance * axis, direction))
        assert hit.valid.all()
        (gradient,) = torch.autograd.grad(
            hit.position[:, 0].sum(), [bent_lens.variables(["sensor_distance"])["sensor_distance"]]
        )
        results.append((hit.position.detach(), gradient))
    # Rounding of an origin at 1e8 mm is 1.5e-8 mm.
    assert (results[0][0] - results[1][0]).abs().max() < 1e-7
    assert float(results[0][1]) == pytest.approx(float(results[1][1]), rel=1e-7)


def test_leading_shapes_and_wavelengths_broadcast(bent_lens, bundle):
    rays = bundle(bent_lens)
    wavelengths = torch.tensor([[656.2725], [486.1327]], dtype=torch.float64)
    hit = bent_lens.trace(Rays(rays.position, rays.direction, wavelengths), record=True)
    assert hit.position.shape == (2, 7, 3)
    for row, wavelength in zip(hit.position, wavelengths, strict=True):
        alone = bent_lens.trace(Rays(rays.position, rays.direction, float(wavelength)))
        assert (alone.position - row).abs().max() < 1e-13
