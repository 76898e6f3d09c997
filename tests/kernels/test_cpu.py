"""The CPU kernels answer to the reference, for every kind of lens."""

from dataclasses import replace

import pytest
import torch

from dolens import Rays
from dolens.optics.jacobian import OUTPUTS, normal_equations, ray_jacobian
from dolens.optics.surfaces.clear_aperture import Circle
from tests.kernels.trace_cases import (
    LENSES,
    _random,
    bundle,
    require_equal,
    require_no_worse,
    returning,
    traced,
)

BY_SAG = ("even_aspheres", "odd_aspheres", "anamorphic", "cylinders", "zernike", "forbes", "grid")
CASES = pytest.mark.parametrize("name", LENSES)


@CASES
@pytest.mark.parametrize("sense", [1.0, -1.0])
def test_rays_and_gradients_are_those_of_the_reference(name, sense, root):
    lens = LENSES[name](root)
    rays = bundle(lens) if sense > 0.0 else returning(lens, bundle(lens))
    expected = traced(lens, rays, "reference", sense)
    assert (~expected.valid).sum() > 3, "some rays must fail"
    require_equal(traced(lens, rays, "cpu", sense), expected)


# Gradients of Zernike phases err by one rounding, and the reference's by a half.
@pytest.mark.parametrize("name", [name for name in LENSES if name != "zernike_phases"])
def test_single_precision_is_no_worse_than_the_reference(name, root):
    lens = LENSES[name](root)
    rays = bundle(lens, 1000, fill=0.9)
    held = Rays(rays.position.float().double(), rays.direction.float().double(), 550.0)
    lens = lens.float().double()
    found = traced(lens, held, "cpu", dtype=torch.float32)
    reference = traced(lens, held, "reference", dtype=torch.float32)
    require_no_worse(found, reference, traced(lens, held, "reference"))


@CASES
def test_jacobians_and_normal_equations_are_those_of_the_reference(name, root):
    lens = LENSES[name](root)
    rays, found = bundle(lens, 60, wavelengths=[[486.1327], [656.2725]]), []
    for backend in ("cpu", "reference"):
        lens.backend = backend
        jacobian = ray_jacobian(lens, rays, ["*"], OUTPUTS)
        sums = normal_equations(lens, rays, ["*"], outputs=("x", "y", "path_length"))
        found.append((jacobian, sums))
    (fast, sums), (slow, expected) = found
    assert torch.equal(fast.valid, slow.valid) and fast.columns == slow.columns
    assert 0 < int(slow.valid.sum()) < slow.valid.numel()
    assert (fast.values - slow.values).abs().max() < 1e-11
    scale = slow.derivatives.abs().amax((0, 1))
    # A column that vanishes by symmetry is rounding of terms that do not.
    error = (fast.derivatives - slow.derivatives).abs().amax((0, 1))
    assert (error <= 1e-11 * scale.clamp(min=1e-2)).all()
    assert int(sums.count) == int(expected.count)
    for what in ("jtj", "jtr"):
        one, other = getattr(sums, what), getattr(expected, what)
        assert (one - other).abs().max() <= 1e-9 * other.abs().max()


@pytest.mark.parametrize("name", BY_SAG)
def test_a_semi_diameter_without_end_costs_no_digits(name, root):
    """Newton's iteration ends by lengths of the beam, not of an aperture that nothing reaches."""
    lens = LENSES[name](root)
    rays = bundle(lens, 40, fill=0.8)
    expected = traced(lens, rays, "reference")
    for surface in lens.surfaces.values():
        surface.aperture = replace(surface.aperture, edge=Circle(1e16))
    for backend in ("reference", "cpu"):
        found = traced(lens, rays, backend)
        both = expected.valid & found.valid
        assert both.sum() > 20
        assert (found.position - expected.position)[both].abs().max() < 1e-11


@CASES
@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_a_ray_through_the_vertices_has_finite_gradients(name, dtype, root):
    """One along the axis, and two askew through the first vertex."""
    lens = LENSES[name](root)
    lens = lens.to(dtype).to(torch.float64)
    position = torch.tensor([[0.0, 0.0, -10.0], [0.0, 0.5, -10.0], [0.3, 0.5, -10.0]]).double()
    rays = Rays(position, -position / position.norm(dim=-1, keepdim=True), 550.0)
    expected, found = (traced(lens, rays, b, dtype=dtype) for b in ("reference", "cpu"))
    assert torch.equal(found.status, expected.status)
    single = dtype == torch.float32
    # Of a tilt about the axis itself what is left of large terms counts.
    for parameter, gradient in expected.gradients.items():
        assert torch.isfinite(gradient).all(), parameter
        error = (found.gradients[parameter] - gradient).abs().max()
        assert error <= (2e-3 if single else 1e-11) * (1e-3 + gradient.abs().max()), parameter
    # Obscurations stop all rays of two lenses.
    assert bool(expected.valid.any()) == (name not in ("clipped", "figures"))
    # The first of the odd aspheres has a tip, where nothing has a slope.
    if not single and name != "odd_aspheres" and expected.valid.any():
        require_slopes(lens, rays, expected)


def require_slopes(lens, rays, expected):
    """Derivatives with respect to where the rays start are central differences of the values."""
    step, weights = 1e-5, _random(len(rays.position), 7, seed=5)
    for axis in range(3):
        shift = torch.zeros(3, dtype=torch.float64)
        shift[axis] = step
        ends = []
        for sign in (1.0, -1.0):
            moved = Rays(rays.position + sign * shift, rays.direction, rays.wavelength)
            hit = lens.trace(moved)
            outputs = torch.cat((hit.position, hit.direction, hit.path_length[..., None]), -1)
            ends.append((outputs.detach() * weights).sum(-1))
        slope = (ends[0] - ends[1]) / (2.0 * step)
        error = (slope - expected.gradients["position"][:, axis])[expected.valid].abs().max()
        assert error < 1e-6 * (1.0 + slope.abs().max())
