"""Rays from farther than anything that can be seen, in single precision."""

import math

import pytest
import torch

from dolens import Rays, Status
from dolens.optics.rays import distance_along
from tests.kernels.trace_cases import LENSES
from tests.optics.ray_facts import BACKENDS, send
from tests.optics.test_light_from_the_side import ball

# The name of a lens, the sense of the light, and who traces it.
CASES = [
    *(("posed", 1.0, backend) for backend in BACKENDS),
    *(("spectrometer", -1.0, backend) for backend in BACKENDS),
    ("ball", 1.0, "reference"),
]


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=["f32", "f64"])
@pytest.mark.parametrize("name, sense, backend", CASES)
def test_far_rays_have_finite_numbers_and_gradients(name, sense, backend, dtype, root):
    """On the way to a plane that they run along, single precision overflows: 1e30 mm / 1e-9."""
    lens = (ball() if name == "ball" else LENSES[name](root)).float()
    angles = torch.tensor([0.0, 0.1, 0.3, 1.2, 1.57], dtype=torch.float64)
    far = torch.tensor([1e10, 1e19, 1e25, 1e30], dtype=torch.float64)
    angle, far = (v.reshape(-1) for v in torch.meshgrid(angles, far, indexing="ij"))
    direction = sense * torch.stack((0.0 * angle, angle.sin(), angle.cos()), -1)
    start = torch.tensor([0.01, 0.02, 0.0], dtype=torch.float64)
    position = (start - far[:, None] * direction).to(dtype).requires_grad_()
    direction = direction.to(dtype).requires_grad_()
    hit = send(lens, Rays(position, direction), sense, backend)
    outputs = torch.cat((hit.position, hit.direction, hit.path_length[:, None]), 1)
    assert outputs.isfinite().all()
    if not outputs.requires_grad:
        return
    inputs = [position, direction, *lens.parameters()]
    for gradient in torch.autograd.grad(outputs.sum(), inputs, allow_unused=True):
        assert gradient is None or gradient.isfinite().all()


@pytest.mark.parametrize("backend", BACKENDS)
def test_a_ray_along_the_axis_may_begin_at_any_distance_that_can_be_seen(backend, root):
    """It lands where a ray does that begins in front of the lens; one from farther misses."""
    lens = LENSES["cooke_triplet"](root).float()
    position = torch.tensor([[0.1, 0.2, -1.0], [0.1, 0.2, -1e30], [0.1, 0.2, -1.1e30]])
    hit = send(lens, Rays(position, torch.tensor([0.0, 0.0, 1.0])), 1.0, backend)
    assert hit.status.tolist() == [Status.OK, Status.OK, Status.MISSED]
    assert torch.equal(hit.position[0], hit.position[1])
    assert math.isclose(float(hit.path_length[1].detach()), 1e30, rel_tol=1e-6)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=["f32", "f64"])
def test_a_distance_out_of_reach_has_no_derivative_that_overflows(dtype):
    """The derivative in the cosine divides by it twice: 1e28 mm / 1e-9 is held, 1e28 / 1e-9² is
    not.  All else is the quotient.
    """
    cosine = torch.tensor([1e-9, -1e-9, 1e-3, 1.0], dtype=dtype).requires_grad_()
    separation = torch.tensor([[0.0], [7.0], [-1e10], [1e28]], dtype=dtype).requires_grad_()
    distance = distance_along(separation, cosine)
    gradients = torch.autograd.grad(distance.clamp(-1.0, 1.0).sum(), (separation, cosine))
    assert all(gradient.isfinite().all() for gradient in gradients)
    assert torch.equal(distance[:3], (separation / cosine)[:3])
    assert torch.equal(distance[3, 2:], separation[3] / cosine[2:])
    assert distance[3, :2].tolist() == pytest.approx([1e35, -1e35])
