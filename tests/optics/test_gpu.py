"""The same trace on a GPU."""

import pytest
import torch

from dolens import Rays, load_lens

pytestmark = [
    pytest.mark.gpu,
    pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device"),
]
LENSES = ["cooke_triplet", "nikon", "asphere", "wavefront_coding", "double_gauss"]


def bundle(device):
    generator = torch.Generator().manual_seed(0)
    position = torch.rand((1000, 3), generator=generator, dtype=torch.float64) * 2.0 - 1.0
    direction = torch.randn((1000, 3), generator=generator, dtype=torch.float64) * 0.05
    direction[:, 2] = 1.0
    direction = direction / direction.norm(dim=-1, keepdim=True)
    return Rays(position.to(device), direction.to(device), 587.5618)


@pytest.mark.parametrize("name", LENSES)
@pytest.mark.parametrize("dtype, error", [(torch.float64, 1e-11), (torch.float32, 3e-5)])
def test_sensor_points_and_gradients_are_those_of_the_cpu(root, name, dtype, error):
    results = []
    for device in ("cpu", "cuda"):
        lens = load_lens(root / "conf" / "lens" / f"{name}.yaml", dtype).to(device)
        hit = lens.trace(bundle(device), record=True)
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
