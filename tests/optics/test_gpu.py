"""The same traces on a GPU, of one lens and of many, by the reference and by the Triton kernels."""

import pytest
import torch

import dolens
from dolens import Rays, load_lens
from dolens.kernels.table import MapOfLenses
from dolens.optics.jacobian import normal_equations, ray_jacobian
from dolens.optics.lens_family import FamilyRays, LensFamily
from dolens.tolerancing.tolerances import with_glass_elements
from tests.kernels.trace_cases import (
    LENSES,
    bundle,
    require_equal,
    require_no_worse,
    returning,
    traced,
)

pytestmark = [
    pytest.mark.gpu,
    pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device"),
]
FILES = ["cooke_triplet", "nikon", "asphere", "wavefront_coding", "double_gauss"]


def pencil(device):
    generator = torch.Generator().manual_seed(0)
    position = torch.rand((1000, 3), generator=generator, dtype=torch.float64) * 2.0 - 1.0
    direction = torch.randn((1000, 3), generator=generator, dtype=torch.float64) * 0.05
    direction[:, 2] = 1.0
    direction = direction / direction.norm(dim=-1, keepdim=True)
    return Rays(position.to(device), direction.to(device), 587.5618)


@pytest.mark.parametrize("name", FILES)
@pytest.mark.parametrize("dtype, error", [(torch.float64, 1e-11), (torch.float32, 3e-5)])
def test_sensor_points_and_gradients_are_those_of_the_cpu(root, name, dtype, error):
    results = []
    for device in ("cpu", "cuda"):
        lens = load_lens(root / "conf" / "lens" / f"{name}.yaml", dtype).to(device)
        hit = lens.trace(pencil(device), record=True)
        assert hit.position.device.type == device
        total = hit.position[hit.valid].square().sum()
        gradients = torch.autograd.grad(total, list(lens.parameters()), allow_unused=True)
        results.append((hit, [None if g is None else g.cpu() for g in gradients]))
    (cpu, cpu_gradients), (gpu, gpu_gradients) = results
    assert torch.equal(cpu.status, gpu.status.cpu())
    assert (cpu.position - gpu.position.cpu())[cpu.valid].abs().max() < error
    relative = 1e-10 if dtype == torch.float64 else 1e-2
    for a, b in zip(cpu_gradients, gpu_gradients, strict=True):
        assert (a is None) == (b is None)
        assert a is None or torch.allclose(a, b, rtol=relative, atol=relative)


def test_rays_are_aimed_on_a_gpu(root):
    lens = load_lens(root / "conf" / "lens" / "nikon.yaml").to("cuda")
    rays = lens.marginal_rays((0.0, 30.0))
    assert rays.converged.all()
    assert rays.position.device.type == "cuda"


@pytest.mark.parametrize("name", LENSES)
@pytest.mark.parametrize("sense", [1.0, -1.0], ids=["forward", "backward"])
def test_the_kernels_rays_and_gradients_are_those_of_the_reference(root, name, sense):
    lens = LENSES[name](root)
    rays = bundle(lens, 1000)
    if sense < 0.0:
        rays = returning(lens, rays)
    expected = traced(lens, rays, "reference", sense)
    assert (~expected.valid).sum() > 3, "some rays must fail"
    require_equal(traced(lens, rays, "cuda", sense, "cuda"), expected)


@pytest.mark.parametrize("name", LENSES)
def test_the_kernels_in_single_precision_are_no_worse_than_the_reference(root, name):
    lens = LENSES[name](root).float().double()
    rays = bundle(lens, 1000, fill=0.9)
    held = Rays(rays.position.float().double(), rays.direction.float().double(), 550.0)
    found = traced(lens, held, "cuda", device="cuda", dtype=torch.float32)
    reference = traced(lens, held, "reference", dtype=torch.float32)
    require_no_worse(found, reference, traced(lens, held, "reference"))


def test_every_ray_may_have_its_own_wavelength(root):
    lens = LENSES["posed"](root)
    rays = bundle(lens, 300, wavelengths=[[486.1327], [587.5618], [656.2725]])
    require_equal(
        traced(lens, rays, "cuda", device="cuda"),
        traced(lens, rays, "reference"),
    )


@pytest.mark.parametrize("name", ["cooke_triplet", "b_spline"])
def test_a_repeated_gradient_has_the_same_bits(root, name):
    """Where programs of the adjoint take many blocks in turn, and share coefficients."""
    lens = LENSES[name](root)
    rays = bundle(lens, 300_000)
    first, second = (traced(lens, rays, "cuda", device="cuda") for _ in range(2))
    assert all(torch.equal(first.gradients[k], second.gradients[k]) for k in first.gradients)
    require_equal(first, traced(lens, rays, "cpu"), relative=1e-10)


def test_broken_rays_spoil_no_other(root):
    lens = LENSES["posed"](root)
    rays = bundle(lens, 1000)
    missing = rays.position.clone()
    missing[::50, 0] = 900.0
    broken = rays.position.clone()
    broken[::50] = float("nan")
    expected = traced(lens, Rays(missing, rays.direction, 550.0), "cuda", device="cuda")
    found = traced(lens, Rays(broken, rays.direction, 550.0), "cuda", device="cuda")
    assert not found.valid[::50].any()
    assert torch.equal(found.position[expected.valid], expected.position[expected.valid])
    assert all(torch.equal(found.gradients[k], g) for k, g in expected.gradients.items())


def test_the_backward_pass_takes_at_most_64_bytes_a_ray(root):
    lens = load_lens(root / "conf" / "lens" / "nikon.yaml", torch.float32).to("cuda")
    lens.backend = "cuda"
    count = 1 << 21
    position = torch.zeros((count, 3), device="cuda", requires_grad=True)
    direction = torch.tensor([0.0, 0.0, 1.0], device="cuda").repeat(count, 1).requires_grad_()
    for _ in range(2):  # compiled, and then measured
        hit = lens.trace(Rays(position, direction, 550.0))
        total = hit.position.sum() + hit.path_length.sum()
        torch.cuda.synchronize()
        torch.cuda.reset_peak_memory_stats()
        before = torch.cuda.memory_allocated()
        gradients = torch.autograd.grad(
            total, [position, direction, *lens.parameters()], allow_unused=True
        )
        taken = torch.cuda.max_memory_allocated() - before
        del gradients, hit, total
    assert taken <= 64 * count


WAVELENGTHS = (656.2725, 587.5618, 486.1327)
VARIED = {
    "shapes": ["surfaces.*.curvature", "thicknesses.*", "sensor_distance"],
    "poses": ["elements.*.tilt_[xy]", "elements.*.decenter_[xy]", "surfaces.2.curvature"],
}
FAMILY, OF_EACH = 50, 200


def found_on(device, kind, dtype):
    """Return everything that a family gives, on the CPU."""
    lens = with_glass_elements(dolens.load_lens("cooke_triplet", dtype=dtype)).to(device)
    family = LensFamily(lens, VARIED[kind], WAVELENGTHS)
    generator = torch.Generator().manual_seed(1)
    off = torch.randn(FAMILY, family.count, generator=generator, dtype=torch.float64)
    start = family.start.cpu().double()
    values = start * (1.0 + 0.01 * off) + 1e-3 * (start == 0.0) * off
    position = 5.0 * torch.randn(FAMILY, OF_EACH, 3, generator=generator, dtype=torch.float64)
    position[..., 2] = -10.0
    direction = torch.tensor([0.0, 0.1, 1.0], dtype=torch.float64)
    direction = (direction / direction.norm()).expand(FAMILY, OF_EACH, 3)
    values, position, direction = (t.to(device, dtype) for t in (values, position, direction))
    rays = FamilyRays(position, direction, (torch.arange(OF_EACH, device=device) % 3).int())
    group = torch.arange(OF_EACH, device=device) // 50
    target = torch.tensor([0.1, 4.0], dtype=dtype, device=device).expand(FAMILY, OF_EACH, 2)
    weight = torch.linspace(0.5, 1.5, OF_EACH, dtype=dtype, device=device).expand(FAMILY, OF_EACH)
    indices = family.table(values).indices.clone().requires_grad_()
    media = {
        "indices": indices.detach(),
        "variables": MapOfLenses(
            family.with_indices(torch.tensor([3]), torch.tensor([family.count]), family.count + 1),
            index_derivatives=torch.ones((FAMILY, 1, 3), dtype=torch.float64, device=device),
        ),
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


@pytest.mark.parametrize("kind", VARIED)
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


@pytest.mark.parametrize("kind", VARIED)
def test_a_repeated_call_has_the_same_bits(kind):
    first, second = (found_on("cuda", kind, torch.float64) for _ in range(2))
    assert [name for name in first if not torch.equal(first[name], second[name])] == []


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
        scale = max(1.0, float(expected.double().abs().max()))
        torch.testing.assert_close(gpu, expected, rtol=0.0, atol=1e-10 * scale)
