"""The kernels as PyTorch operators: graphs, transforms, compilation, precision."""

import pytest
import torch
from torch import nn
from torch.func import functional_call, hessian, jvp

from dolens import InputError, Rays, load_lens
from dolens.kernels import operators
from dolens.optics.packing import pack

NAMES = ["cooke_triplet", "wavefront_coding", "asphere"]


@pytest.fixture(params=NAMES)
def lens(request, root):
    return load_lens(root / "conf" / "lens" / f"{request.param}.yaml", backend="cpu")


def bundle(lens, count=300):
    """Parallel light, wide enough that some rays fail."""
    generator = torch.Generator().manual_seed(3)
    r = lens.surfaces["1"].semi_diameter
    xy = (1.4 * torch.rand((count, 2), generator=generator, dtype=lens.dtype) - 0.7) * r
    position = torch.cat((xy, torch.full((count, 1), -5.0, dtype=lens.dtype)), 1)
    direction = torch.tensor([0.02, 0.05, 1.0], dtype=lens.dtype)
    return Rays(position, (direction / direction.norm()).expand(count, 3), 550.0)


def operator_inputs(lens, rays):
    table = pack(lens.system(), rays.wavelength, 1.0, 1, len(lens.surfaces), True)
    return (
        table.values.detach().requires_grad_(),
        table.indices.requires_grad_(),
        rays.position.clone().requires_grad_(),
        rays.direction.clone().requires_grad_(),
        None,
        table.codes,
        table.extras,
    )


def test_pytorchs_own_check_of_custom_operators(lens):
    """Schema, fake tensors, autograd registration, and AOT dispatch."""
    torch.library.opcheck(operators.trace, operator_inputs(lens, bundle(lens)))


def test_gradients_of_the_operator_by_finite_differences(lens):
    """Of indices too, which no parameter of a lens moves."""
    values, indices, position, direction, *rest = operator_inputs(lens, bundle(lens, 12))

    def points(indices, position, tilt):
        turned = direction.detach() + tilt
        turned = turned / turned.norm(dim=1, keepdim=True)
        out = operators.trace(values.detach(), indices, position, turned, *rest)
        weight = (out[3] == 0).to(out[0].dtype)[:, None]
        return out[0][:, :2] * weight, out[1] * weight, out[2] * weight[:, 0]

    tilt = torch.zeros_like(direction).requires_grad_()
    assert torch.autograd.gradcheck(points, (indices, position, tilt), eps=1e-7, atol=1e-6)


def test_a_gradient_is_no_more_than_64_bytes_a_ray(lens):
    """Whatever the number of surfaces: rays and status are kept, no intersection is."""
    count, kept = 20_000, {}
    rays = bundle(lens, count)
    rays = Rays(rays.position, rays.direction.contiguous(), 550.0)

    def keep(tensor):
        kept[tensor.untyped_storage().data_ptr()] = tensor.untyped_storage().nbytes()
        return tensor

    with torch.autograd.graph.saved_tensors_hooks(keep, lambda t: t):
        lens.trace(rays)
    assert count * 40 < sum(kept.values()) < count * 64


def test_a_second_derivative_says_what_to_do(lens):
    rays = bundle(lens)
    curvature = lens.surfaces["1"].curvature
    total = lens.trace(rays).path_length.sum()
    (gradient,) = torch.autograd.grad(total, curvature, create_graph=True)
    with pytest.raises(InputError, match="backend 'reference'"):
        gradient.backward()


def test_auto_leaves_second_derivatives_and_forward_mode_of_torch_func_to_the_reference(lens):
    lens.backend = "auto"
    rays = bundle(lens, 500)  # not so few that they are the reference's anyway
    name = "surfaces.1.curvature"
    stored = lens.variables([name])[name].detach()

    def path(c):
        hit = functional_call(lens, {name: c}, (rays,))
        return torch.where(hit.valid, hit.path_length, 0.0).sum()

    step = 1e-6 * abs(float(stored))
    slope = (path(stored + step) - path(stored - step)) / (2 * step)
    tangent = jvp(path, (stored,), (torch.ones_like(stored),))[1]
    assert float(tangent.detach()) == pytest.approx(float(slope.detach()), rel=1e-6)
    assert torch.isfinite(hessian(path)(stored))


def test_a_compiled_network_around_a_trace(root):
    """Full graph: the operator is opaque, and its gradient reaches lens and network."""
    lens = load_lens(root / "conf" / "lens" / "cooke_triplet.yaml", torch.float32, backend="cpu")
    network = nn.Sequential(nn.Linear(3, 8), nn.Tanh(), nn.Linear(8, 1))
    rays = bundle(lens, 64)
    values, indices, position, direction, *rest = operator_inputs(lens, rays)

    def loss(values):
        out = operators.trace(values, indices.detach(), position, direction, *rest)
        return network(torch.where((out[3] == 0)[:, None], out[0], 0.0)).square().mean()

    compiled = torch.compile(loss, fullgraph=True, backend="aot_eager")
    expected = torch.autograd.grad(loss(values), (values, network[0].weight))
    found = torch.autograd.grad(compiled(values), (values, network[0].weight))
    for a, b in zip(found, expected, strict=True):
        assert b.abs().max() > 0.0
        assert torch.allclose(a, b, rtol=1e-5, atol=1e-8)


def test_every_ray_its_own_wavelength(root):
    """A column of indices a wavelength, however the wavelengths broadcast with the rays."""
    lens = load_lens(root / "conf" / "lens" / "cooke_triplet.yaml", backend="cpu")
    rays = bundle(lens, 40)
    nm = torch.linspace(450.0, 650.0, 40, dtype=torch.float64)
    each = lens.trace(Rays(rays.position, rays.direction, nm))
    grid = lens.trace(Rays(rays.position, rays.direction, nm[:, None]))
    assert grid.position.shape == (40, 40, 3)
    for i in (0, 17, 39):
        alone = lens.trace(Rays(rays.position, rays.direction, float(nm[i])))
        assert torch.equal(alone.position[i], each.position[i])
        assert torch.equal(alone.position, grid.position[i])


def test_gradient_with_respect_to_the_wavelength(root):
    """Chromatic focal shift: through the indices, against a finite difference."""
    lens = load_lens(root / "conf" / "lens" / "cooke_triplet.yaml", backend="cpu")
    rays = bundle(lens, 40)

    def height(nm):
        hit = lens.trace(Rays(rays.position, rays.direction, nm))
        return torch.where(hit.valid, hit.position[:, 1], 0.0).sum()

    nm = torch.tensor(500.0, dtype=torch.float64, requires_grad=True)
    (slope,) = torch.autograd.grad(height(nm), nm)
    expected = (height(nm.detach() + 0.01) - height(nm.detach() - 0.01)) / 0.02
    assert float(slope) == pytest.approx(float(expected.detach()), rel=1e-6)


def test_nan_infinity_and_denormals_stay_in_their_own_ray(lens):
    """In the middle of a block: neighbours, their gradients and statuses do not notice."""
    rays = bundle(lens, 300)
    bad = {5: float("nan"), 130: float("inf"), 131: -float("inf"), 250: 1e-310}
    position = rays.position.clone()
    for i, value in bad.items():
        position[i] = value
    keep = torch.ones(300, dtype=torch.bool)
    keep[list(bad)] = False

    def traced(position):
        hit = lens.trace(Rays(position, rays.direction, 550.0))
        total = (hit.position[keep & hit.valid] ** 2).sum()
        return hit, torch.autograd.grad(total, lens.parameters(), allow_unused=True)

    spoiled, spoiled_gradients = traced(position)
    clean, clean_gradients = traced(rays.position)
    assert torch.equal(spoiled.status[keep], clean.status[keep])
    assert torch.equal(spoiled.position[keep], clean.position[keep])
    for a, b in zip(spoiled_gradients, clean_gradients, strict=True):
        assert (a is None) == (b is None)
        assert a is None or torch.allclose(a, b, rtol=1e-12, atol=1e-14)
    assert not spoiled.valid[[5, 130, 131]].any()
