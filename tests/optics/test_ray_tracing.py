"""Laws of tracing, for every kind of lens: derivatives, light that returns, rays that are lost."""

import math

import pytest
import torch

from dolens import Rays, Status, load_lens
from dolens.optics.jacobian import OUTPUTS, ray_jacobian
from tests.kernels.trace_cases import LENSES, bundle

BACKENDS = ("reference", "cpu")
both = pytest.mark.usefixtures("backend")


def passing(lens):
    """Rays that a lens lets through."""
    rays = bundle(lens, 100, 0.6)
    valid = lens.trace(rays).valid.nonzero()[:24, 0]
    assert len(valid) > 12
    return Rays(rays.position[valid], rays.direction[valid], 550.0)


def outputs(hit):
    """All numbers of a trace, (N, 7): position, direction, path length."""
    assert hit.valid.all()
    return torch.cat((hit.position, hit.direction, hit.path_length[:, None]), -1)


@pytest.mark.parametrize("sense", [1.0, -1.0], ids=["forward", "backward"])
@pytest.mark.parametrize("name", LENSES)
def test_derivatives_are_those_of_differences(root, name, sense):
    """In every parameter and in the rays, by both implementations; forward the Jacobian's too."""
    lens = LENSES[name](root)
    rays, send = passing(lens), lens.trace
    if sense < 0.0:
        there, send = lens.trace(rays), lens.sensor_to_scene
        rays = Rays(there.position.detach(), -there.direction.detach(), 550.0)
    position, direction = (v.clone().requires_grad_() for v in (rays.position, rays.direction))
    numbers = {**dict(lens.named_parameters()), "position": position, "direction": direction}
    generator = torch.Generator().manual_seed(1)
    weights, *ways = (
        torch.rand(shape, generator=generator, dtype=torch.float64) + 0.5
        for shape in ((len(position), 7), *(n.shape for n in numbers.values()))
    )
    ways = dict(zip(numbers, ways, strict=True))

    def traced():
        unit = direction / direction.norm(dim=-1, keepdim=True)
        return outputs(send(Rays(position, unit, 550.0)))

    @torch.no_grad()
    def moved(number, by):
        kept = number.clone()
        number.add_(by)
        found = traced()
        number.copy_(kept)
        return found

    def difference(name):
        """Fourth-order central difference, whose steps move light by 0.1 µm."""
        number, way = numbers[name], ways[name]
        probe = 1e-6 * float(number.detach().abs().max()) or 1e-12
        size = float((moved(number, probe * way) - moved(number, 0.0)).abs().max()) / probe
        step = 1e-4 / max(size, 0.01)
        ends = [moved(number, k * step * way) for k in (-2, -1, 1, 2)]
        return (ends[0] - 8 * ends[1] + 8 * ends[2] - ends[3]) / (12 * step)

    lens.backend = "cpu"
    expected = {name: difference(name) for name in numbers}
    for lens.backend in BACKENDS:
        gradients = torch.autograd.grad(
            (weights * traced()).sum(), list(numbers.values()), allow_unused=True
        )
        for (name, wanted), gradient in zip(expected.items(), gradients, strict=True):
            found = 0.0 if gradient is None else float((gradient * ways[name]).sum())
            allowed = 1e-7 + 1e-6 * float((weights * wanted).abs().sum())
            assert found == pytest.approx(float((weights * wanted).sum()), abs=allowed), name
        if sense > 0.0:
            jacobian = ray_jacobian(lens, rays, ["*"], OUTPUTS)
            for name, columns in jacobian.columns.items():
                column = jacobian.derivatives[..., columns] @ ways[name].flatten()
                error = (column - expected[name][:, [0, 1, 6, 3, 4, 5]]).abs().max()
                assert error < 1e-8 + 1e-6 * expected[name].abs().max(), name


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("name", LENSES)
def test_light_goes_back_the_way_it_came(root, name, backend):
    """To the first surface: with the same path, and in the same line as it came."""
    lens = LENSES[name](root)
    lens.backend, rays = backend, passing(lens)
    hit = lens.trace(rays)
    back = lens.sensor_to_scene(Rays(hit.position, -hit.direction, 550.0))
    assert back.valid.all()
    assert (back.direction + rays.direction).abs().max() < 1e-12
    away = back.position - rays.position
    along = (away * rays.direction).sum(-1, keepdim=True)
    assert (away - along * rays.direction).abs().max() < 1e-11
    assert (hit.path_length - back.path_length - along[:, 0]).abs().max() < 1e-11


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


@both
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


@both
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


@both
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


@both
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


@both
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


@both
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
