"""Many lenses of one structure on a GPU, as by the CPU's kernels."""

import pytest
import torch

import dolens
from dolens.optics.jacobian import normal_equations, ray_jacobian
from dolens.optics.lens_family import FamilyRays, LensFamily
from dolens.tolerancing.tolerances import with_glass_elements

pytestmark = [
    pytest.mark.gpu,
    pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device"),
]
WAVELENGTHS = (656.2725, 587.5618, 486.1327)
NAMES = {
    "shapes": ["surfaces.*.curvature", "thicknesses.*", "sensor_distance"],
    "poses": ["elements.*.tilt_[xy]", "elements.*.decenter_[xy]", "surfaces.2.curvature"],
}
LENSES, RAYS = 50, 200


def found_on(device, kind, dtype):
    """Return everything that a family gives, on the CPU."""
    lens = with_glass_elements(dolens.load_lens("cooke_triplet", dtype=dtype)).to(device)
    family = LensFamily(lens, NAMES[kind], WAVELENGTHS)
    generator = torch.Generator().manual_seed(1)
    off = torch.randn(LENSES, family.count, generator=generator, dtype=torch.float64)
    start = family.start.cpu().double()
    values = start * (1.0 + 0.01 * off) + 1e-3 * (start == 0.0) * off
    position = 5.0 * torch.randn(LENSES, RAYS, 3, generator=generator, dtype=torch.float64)
    position[..., 2] = -10.0
    direction = torch.tensor([0.0, 0.1, 1.0], dtype=torch.float64)
    direction = (direction / direction.norm()).expand(LENSES, RAYS, 3)
    values, position, direction = (t.to(device, dtype) for t in (values, position, direction))
    rays = FamilyRays(position, direction, (torch.arange(RAYS, device=device) % 3).int())
    group = torch.arange(RAYS, device=device) // 50
    target = torch.tensor([0.1, 4.0], dtype=dtype, device=device).expand(LENSES, RAYS, 2)
    weight = torch.linspace(0.5, 1.5, RAYS, dtype=dtype, device=device).expand(LENSES, RAYS)
    indices = family.table(values).indices.clone().requires_grad_()
    media = {
        "indices": indices.detach(),
        "variables": family.with_indices(
            torch.tensor([3]), torch.tensor([family.count]), family.count + 1
        ),
        "index_derivatives": torch.ones((LENSES, 1, 3), dtype=torch.float64, device=device),
    }
    leaf = values.clone().requires_grad_()
    hit = family.trace(leaf, rays, indices)
    total = hit.position[hit.valid].square().sum() + hit.path_length[hit.valid].sum()
    of_values, of_indices = torch.autograd.grad(total, (leaf, indices))
    jacobians = family.jacobians(values, rays, ("x", "path_length"), **media)
    sums = family.normal_equations(values, rays, target, weight, group, 4, **media)
    shown = {
        "status": hit.status,
        "position": hit.position.detach() * hit.valid[..., None],
        "gradient of values": of_values,
        "gradient of indices": of_indices,
        **{f"jacobians: {k}": v for k, v in vars(jacobians).items()},
        **{f"sums: {k}": v for k, v in vars(sums).items()},
    }
    assert all(tensor.device.type == device for tensor in shown.values())
    return {name: tensor.cpu() for name, tensor in shown.items()}


@pytest.mark.parametrize("kind", NAMES)
@pytest.mark.parametrize("dtype, error", [(torch.float64, 1e-11), (torch.float32, 1e-3)])
def test_families_of_lenses_are_those_of_the_cpu(kind, dtype, error):
    gpu, cpu = found_on("cuda", kind, dtype), found_on("cpu", kind, dtype)
    if dtype == torch.float32:
        return require_near(gpu, found_on("cpu", kind, torch.float64), error)
    assert torch.equal(gpu["status"], cpu["status"])
    return require_near(gpu, cpu, error)


def require_near(found, expected, error):
    for name, wanted in expected.items():
        if wanted.is_floating_point():
            scale = float(wanted.abs().max())
            near = (found[name].double() - wanted.double()).abs() <= error * scale
            # A ray at an aperture's rim passes in one precision and not in the other.
            assert near.double().mean() > 0.99 if error > 1e-6 else near.all(), name


@pytest.mark.parametrize("kind", NAMES)
def test_a_repeated_call_has_the_same_bits(kind):
    first, second = (found_on("cuda", kind, torch.float64) for _ in range(2))
    assert all(torch.equal(first[name], second[name]) for name in first)


def test_derivatives_of_one_lens_are_those_of_the_reference():
    generator = torch.Generator().manual_seed(3)
    position = 2.0 * torch.randn(500, 3, generator=generator, dtype=torch.float64)
    position[:, 2] = -5.0
    direction = torch.tensor([0.05, 0.1, 1.0], dtype=torch.float64)
    direction = (direction / direction.norm()).expand(500, 3)
    found = []
    for device, backend in (("cuda", "cuda"), ("cpu", "reference")):
        lens = with_glass_elements(dolens.load_lens("cooke_triplet", dtype=torch.float64))
        lens = lens.to(device)
        lens.backend = backend
        rays = dolens.Rays(position.to(device), direction.to(device), 587.5618)
        jacobian = ray_jacobian(lens, rays, ["*"])
        sums = normal_equations(lens, rays, ["*"], group=torch.arange(500) // 100)
        found.append([t.cpu() for t in (jacobian.valid, jacobian.derivatives, sums.jtj, sums.jtr)])
        found[-1].append(sums.groups.jacobian.cpu())
    for gpu, expected in zip(*found, strict=True):
        scale = max(1.0, float(expected.abs().max()))
        torch.testing.assert_close(gpu, expected, rtol=0.0, atol=1e-10 * scale)
