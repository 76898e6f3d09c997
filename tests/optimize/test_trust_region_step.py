"""Steps of a lens by a loss's gradient, measured by how far rays move."""

import pytest
import torch
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from dolens.analysis.pupil_quadrature import gaussian_quadrature
from dolens.optimize.merit import OperandModel
from dolens.optimize.operands import LensProperties, Operand, operand
from dolens.optimize.trust_region_step import ray_moves, trust_region_step
from dolens.optimize.variables import DesignVariables
from dolens.prescriptions import lens_from_prescription

LINES = (656.2725, 587.5618, 486.1327)
NAMES = {
    "surfaces.1.curvature": {"scale": 0.01},
    "surfaces.3.curvature": {"scale": 0.001},
    "surfaces.5.curvature": {"scale": 1.0},
}


@pytest.fixture
def triplet(root):
    prescription = yaml.safe_load((root / "conf/lens/cooke_triplet.yaml").read_text())
    return lens_from_prescription(prescription).double().requires_grad_(False)


def spots_of(lens):
    return [gaussian_quadrature(lens, [(0, 0), (0, 14)], LINES, 4, 8, symmetry=False)]


def intercepts(lens, spots):
    """Points about their spots' centroids, with the roots of their weights: (N, 2)."""
    (part,) = spots
    points = lens.trace(part.rays).position[:, :2]
    mean = torch.zeros(part.count, 2, dtype=points.dtype)
    mean.index_add_(0, part.spot, part.weight[:, None] * points)
    return (part.weight / part.count).sqrt()[:, None] * (points - mean[part.spot])


def penalty(model, steps):
    """Σ (weight·deviation)² after each of the steps (..., variables), operand by operand."""
    after = model.values + steps @ model.derivatives.T
    parts = zip(model.operands, after.unbind(-1), strict=True)
    return sum((o.weight * o.deviation(value)) ** 2 for o, value in parts)


def unbounded(count):
    return torch.full((count,), -torch.inf).double(), torch.full((count,), torch.inf).double()


def test_rays_move_as_far_as_they_may_whatever_the_variables_units(triplet):
    """Traced again at the new place: the RMS of their moves is the trust radius."""
    variables, spots, trust_radius = DesignVariables(triplet, NAMES), spots_of(triplet), 1e-5
    moves = ray_moves(triplet, variables, spots, 1e-9)
    gradient = torch.tensor([0.3, -2.0, 5.0]).double()
    found = trust_region_step(gradient, moves, trust_radius, *unbounded(3))
    before = intercepts(triplet, spots)
    with torch.no_grad():
        variables.scaled += found
    variables.write_to(triplet)
    moved = (intercepts(triplet, spots) - before).norm()
    assert float(moved) == pytest.approx(trust_radius, rel=1e-3)
    assert float(gradient @ found) < 0.0


def test_of_the_squared_spot_radius_it_is_gauss_and_newton_s_step(triplet):
    """L = Σ w |p|² has the gradient 2·Jᵀ√w p; the step is along -(JᵀJ)⁻¹Jᵀr."""
    variables, spots = DesignVariables(triplet, NAMES), spots_of(triplet)

    def points(scaled):
        names = variables.names
        values = {n: s * u for n, s, u in zip(names, variables.scale, scaled, strict=True)}
        changed = dict(triplet.named_parameters())
        kept = {n: changed[n].clone() for n in names}
        for name, value in values.items():
            changed[name].data.copy_(value.detach())
        found = intercepts(triplet, spots).reshape(-1)
        for name in names:
            changed[name].data.copy_(kept[name])
        return found

    start = variables.scaled.detach()
    residuals, columns = points(start), []
    for i, h in enumerate((1e-4, 1e-3, 1e-6)):
        shift = torch.zeros(3, dtype=torch.float64)
        shift[i] = h
        columns.append((points(start + shift) - points(start - shift)) / (2.0 * h))
    jacobian = torch.stack(columns, 1)
    wanted = -torch.linalg.lstsq(jacobian, residuals[:, None]).solution[:, 0]
    trust_radius = float((jacobian @ wanted).norm())
    moves = ray_moves(triplet, variables, spots, 1e-12)
    found = trust_region_step(2.0 * jacobian.T @ residuals, moves, trust_radius, *unbounded(3))
    assert torch.allclose(found, wanted, rtol=1e-4)


def test_bounds_hold(triplet):
    """A variable on its bound stays; the others make the most of it."""
    variables, spots = DesignVariables(triplet, NAMES), spots_of(triplet)
    moves = ray_moves(triplet, variables, spots, 1e-3)
    gradient = torch.tensor([1.0, 1.0, -1.0]).double()
    free = trust_region_step(gradient, moves, 1e-3, *unbounded(3))
    lower, upper = unbounded(3)
    held = int(free.abs().argmax())
    lower[held] = upper[held] = 0.0
    found = trust_region_step(gradient, moves, 1e-3, lower, upper)
    assert float(found[held]) == 0.0
    assert float(gradient @ found) < 0.0
    # The others go all the way.
    assert float((moves @ found).norm()) == pytest.approx(1e-3, rel=2e-6)


def test_no_gradient_no_step(triplet):
    moves = ray_moves(triplet, DesignVariables(triplet, NAMES), spots_of(triplet), 1e-3)
    found = trust_region_step(torch.zeros(3), moves, 1e-3, *unbounded(3))
    assert not bool(found.any())


def test_between_all_its_bounds_a_step_ends_short(triplet):
    """Every variable on a bound before rays have moved as far as they may."""
    moves = ray_moves(triplet, DesignVariables(triplet, NAMES), spots_of(triplet), 1e-3)
    gradient, bound = torch.tensor([1.0, -1.0, 1.0]).double(), torch.full((3,), 1e-9).double()
    found = trust_region_step(gradient, moves, 1.0, -bound, bound)
    assert torch.allclose(found, -bound * gradient, rtol=1e-9)
    assert float((moves @ found).norm()) < 1e-3


LIMITS = [
    pytest.param({"target": 0.3}, id="target"),
    pytest.param({"max": 0.1}, id="limit that the step would break"),
    pytest.param({"min": 0.4}, id="limit that is broken"),
    pytest.param({"min": -0.1, "max": 0.1}, id="two limits"),
    pytest.param({"max": 2.0}, id="limit out of reach"),
]


@pytest.mark.parametrize("limits", LIMITS)
@pytest.mark.parametrize("weight", [0.1, 1.0, 100.0])
def test_with_operands_no_step_within_reach_is_better(limits, weight):
    """Against the best of a grid over all steps of two variables that the trust radius allows."""
    entry = Operand("efl", limits.get("target"), limits.get("min"), limits.get("max"), weight)
    values = torch.tensor([0.05]).double()
    model = OperandModel((entry,), values, torch.tensor([[2.0, 0.5]]).double())
    moves = torch.tensor([[1.0, 0.4], [0.0, 0.5]]).double()
    gradient, trust_radius = torch.tensor([-1.0, 0.2]).double(), 0.5
    step = trust_region_step(gradient, moves, trust_radius, *unbounded(2), model)
    assert float((moves @ step).norm()) <= trust_radius * (1.0 + 1e-9)

    turn = torch.linspace(0.0, 2.0 * torch.pi, 2001, dtype=torch.float64)
    radius = torch.linspace(0.0, trust_radius, 1001, dtype=torch.float64)[:, None]
    rays = torch.stack([radius * turn.cos(), radius * turn.sin()])
    steps = torch.linalg.solve(moves, rays.flatten(1)).T
    after = values + steps @ model.derivatives[0]
    if "target" in limits:
        deviation = after - limits["target"]
    else:
        low, high = limits.get("min", -torch.inf), limits.get("max", torch.inf)
        deviation = after - after.clamp(low, high)
    grid = steps @ gradient + (weight * deviation).square()
    own = float(gradient @ step + penalty(model, step))
    # Rays move as far as they may to 1e-6.
    assert own <= float(grid.min()) + 1e-6
    # A grid of thousandths of the trust radius is no better than this.
    assert own >= float(grid.min()) - 1e-3 * weight


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 10**6))
def test_no_small_change_of_a_step_among_many_limits_is_better(seed):
    """Convex, so that the neighbours decide; steep and flat operands, bounds, all at random."""
    generator = torch.Generator().manual_seed(seed)

    def random(*shape):
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    entries = []
    for _ in range(4):
        low, high = sorted(random(2).tolist())
        weight = 10.0 ** float(random(1))
        entries.append(Operand("efl", None, low, high, weight))
    model = OperandModel(tuple(entries), random(4), random(4, 3))
    moves = torch.linalg.qr(random(6, 3), mode="r").R
    gradient, upper, trust_radius = random(3), random(3).abs(), 0.3
    step = trust_region_step(gradient, moves, trust_radius, -upper, upper, model)
    assert bool((step.abs() <= upper * (1.0 + 1e-12)).all())
    own, scale = float(gradient @ step + penalty(model, step)), float(gradient.norm())
    for size in (1e-1, 1e-2, 1e-3):
        others = (step + size * random(100, 3)).clamp(-upper, upper)
        lengths = (others @ moves.T).norm(dim=1, keepdim=True)
        others = others * (trust_radius / lengths).clamp(max=1.0)
        better = others @ gradient + penalty(model, others)
        assert own <= float(better.min()) + 1e-5 * scale + 1e-5 * abs(own)


def test_a_steep_limit_stops_a_step_that_would_break_it(root):
    """The rim of the doublet's crown, -0.005 mm thick as printed, may lose 0.01 mm and no more."""
    prescription = yaml.safe_load((root / "conf/lens/large_fov_doublet.yaml").read_text())
    lens = lens_from_prescription(prescription).double().requires_grad_(False)
    variables = DesignVariables(lens, {"surfaces.1.curvature": {"scale": 0.001}})
    spots = [gaussian_quadrature(lens, [(0, 0), (0, 14)], LINES, 4, 8, symmetry=False)]
    moves = ray_moves(lens, variables, spots, 1e-3)
    entry = operand({"kind": "edge_thickness", "min": -0.015, "weight": 100.0}, lens)

    def rim(step):
        changed = variables.scaled.detach() + step
        values = {"surfaces.1.curvature": changed[0] * 0.001}
        view = LensProperties(lens.system(values), lens.primary_wavelength, None)
        return float(min(entry.values(view).values()))

    # What bends the first surface more thins its rim.
    gradient = torch.tensor([-1e-3]).double()
    free = trust_region_step(gradient, moves, 0.03, *unbounded(1))
    held = trust_region_step(
        gradient, moves, 0.03, *unbounded(1), OperandModel.at(lens, variables, [entry], None)
    )
    assert rim(free) < -0.03
    assert rim(held) == pytest.approx(-0.015, abs=1e-3)
    assert 0.0 < float(held[0]) < float(free[0])
