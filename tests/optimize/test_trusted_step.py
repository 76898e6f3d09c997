"""Steps of a lens by a loss's gradient, measured by how far rays move."""

import pytest
import torch
import yaml

from dolens.imaging.spot_rays import gaussian_quadrature
from dolens.optimize.trusted_step import ray_moves, trusted_step
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


def landing(lens, spots):
    """Points about their spots' centroids, with the roots of their weights: (N, 2)."""
    (part,) = spots
    points = lens.trace(part.rays).position[:, :2]
    mean = torch.zeros(part.count, 2, dtype=points.dtype)
    mean.index_add_(0, part.spot, part.weight[:, None] * points)
    return (part.weight / part.count).sqrt()[:, None] * (points - mean[part.spot])


def unbounded(count):
    return torch.full((count,), -torch.inf).double(), torch.full((count,), torch.inf).double()


def test_rays_move_as_far_as_they_may_whatever_the_variables_units(triplet):
    """Traced again at the new place: the RMS of their moves is the reach."""
    variables, spots, reach = DesignVariables(triplet, NAMES), spots_of(triplet), 1e-5
    moves = ray_moves(triplet, variables, spots, 1e-9)
    gradient = torch.tensor([0.3, -2.0, 5.0]).double()
    found = trusted_step(gradient, moves, reach, *unbounded(3))
    before = landing(triplet, spots)
    with torch.no_grad():
        variables.scaled += found.step
    variables.write_to(triplet)
    moved = (landing(triplet, spots) - before).norm()
    assert float(moved) == pytest.approx(reach, rel=1e-3)
    # Half of what the gradient alone promises: the model's curvature takes the other half.
    assert found.predicted == pytest.approx(-0.5 * float(gradient @ found.step), rel=1e-9)


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
        found = landing(triplet, spots).reshape(-1)
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
    reach = float((jacobian @ wanted).norm())
    moves = ray_moves(triplet, variables, spots, 1e-12)
    found = trusted_step(2.0 * jacobian.T @ residuals, moves, reach, *unbounded(3))
    assert torch.allclose(found.step, wanted, rtol=1e-4)


def test_bounds_hold(triplet):
    """A variable on its bound stays; the others make the most of it."""
    variables, spots = DesignVariables(triplet, NAMES), spots_of(triplet)
    moves = ray_moves(triplet, variables, spots, 1e-3)
    gradient = torch.tensor([1.0, 1.0, -1.0]).double()
    free = trusted_step(gradient, moves, 1e-3, *unbounded(3)).step
    lower, upper = unbounded(3)
    held = int(free.abs().argmax())
    lower[held] = upper[held] = 0.0
    found = trusted_step(gradient, moves, 1e-3, lower, upper)
    assert float(found.step[held]) == 0.0
    assert found.predicted > 0.0
    assert float((moves @ found.step).norm()) <= 1e-3 * (1.0 + 1e-9)


def test_no_gradient_no_step(triplet):
    moves = ray_moves(triplet, DesignVariables(triplet, NAMES), spots_of(triplet), 1e-3)
    found = trusted_step(torch.zeros(3), moves, 1e-3, *unbounded(3))
    assert found.predicted == 0.0
    assert not bool(found.step.any())
